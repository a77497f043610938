"""Rendered pictures: intensities as the interfaces say, interpolation against the exact trace,
noise and depth.
"""

from __future__ import annotations

import numpy as np
import pytest

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig, PatternConfig
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, Ripple
from membrane_ctrl.sim.optics.pattern_levels import Light, pattern_sequence
from membrane_ctrl.sim.optics.trace import Trace

LINEAR = Light(dark_fraction=0.0, white_fraction=1.0, leak=0.0, vignetting=0.0)
SIDE_MM = 8 * 49.82


def _region(hits: Trace) -> np.ndarray:
    half = SIDE_MM / 2
    inside = (np.abs(hits.s_x_mm) < half) & (np.abs(hits.s_y_mm) < half)
    return np.asarray(hits.on_film(500.0) & inside)


def _phases(renderer: OpticsRenderer, axis: str, displacement_um: float) -> np.ndarray:
    """Wrapped phase seen in four rendered pictures (the paper's eq. 1)."""
    patterns = [Pattern("sin", axis, k, k * np.pi / 2) for k in range(4)]
    i1, i2, i3, i4 = (
        renderer.render_picture(p, displacement_um).astype(np.float64).ravel() for p in patterns
    )
    return np.arctan2(i4 - i2, i1 - i3)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_sinusoids_have_the_brightness_of_the_interfaces(
    clean_optics: OpticsConfig, film: FilmShape, axis: str
) -> None:
    renderer = OpticsRenderer(clean_optics, film, LINEAR, exact=True)
    hits = renderer.trace_pixels(12.0)
    s_mm = (hits.s_x_mm if axis == "x" else hits.s_y_mm) + SIDE_MM / 2
    for shift in (0.0, 0.7, 4.0):
        seen = renderer.render_picture(Pattern("sin", axis, 0, shift), 12.0).ravel()
        wanted = 65535 * (0.5 + 0.5 * np.cos(2 * np.pi * s_mm / 49.82 - np.pi + shift))
        assert np.abs(seen - wanted)[_region(hits)].max() < 0.51


@pytest.mark.parametrize("axis", ["x", "y"])
def test_gray_bits_read_together_are_the_half_period(
    clean_optics: OpticsConfig, film: FilmShape, axis: str
) -> None:
    renderer = OpticsRenderer(clean_optics, film, LINEAR, exact=True)
    hits = renderer.trace_pixels(0.0)
    on = _region(hits)
    s_mm = (hits.s_x_mm if axis == "x" else hits.s_y_mm)[on] + SIDE_MM / 2
    bits = [
        renderer.render_picture(Pattern("gray", axis, bit), 0.0).ravel()[on] > 32768
        for bit in (1, 2, 3, 4)
    ]
    value = np.zeros(on.sum(), dtype=int)
    binary = np.zeros(on.sum(), dtype=bool)
    for bit in bits:  # Gray to binary: each bit flips by the one above
        binary = binary ^ bit
        value = 2 * value + binary
    np.testing.assert_array_equal(value, np.floor(2 * s_mm / 49.82))
    assert len(np.unique(value)) > 8


def test_white_black_and_what_is_not_the_film(clean_optics: OpticsConfig, film: FilmShape) -> None:
    light = Light(dark_fraction=0.1, white_fraction=0.9, leak=0.05, vignetting=0.0)
    renderer = OpticsRenderer(clean_optics, film, light)
    on = renderer.trace_pixels(0.0).on_film(499.0)
    beside = ~renderer.trace_pixels(0.0).on_film(501.0)
    white, black = (
        renderer.render_picture(Pattern(role), 0.0).ravel() / 65535 for role in ("white", "black")
    )
    np.testing.assert_allclose(white[on], 0.9, atol=1e-5)
    np.testing.assert_allclose(black[on], 0.1 + 0.05 * 0.8, atol=1e-5)
    np.testing.assert_allclose(white[beside], 0.1, atol=1e-5)
    assert 0.45 < on.mean() < 0.5  # docs/explanation/physics.md: 2.16 M of 5 M pixels inside 475 mm


def test_beyond_the_pattern_region_the_screen_is_dark(clean_optics: OpticsConfig) -> None:
    shallow = FilmShape(20.0)
    renderer = OpticsRenderer(clean_optics, shallow, LINEAR)
    hits = renderer.trace_pixels(0.0)
    outside = hits.on_film(499.0) & ((np.abs(hits.s_x_mm) > 200.0) | (np.abs(hits.s_y_mm) > 200.0))
    assert outside.sum() > 1000
    assert renderer.render_picture(Pattern("white"), 0.0).ravel()[outside].max() == 0


@pytest.mark.parametrize(
    "displacement_um",
    [-149.0, 1234.5, *(pytest.param(more, marks=pytest.mark.campaign) for more in (0.0, 37.0))],
)
def test_interpolated_phases_stay_within_a_tenth_of_a_milliradian(
    film: FilmShape, displacement_um: float
) -> None:
    optics = OpticsConfig(
        camera=CameraConfig(width_px=1224, height_px=1024, pixel_um=6.9, bits=16, noise_adu=0.0)
    )
    renderer = OpticsRenderer(optics, film, LINEAR)
    hits = renderer.trace_pixels(displacement_um)
    on = hits.on_film(499.0) & (np.abs(hits.s_x_mm) < 199.0) & (np.abs(hits.s_y_mm) < 199.0)
    for axis, s_mm in (("x", hits.s_x_mm), ("y", hits.s_y_mm)):
        true = 2 * np.pi * (s_mm + SIDE_MM / 2) / 49.82 - np.pi
        error = np.abs(_wrapped(_phases(renderer, axis, displacement_um) - true))[on]
        assert error.max() < 1e-4


def replace_noise(optics: OpticsConfig) -> OpticsConfig:
    return optics.model_copy(update={"camera": optics.camera.model_copy(update={"noise_adu": 0.0})})


def test_a_fine_ripple_survives_the_interpolation() -> None:
    optics = OpticsConfig(
        camera=CameraConfig(width_px=1224, height_px=1024, pixel_um=6.9, bits=16, noise_adu=0.0)
    )
    film = FilmShape(37.1, ripples=(Ripple(1.0, 50.0, 20.0),))
    renderer = OpticsRenderer(optics, film, LINEAR)
    hits = renderer.trace_pixels(0.0)
    on = hits.on_film(490.0)
    true = 2 * np.pi * (hits.s_x_mm + SIDE_MM / 2) / 49.82 - np.pi
    error = np.abs(_wrapped(_phases(renderer, "x", 0.0) - true))[on]
    assert error.max() < 1e-3


@pytest.mark.parametrize(("gamma", "bits"), [(1.0, 8), (2.2, 8), (1.0, 16)])
def test_crossed_fringes_are_what_traced_rays_see(film: FilmShape, gamma: float, bits: int) -> None:
    width, height = 245, 205
    camera = CameraConfig(width_px=width, height_px=height, pixel_um=34.5, bits=bits, noise_adu=0.0)
    renderer = OpticsRenderer(OpticsConfig(camera=camera), film, Light(gamma=gamma))
    picture = renderer.render_picture(
        Pattern("crossed", "", 32, 0.7, shift_y_rad=1.9), 3.0, gain=0.9
    ).astype(float)
    hits = renderer.trace_pixels(3.0)
    rate = 2 * np.pi * 32 / SIDE_MM
    waves = np.cos(rate * hits.s_x_mm + 0.7 + 31 * np.pi) + np.cos(
        rate * hits.s_y_mm + 1.9 + 31 * np.pi
    )
    shown = np.maximum(np.abs(hits.s_x_mm), np.abs(hits.s_y_mm)) < SIDE_MM / 2
    light = 0.02 + 0.98 * np.where(shown, np.maximum(0.5 + waves / 4, 0) ** gamma, 0.0)
    row, column = np.mgrid[:height, :width]
    away = ((row - (height - 1) / 2) ** 2 + (column - (width - 1) / 2) ** 2).ravel()
    full = 2**bits - 1
    counts = 0.02 * full + 0.9 * 0.78 * full * light * (
        1 - 0.15 * away / away.max()
    ) * hits.on_film(500.0)
    clear_of_rim = np.abs(np.hypot(hits.x_mm, hits.y_mm) - 500.0) > 1.0
    assert np.abs(picture.ravel() - counts)[clear_of_rim].max() < 0.51 + 2e-5 * full


def test_noise_of_crossed_fringes_is_as_configured_and_new_in_each_row_and_picture(
    film: FilmShape,
) -> None:
    optics = OpticsConfig(
        camera=CameraConfig(width_px=300, height_px=250, pixel_um=28.0, bits=16, noise_adu=40.0)
    )
    renderer = OpticsRenderer(optics, film)
    pattern = Pattern("crossed", "", 32)
    clean = OpticsRenderer(replace_noise(optics), film).render_picture(pattern, 0.0).astype(float)
    first, second = (renderer.render_picture(pattern, 0.0) - clean for _ in range(2))
    assert first.std() == pytest.approx(40.0, rel=0.01)
    assert abs(first.mean()) < 1.0
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(first[:-1].ravel(), first[1:].ravel())[0, 1]) < 0.02


def test_a_film_that_moves_moves_the_fringes_by_half_a_period_a_millimetre(
    clean_optics: OpticsConfig, film: FilmShape
) -> None:
    renderer = OpticsRenderer(clean_optics, film)
    change = renderer.trace_pixels(500.0).s_x_mm - renderer.trace_pixels(-500.0).s_x_mm
    on = renderer.trace_pixels(0.0).on_film(475.0)
    assert 0.4 < np.abs(change[on]).max() / 49.82 < 0.8


def test_noise_has_the_configured_deviation_and_is_new_in_each_picture(film: FilmShape) -> None:
    optics = OpticsConfig(
        camera=CameraConfig(width_px=306, height_px=256, pixel_um=27.6, bits=12, noise_adu=20.0)
    )
    clean = optics.model_copy(
        update={"camera": optics.camera.model_copy(update={"noise_adu": 0.0})}
    )
    # far from both ends, so that nothing clips, and on whole counts, so that the still picture is
    # not rounded
    light = Light(dark_fraction=0.4, white_fraction=0.8, vignetting=0.0)
    renderer = OpticsRenderer(optics, film, light, seed=4)
    still = OpticsRenderer(clean, film, light).render_picture(Pattern("white"), 0.0).astype(float)
    one, two = (renderer.render_picture(Pattern("white"), 0.0) - still for _ in range(2))
    for noise in (one, two):
        assert noise.std() == pytest.approx(20.0, rel=0.02)
        assert abs(noise.mean()) < 0.3
        assert abs(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]) < 0.02
        assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < 0.02
    assert ((one / 20.0) ** 4).mean() == pytest.approx(
        3.0, abs=0.15
    )  # a normal distribution's kurtosis


def test_the_same_seed_gives_the_same_pictures(small_optics: OpticsConfig, film: FilmShape) -> None:
    one, again, other = (
        OpticsRenderer(small_optics, film, seed=seed).render_picture(Pattern("white"), 3.0)
        for seed in (7, 7, 8)
    )
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()


def test_too_long_an_exposure_saturates_at_full_scale(
    small_optics: OpticsConfig, film: FilmShape
) -> None:
    renderer = OpticsRenderer(small_optics, film)
    assert renderer.render_picture(Pattern("white"), 0.0).max() < 255
    long = renderer.render_picture(Pattern("white"), 0.0, gain=2.0)
    assert long.dtype == np.uint8
    assert (long == 255).mean() > 0.45


def test_gamma_bends_the_levels(clean_optics: OpticsConfig, film: FilmShape) -> None:
    linear = (
        OpticsRenderer(clean_optics, film, LINEAR).render_picture(Pattern("sin", "x"), 0.0) / 65535
    )
    light = Light(dark_fraction=0.0, white_fraction=1.0, leak=0.0, gamma=2.2, vignetting=0.0)
    bent = (
        OpticsRenderer(clean_optics, film, light).render_picture(Pattern("sin", "x"), 0.0) / 65535
    )
    np.testing.assert_allclose(bent, linear**2.2, atol=3e-5)


def test_vignetting_takes_light_from_the_corners(
    clean_optics: OpticsConfig, film: FilmShape
) -> None:
    light = Light(dark_fraction=0.0, white_fraction=1.0, leak=0.0, vignetting=0.3)
    white = OpticsRenderer(clean_optics, film, light).render_picture(Pattern("white"), 0.0) / 65535
    distance2 = ((127 - 127.5) ** 2 + (60 - 152.5) ** 2) / (127.5**2 + 152.5**2)
    assert white[127, 152] == pytest.approx(1.0, abs=1e-4)
    assert white[127, 60] == pytest.approx(1.0 - 0.3 * distance2, abs=1e-4)


def test_a_picture_can_land_in_a_given_buffer(small_optics: OpticsConfig, film: FilmShape) -> None:
    renderer = OpticsRenderer(small_optics, film)
    buffer = renderer.make_blank_picture()
    assert renderer.render_picture(Pattern("white"), 0.0, buffer) is buffer
    assert buffer.max() > 150
    for wrong in (np.empty((10, 10), np.uint8), np.empty((256, 306), np.uint16)):
        with pytest.raises(ValueError, match=r"out is .* not \(256, 306\) uint8"):
            renderer.render_picture(Pattern("white"), 0.0, wrong)


def test_a_film_of_another_radius_is_refused(small_optics: OpticsConfig) -> None:
    with pytest.raises(ValueError, match=r"mirror\.radius_mm = 500"):
        OpticsRenderer(small_optics, FilmShape(37.1, 400.0))


@pytest.mark.parametrize(
    "pattern", [Pattern("gray", "x", 5), Pattern("gray", "x", 0), Pattern("stripes", "x")]
)
def test_unknown_patterns_are_refused(
    small_optics: OpticsConfig, film: FilmShape, pattern: Pattern
) -> None:
    with pytest.raises(ValueError, match="role must be"):
        OpticsRenderer(small_optics, film).render_picture(pattern, 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"white_fraction": 1.2}, "white_fraction = 1.2"),
        ({"dark_fraction": 0.9}, "dark_fraction = 0.9"),
        ({"leak": -0.1}, "leak = -0.1"),
        ({"vignetting": 1.0}, "vignetting = 1.0"),
        ({"gamma": 0.0}, "gamma = 0.0"),
    ],
)
def test_light_that_cannot_be_is_refused_by_its_field(
    change: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Light(**change)


def test_the_sets_have_their_patterns_in_order() -> None:
    full = [p.name for p in pattern_sequence("full", PatternConfig())]
    assert full[:8] == [f"x_sin_{k}" for k in range(4)] + [f"x_gray_{bit}" for bit in range(1, 5)]
    assert full[8:] == [name.replace("x_", "y_") for name in full[:8]] + ["white", "black"]
    fringes = pattern_sequence("fringes", PatternConfig(steps=3))
    assert [p.name for p in fringes] == [
        "x_sin_0",
        "x_sin_1",
        "x_sin_2",
        "y_sin_0",
        "y_sin_1",
        "y_sin_2",
    ]
    assert fringes[2].shift_rad == pytest.approx(4 * np.pi / 3)
    with pytest.raises(ValueError, match="kind = 'half'"):
        pattern_sequence("half", PatternConfig())
