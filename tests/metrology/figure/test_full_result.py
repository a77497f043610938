"""Every pixel: accuracy against the twin's truth, from frames to height."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.pixel_figure import (
    FullResult,
    measure_pixels,
    reconstruct_full,
    tukey_weights,
)
from membrane_ctrl.metrology.figure.set_motion import FilmMotion
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction, make_parabola
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import Bump, FilmShape, Ripple
from tests.studies import measured_sets
from tests.studies.tracked_errors import rms
from tests.support.metrology_truth import cone, v_fold
from tests.support.rendered_sets import FILM, bench, good_set, patterns, stack_of

X, Y = np.meshgrid(*[np.linspace(-475, 475, 81)] * 2)
INSIDE = np.hypot(X, Y) <= 475


def measured(
    stack: FrameStack, optics: OpticsConfig, start: HeightFunction | None = None
) -> FullResult:
    """Frames to the full result."""
    checked = check_set(stack, optics)
    return reconstruct_full(optics, checked, measure_pixels(optics, checked), start)


def surface_error_um(surface: Surface, film: FilmShape, displacement_um: float = 0.0) -> np.ndarray:
    """Fit minus truth inside the analysis radius."""
    return 1e3 * (surface.height(X, Y) - film.height_mm(X, Y, displacement_um))[INSIDE]


def map_error_um(result: FullResult, film: FilmShape) -> np.ndarray:
    """Zonal map minus truth where it was measured."""
    x, y = np.meshgrid(result.grid.axis_mm, result.grid.axis_mm)
    error = 1e3 * (result.height_mm() - film.height_mm(x, y))
    return error[np.isfinite(error)]


def exact_pixels(film: FilmShape, optics: OpticsConfig) -> FullResult:
    """The full result from exact screen points instead of frames."""
    checked = check_set(good_set(optics, film), optics)
    pixels = measure_pixels(optics, checked)
    traced = OpticsRenderer(optics, film, exact=True).trace_pixels(0.0)
    pixels.points.screen_mm[:] = np.stack([traced.s_x_mm, traced.s_y_mm])[:, pixels.index]
    return reconstruct_full(optics, checked, pixels)


def test_a_shape_of_36_terms_comes_back_to_a_nanometre() -> None:
    film = FilmShape(37.1, 500.0, bowl="paraboloid", zernike_um=FILM.zernike_um)
    result = exact_pixels(film, bench())
    assert np.max(np.abs(surface_error_um(result.surface, film))) <= 1e-3  # 1e-6 mm


def test_16_bit_frames_without_noise_cost_little_more() -> None:
    """Rounding to 1/65535 at an amplitude of 25000 is 1e-5 rad a pixel; the fit averages 30 000 of
    them.
    """
    film = FilmShape(37.1, 500.0, bowl="paraboloid", zernike_um=FILM.zernike_um)
    optics = bench(bits=16, noise_adu=0.0)
    error = surface_error_um(measured(good_set(optics, film), optics).surface, film)
    assert np.max(np.abs(error)) <= 0.01


def test_a_hencky_bowl_with_millimetres_of_figure() -> None:
    zernike = [0.0] * ZERNIKE_TERMS
    zernike[4], zernike[5], zernike[6], zernike[8] = 1000.0, -1500.0, 800.0, 400.0
    film = FilmShape(37.0, 500.0, zernike_um=tuple(zernike))
    optics = bench(bits=16, noise_adu=0.0)
    error = surface_error_um(measured(good_set(optics, film), optics).surface, film)
    assert float(np.sqrt(np.mean(error**2))) <= 0.1
    assert np.max(np.abs(error)) <= 0.5


@pytest.mark.fast_cases("deep", "V-fold")
@pytest.mark.parametrize(
    "start",
    [
        make_parabola(10.0, 500.0),
        make_parabola(100.0, 500.0),
        cone(40.0, 500.0),
        v_fold(40.0, 500.0),
    ],
    ids=["shallow", "deep", "cone", "V-fold"],
)
def test_all_starts_agree(start: HeightFunction) -> None:
    optics = bench()
    stack = good_set(optics)
    checked = check_set(stack, optics)
    first = reconstruct_full(optics, checked, measure_pixels(optics, checked))
    other = reconstruct_full(optics, checked, measure_pixels(optics, checked), start)
    assert np.max(np.abs((first.surface.height(X, Y) - other.surface.height(X, Y))[INSIDE])) <= 1e-9
    assert first.fit.changes_mm[-1] <= 1e-6
    assert first.fit.changes_mm[3] <= 1e-5  # the way from 40 mm


def test_noise_repeats_to_ten_nanometres() -> None:
    """On 1/16 of the pixels noise counts four times: 40 nm here are the 10 nm of a full picture."""
    optics = bench(shrink=4)
    maps = [
        measured(good_set(optics, seed=seed), optics).surface.height(X, Y)[INSIDE]
        for seed in (1, 2)
    ]
    assert 1e6 * float(np.std(maps[0] - maps[1])) / math.sqrt(2) <= 40.0


def test_motion_is_removed_from_the_phase() -> None:
    """From frame to frame of an axis by the fringes, from x to y by the laser, whose noise is a
    micrometre.
    """
    optics, rng = bench(), np.random.default_rng(2)
    stack = good_set(optics, motion_um=lambda t: 5 * math.sin(2 * math.pi * 0.3 * t))
    mean_um, noise_um = stack.mean_reading_um, rng.standard_normal(len(stack.patterns))
    with_noise = measured(replace(stack, displacement_um=stack.displacement_um + noise_um), optics)
    silent = FrameStack(stack.frames, stack.patterns, np.full(len(stack.patterns), np.nan), {})
    untold = measured(silent, optics)
    assert with_noise.moved
    assert untold.moved
    with_laser = float(np.std(surface_error_um(with_noise.surface, FILM, mean_um)))
    without = float(np.std(surface_error_um(untold.surface, FILM, mean_um)))
    assert with_laser <= 0.15
    assert without > 4 * with_laser


@pytest.mark.fast_cases("rest", "turning")
@pytest.mark.parametrize(
    ("motion_um", "most_um", "most_left_um"),
    [
        (lambda _: 0.0, 0.2, 0.01),
        (lambda t: 2.0 * t, 0.77, 0.14),
        (lambda t: 6.0 * t, 0.8, 0.15),
        (lambda t: 1.5 * math.cos(math.pi * t / 0.8), 1.0, 0.26),
    ],
    ids=["rest", "slow", "fast", "turning"],
)
def test_noisy_pictures_move_no_film_and_hide_no_motion(
    motion_um: Callable[[float], float], most_um: float, most_left_um: float
) -> None:
    """The laser shows a motion from x to y with a noise of 0.7 µm, most of which was taken out of a
    film at rest.
    """
    optics, rng, off_um, sigma_um, left_um, film_um = (
        bench(noise_adu=3.0),
        np.random.default_rng(6),
        [],
        [],
        [],
        [],
    )
    for seed in (1, 2, 3):
        stack = good_set(optics, motion_um=motion_um, seed=seed)
        checked, place_um = check_set(stack, optics), stack.displacement_um
        for _ in range(30):
            noisy = replace(
                checked.stack, displacement_um=place_um + rng.standard_normal(place_um.size)
            )
            film = FilmMotion.from_set(replace(checked, stack=noisy))
            found_um = [axis_um * film.is_worth_correcting for axis_um in film.motion_um]
            off = [
                axis_um - place_um[used]
                for axis_um, used in zip(found_um, checked.view.used, strict=True)
            ]
            off_um.append(off[0].mean() - off[1].mean())
            sigma_um.append(
                math.hypot(film.x_to_y_sigma_um, found_um[0].mean() - film.motion_um[0].mean())
            )
            left_um += [np.std(one) for one in off]
        budget = measured_sets.measured_checked(checked, optics)[1].budget
        film_um.append(next(source.sigma for source in budget.sources if source.name == "film_um"))
    assert rms(off_um) <= most_um
    assert rms(np.divide(off_um, sigma_um)) <= 1.45
    assert rms(left_um) <= 1.1 * rms(film_um) <= 0.35
    assert rms(left_um) <= most_left_um


@pytest.mark.parametrize(("flicker", "swing_um"), [(0.02, 0.0), (0.0, 14.0)], ids=["lamp", "film"])
def test_the_frames_show_what_light_they_had_and_where_the_film_was(
    flicker: float, swing_um: float
) -> None:
    """Beside the light of their own axis, in which both leave waves, they would say a tenth too
    little.
    """
    optics, rng, shown = bench(), np.random.default_rng(4), patterns(bench())
    renderer, place_um = (
        OpticsRenderer(optics, FILM, seed=1),
        swing_um * np.sin(0.4 * np.arange(len(shown))),
    )
    gains = 1 + flicker * rng.standard_normal(len(shown))
    frames = [
        renderer.render_picture(*one, gain=gain)
        for *one, gain in zip(shown, place_um, gains, strict=True)
    ]
    checked = check_set(stack_of(np.stack(frames), shown), optics)
    light = np.ones((2, len(gains))) if checked.stack.light is None else checked.stack.light
    for used, seen_um in zip(checked.view.used, np.split(checked.film_um, 2), strict=True):
        assert light[1, used] == pytest.approx(
            gains[used] / gains[used].mean(), abs=4e-4 if flicker else 1e-12
        )
        true_um = place_um[used] - place_um[used].mean()
        assert seen_um - seen_um.mean() == pytest.approx(true_um, abs=0.3)
    assert checked.light_left < 3e-4 + (swing_um > 0) * 1e-3


@pytest.mark.parametrize(("flicker", "drift"), [(0.02, 0.0), (0.0, 0.05)], ids=["lamp", "ambient"])
def test_light_that_differs_between_the_frames_is_corrected(flicker: float, drift: float) -> None:
    """Two hundredths of flicker bend the figure by 0.3 µm, an ambient light that grows by a
    twentieth by 0.14.
    """
    optics, rng = bench(), np.random.default_rng(8)
    stack = good_set(optics)
    quiet = measured(stack, optics).surface.height(X, Y)
    white = stack.frames[-2].astype(float)
    for k, frame in enumerate(stack.frames):
        lit = frame * (1 + flicker * rng.standard_normal()) + drift * white / 2 * k / len(
            stack.frames
        )
        stack.frames[k] = np.clip(np.rint(lit), 0, 255)
    uneven = measured(stack, optics)
    assert (
        1e3 * float(np.std((uneven.surface.height(X, Y) - quiet)[INSIDE])) <= 0.08
    )  # of new noise: 0.03
    assert uneven.quality.residual_urad < 6  # of noise; 15 with the light left in


def test_ripple_and_dent_are_in_the_map_and_not_in_the_fit() -> None:
    film = FilmShape(
        37.1, 500.0, ripples=(Ripple(1.0, 80.0, 30.0),), bumps=(Bump(-2.0, 120.0, -60.0, 25.0),)
    )
    optics = bench(shrink=4)
    result = measured(good_set(optics, film), optics)
    # cells of 2 mm: the vertex' own ripple is an offset of all
    error = map_error_um(result, film)
    assert float(np.std(error)) <= 0.05
    assert float(np.std(surface_error_um(result.surface, film))) > 0.5
    middle = result.grid.axis_mm.size // 2
    assert result.height_mm()[middle, middle] == pytest.approx(0.0, abs=1e-12)


def test_dust_has_no_weight() -> None:
    optics, rng = bench(), np.random.default_rng(5)
    stack = good_set(optics)
    clean = measured(stack, optics).surface.height(X, Y)
    for row, column in zip(rng.integers(0, 250, 60), rng.integers(0, 300, 60), strict=True):
        stack.frames[::2, row : row + 3, column : column + 3] //= 2  # a glint that comes and goes
    dusty = measured(stack, optics)
    assert 1e3 * float(np.max(np.abs((dusty.surface.height(X, Y) - clean)[INSIDE]))) <= 0.2
    assert np.count_nonzero(dusty.weights == 0) > 20


def test_tukey_keeps_noise_and_drops_outliers() -> None:
    residual = np.abs(np.random.default_rng(1).normal(size=10_000))
    residual[::100] = 50.0
    weights = tukey_weights(residual)
    assert np.all(weights[::100] == 0)
    assert np.median(weights) > 0.95


def test_fringes_lean_on_their_reference() -> None:
    optics = bench()
    full = good_set(optics)
    anchor = check_set(full, optics).make_anchor()
    sinusoids = [k for k, p in enumerate(full.patterns) if p.role == "sin"]
    moved = good_set(optics, motion_um=lambda _t: 30.0, seed=2)
    stack = FrameStack(
        moved.frames[sinusoids],
        tuple(full.patterns[k] for k in sinusoids),
        moved.displacement_um[sinusoids],
        {},
    )
    geometry = optics.geometry.model_copy(update={"reference_displacement_um": 0.0})
    optics = optics.model_copy(update={"geometry": geometry})
    checked = check_set(stack, optics, anchor)
    result = reconstruct_full(optics, checked, measure_pixels(optics, checked))
    assert float(np.std(surface_error_um(result.surface, FILM, 30.0))) <= 0.1
