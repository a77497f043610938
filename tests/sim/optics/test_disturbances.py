"""Each disturbance of the twin's pictures is as large as it was asked for, and where and when it
belongs.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import CameraConfig, DisturbancesConfig, OpticsConfig
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.drum_modes import drum_modes
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.pattern_levels import Light
from membrane_ctrl.sim.optics.random_field import RandomField

PLAIN = Light(dark_fraction=0.0, white_fraction=0.5, leak=0.0, vignetting=0.0)
WHITE, BLACK = Pattern("white"), Pattern("black")
FULL = 65535
OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=153, height_px=128, pixel_um=55.2, bits=16, noise_adu=0.0)
)


def crossed(shift_rad: float = 0.0) -> Pattern:
    return Pattern("crossed", "", 4, shift_rad, shift_y_rad=shift_rad)


def bench(
    film: FilmShape, optics: OpticsConfig = OPTICS, drum_nm: float = 0.0, **wanted: float
) -> OpticsRenderer:
    disturbances = DisturbancesConfig.model_validate(wanted)
    return OpticsRenderer(
        optics, film, PLAIN, seed=5, modes=drum_modes(drum_nm), disturbances=disturbances
    )


def lit(film: FilmShape) -> np.ndarray:
    """Pixels that see the screen, away from its edges."""
    picture = bench(film).render_picture(WHITE, 0.0).astype(float)
    eroded = picture > 0
    for axis in (0, 1):
        eroded &= np.roll(picture, 2, axis) > 0
        eroded &= np.roll(picture, -2, axis) > 0
    return np.asarray(eroded)


def gain(film: FilmShape, renderer: OpticsRenderer, pattern: Pattern, time_s: float) -> np.ndarray:
    """Light over that of an undisturbed bench where there is some."""
    seen, plain = (
        renderer.render_picture(pattern, 0.0, time_s=time_s),
        bench(film).render_picture(pattern, 0.0),
    )
    bright = lit(film) & (plain > 0.1 * FULL)
    return np.asarray(seen[bright] / plain[bright])


def test_brightness_wanders_in_space_and_within_minutes(film: FilmShape) -> None:
    renderer = bench(film, brightness_fraction=0.02)
    fields = np.array(
        [gain(film, renderer, WHITE, t) - 1 for t in (0.0, 1.0, *np.arange(300.0, 9000.0, 300.0))]
    )
    assert fields.std() == pytest.approx(0.02, rel=0.25)
    assert fields[0].std() > 0.006  # in space, not as a whole
    assert np.corrcoef(fields[0], fields[1])[0, 1] > 0.9
    assert abs(np.mean([np.corrcoef(a, b)[0, 1] for a, b in pairwise(fields[1:])])) < 0.2


@pytest.mark.parametrize("length_mm", [75.0, 400.0])
def test_waves_have_the_configured_length_and_lose_correlation(length_mm: float) -> None:
    field = RandomField(length_mm, 10.0, 500.0, np.random.default_rng(1))
    x = np.linspace(-490.0, 490.0, 400)
    lines = np.array(
        [
            field.evaluate_at(50.0 * k, x[None], np.full((1, 400), 20.0 * k - 400))[0]
            for k in range(40)
        ]
    )
    assert lines.std() == pytest.approx(1.0, abs=0.15)
    slope = np.diff(lines, axis=1).std() / (
        x[1] - x[0]
    )  # of waves in all directions: 2 pi / length / sqrt 2
    assert slope == pytest.approx(2 * math.pi / length_mm / math.sqrt(2), rel=0.3)


def test_the_screen_dims_by_the_share_of_an_hour(film: FilmShape) -> None:
    assert gain(film, bench(film, dimming_fraction_per_h=0.1), WHITE, 1800.0) == pytest.approx(
        math.exp(-0.05), abs=1e-3
    )


def test_room_light_falls_on_the_mirror_only_and_more_on_one_side(film: FilmShape) -> None:
    seen = bench(film, ambient_fraction=0.1).render_picture(BLACK, 0.0, time_s=0.0) / FULL
    mirror = seen > 0
    assert seen[mirror].mean() == pytest.approx(0.1, abs=0.005)
    assert mirror.mean() == pytest.approx(
        (bench(film).trace_pixels(0.0).on_film(500.0)).mean(), abs=0.01
    )
    left, right = (
        seen[:, half][mirror[:, half]].mean() for half in (slice(0, 76), slice(76, None))
    )
    assert abs(left - right) > 0.01


@pytest.mark.parametrize(
    ("hz", "rolls", "ripple"), [(1000.0, 0.02, 0.0), (1925.0, 0.02, 0.01), (1925.0, 0.0, 0.0)]
)
def test_pulses_of_the_backlight_show_as_stripes_of_a_rolling_shutter(
    film: FilmShape, hz: float, rolls: float, ripple: float
) -> None:
    """20 pulses fit an exposure of 20 ms, 38.5 do not: half a pulse is 0.35 / 38.5 / 0.7 of the
    light.
    """
    renderer = bench(film, backlight_hz=hz, rolling_s=rolls)
    picture = renderer.render_picture(WHITE, 0.0, time_s=0.3) / bench(film).render_picture(
        WHITE, 0.0
    ).clip(1)
    middle = picture[40:90, 70:80].mean(axis=1)
    assert np.ptp(middle) == pytest.approx(ripple, abs=0.0035)


def test_a_panel_keeps_what_it_has_shown_for_hours(film: FilmShape) -> None:
    renderer = bench(film, sticking_fraction=0.05)
    assert gain(film, renderer, crossed(), 0.0) == pytest.approx(
        0.975, abs=1e-3
    )  # of nothing yet: half of it
    after = gain(film, renderer, crossed(), 36_000.0)
    level = bench(film).render_picture(crossed(), 0.0)[
        lit(film) & (bench(film).render_picture(crossed(), 0.0) > 0.1 * FULL)
    ]
    assert after == pytest.approx(1 - 0.05 * level / level.max(), abs=4e-3)
    assert gain(film, renderer, WHITE, 36_000.0) == pytest.approx(1.0, abs=1e-3)


def test_dust_stays_at_one_place_and_then_at_another(film: FilmShape) -> None:
    renderer = bench(film, dust=60)
    first, same, later = (gain(film, renderer, WHITE, t) for t in (1.0, 24.0, 26.0))
    assert np.array_equal(first, same)
    assert not np.array_equal(first, later)
    assert 0.3 < first.min() < 0.8
    assert 0.002 < np.mean(first < 0.9) < 0.1


def test_a_camera_mount_that_grows_moves_the_camera(film: FilmShape) -> None:
    """A quarter of the swing's period after the start it is warmest: 2 K of 60 µm each."""
    seen = (
        bench(film, camera_mount_k=2.0).render_picture(crossed(), 0.0, time_s=300.0).astype(float)
    )
    geometry = OPTICS.geometry.model_copy(update={"a_mm": OPTICS.geometry.a_mm + 0.12})
    there = (
        bench(film, OPTICS.model_copy(update={"geometry": geometry}))
        .render_picture(crossed(), 0.0)
        .astype(float)
    )
    here = bench(film).render_picture(crossed(), 0.0).astype(float)
    on = lit(film)
    assert np.abs(seen - there)[on].max() < 0.05 * np.abs(here - there)[on].max()


def test_warm_air_bends_the_rays_by_the_configured_amount(film: FilmShape) -> None:
    renderer = bench(film, seeing_um=100.0)
    assert renderer._disturber is not None
    moved_mm = np.array([renderer._disturber.ray_disturbance(30.0 * k)[:2] for k in range(40)])
    assert 1e3 * moved_mm.std() == pytest.approx(100.0, rel=0.2)
    assert not renderer._disturber.ray_disturbance(5000.0)[2].any()


def test_rows_of_a_rolling_shutter_see_a_vibration_at_their_own_time(film: FilmShape) -> None:
    rolls, still = bench(film, drum_nm=50_000.0, rolling_s=0.02), bench(film, drum_nm=50_000.0)
    seen = rolls.render_picture(crossed(), 0.0, time_s=1.0).astype(float)
    for row in (40, 64, 90):
        own = still.render_picture(
            crossed(), 0.0, time_s=1.0 + 0.02 * ((row + 0.5) / 128 - 0.5)
        ).astype(float)
        other = still.render_picture(crossed(), 0.0, time_s=1.0).astype(float)
        assert np.abs(seen - own)[row].max() < 0.02 * FULL
        assert row == 64 or np.abs(seen - other)[row].max() > 2 * np.abs(seen - own)[row].max()


def test_equal_seeds_and_times_give_equal_pictures_and_others_do_not(film: FilmShape) -> None:
    every = {
        "brightness_fraction": 0.01,
        "seeing_um": 5.0,
        "dust": 5,
        "sticking_fraction": 0.02,
        "ambient_fraction": 0.01,
    }
    first, again = (
        [bench(film, **every).render_picture(crossed(), 0.0, time_s=3.0)] for _ in range(2)
    )
    assert np.array_equal(first, again)
    renderer = bench(film, **every)
    renderer.seed = 6
    renderer.__post_init__()
    assert not np.array_equal(renderer.render_picture(crossed(), 0.0, time_s=3.0), first[0])


def test_simulate_disturbs_a_tracking_set_and_lists_its_vibrations(tmp_path: Path) -> None:
    config = tmp_path / "bench.toml"
    config.write_text(
        "[twin]\ndrum_nm = 5.0\n[twin.disturbances]\nbrightness_fraction = 0.005\ndust = 3\n"
    )
    words = ["--config", str(config), "--track", "3", "--shrink", "16", "--noise-adu", "0"]
    assert run(["simulate", str(tmp_path / "set"), *words]) == Exit.DONE
    assert run(["simulate", str(tmp_path / "plain"), *words[2:]]) == Exit.DONE
    pictures = [
        (tmp_path / name / "track" / "t_00001.png").read_bytes() for name in ("set", "plain")
    ]
    assert pictures[0] != pictures[1]
    truth = np.load(tmp_path / "set" / "track" / "truth.npz")
    swings = [
        5e-3 * np.sin(2 * math.pi * m.frequency_hz * truth["time_s"] + m.lobes)
        for m in drum_modes(1.0)
    ]
    assert truth["drum_um"] == pytest.approx(np.stack(swings, axis=1))
    assert "drum_um" not in np.load(tmp_path / "plain" / "track" / "truth.npz")


@pytest.mark.parametrize(
    "line", ["brightness_fraction = -0.1", "dust = 2.5", "rolling_s = nan", "haze = 1"]
)
def test_an_impossible_disturbance_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str
) -> None:
    config = tmp_path / "bench.toml"
    config.write_text(f"[twin.disturbances]\n{line}\n")
    assert run(["simulate", str(tmp_path / "set"), "--config", str(config)]) == Exit.BAD_INPUT
    (lines,) = capsys.readouterr().err.strip().splitlines()
    assert f"twin.disturbances.{line.split()[0]}" in lines
    assert not (tmp_path / "set").exists()
