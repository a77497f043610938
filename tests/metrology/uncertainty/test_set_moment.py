"""The sag of a set whose film moves while no laser reads its place."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.metrology.uncertainty.set_moment import (
    left_out_sigma_um,
    moment_sigma_um,
    step_sigma_um,
)
from tests.studies.second_world_errors import MeasuredErrors, drawn_points_mm, measured_errors
from tests.worlds.second_optics import FRAME_S, Bench, Effects, Mirror, World

FRAMES = 18
SINUSOIDS = (np.arange(4.0), np.arange(8.0, 12.0))
MOVED_UM = 5.0
Course = Callable[[float], float]
COURSES: dict[str, Course] = {
    "linear": lambda time_s: MOVED_UM * time_s / ((FRAMES - 1) * FRAME_S),
    "step": lambda time_s: MOVED_UM * (time_s > 1.5 * FRAME_S),
    "oscillating": lambda time_s: MOVED_UM / 2 * math.sin(2 * math.pi * time_s / 0.64),
}
# at any time between the last sinusoid of x and the first of y: the sinusoids show no motion
BETWEEN: dict[str, Course] = {
    f"between the axes, before frame {frame}": lambda time_s, frame=frame: (  # type: ignore[misc]
        MOVED_UM * (time_s > (frame - 0.5) * FRAME_S)
    )
    for frame in (4, 8)
}


def places_um(course: Course) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Of the film at all frames."""
    return np.array([course(FRAME_S * k) for k in range(FRAMES)])


def about_means(course: Course) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """At the sinusoids, each axis about its own mean, as the fringes show it."""
    seen = [places_um(course)[axis.astype(int)] for axis in SINUSOIDS]
    return np.concatenate([axis - axis.mean() for axis in seen])


def moment_um(course: Course) -> float:
    """The film's mean place over the set less that over the sinusoids."""
    every = places_um(course)
    used = np.concatenate(SINUSOIDS).astype(int)
    return float(every.mean() - every[used].mean())


@pytest.mark.parametrize("name", COURSES)
def test_the_sigma_is_as_large_as_what_the_film_moves_beyond_the_sinusoids(name: str) -> None:
    course = COURSES[name]
    sigma_um = moment_sigma_um(SINUSOIDS, about_means(course), 0.1, FRAMES)
    assert abs(moment_um(course)) < 1.2 * sigma_um < 1.6


def test_a_film_at_rest_has_the_sigma_of_the_fringes_noise() -> None:
    random, found = np.random.default_rng(1), []
    for _ in range(50):
        noise = random.normal(0, 0.1, 8)
        centred = np.concatenate([axis - axis.mean() for axis in np.split(noise, [4])])
        found.append(moment_sigma_um(SINUSOIDS, centred, 0.1, FRAMES))
    assert 0.1 < np.mean(found) < 0.25


def measured(course: Course | None, folder: Path, seed: int) -> MeasuredErrors:
    """Errors of a set without a laser."""
    effects = Effects(laser=False, film_motion_um=course)
    world = World(Mirror(), Bench.paper(0.125), effects, seed=seed)
    truth = world.write_set(folder)
    points_mm = drawn_points_mm(np.random.default_rng(1), 20)
    return measured_errors(folder, world.mirror, truth, points_mm)


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory: pytest.TempPathFactory) -> MeasuredErrors:
    """The set before, with which each moving film is compared."""
    return measured(None, tmp_path_factory.mktemp("at-rest"), seed=1)


@pytest.mark.fast_cases("linear", "step", "between the axes, before frame 8")
@pytest.mark.parametrize("name", COURSES | BETWEEN)
def test_a_change_of_the_sag_is_within_its_bar_whatever_moment_is_meant(
    name: str, tmp_path: Path, at_rest: MeasuredErrors
) -> None:
    """Film that moved by 5 µm during a set without a laser: the sag was 2 sigma off its mean over
    the set.
    """
    moving_film = (COURSES | BETWEEN)[name]
    moving = measured(moving_film, tmp_path / "moving", seed=2)
    assert at_rest.error_um is not None
    assert moving.error_um is not None
    error_um = moving.error_um - at_rest.error_um
    ratio = error_um / moving.change_sigma_um(at_rest)
    assert np.abs(ratio).max() < 2.0
    of_mean_um = error_um[0] - moment_um(moving_film)
    assert abs(of_mean_um) < 1.1 * moving.change_sigma_um(at_rest)[0]


def test_a_step_between_the_axes_may_have_been_at_any_time_between_them() -> None:
    """Mean over the times at which the film may have stepped, of what the sinusoids do not show."""
    away_um = []
    for frame in range(4, 9):
        place_um = MOVED_UM * (np.arange(FRAMES) >= frame)
        used = np.concatenate(SINUSOIDS).astype(int)
        away_um.append(place_um.mean() - place_um[used].mean())
    sigma_um = step_sigma_um(SINUSOIDS, MOVED_UM, 0.0, FRAMES)
    assert sigma_um == pytest.approx(float(np.sqrt(np.mean(np.square(away_um)))), rel=0.1)
    assert step_sigma_um(SINUSOIDS, 2.0, 2.5, FRAMES) == 0.0  # no more than chance


def test_a_left_out_frame_leaves_the_laser_s_noise() -> None:
    """Mean of seven readings less that of all eight, over many sets."""
    readings_um = np.random.default_rng(1).normal(0.0, 1.5, (20_000, 8))
    apart_um = readings_um[:, :7].mean(axis=1) - readings_um.mean(axis=1)
    assert left_out_sigma_um(7, 8, 1.5) == pytest.approx(float(apart_um.std()), rel=0.02)
    assert left_out_sigma_um(8, 8, 1.5) == 0.0


def test_a_stale_frame_while_the_film_moves_is_in_the_bar_of_a_change(tmp_path: Path) -> None:
    """The change of the sag was 5.5 sigma off: the laser's noise moved the film's mean place."""
    places_um = np.cumsum(np.random.default_rng(4).normal(0.0, 4.0, (2, FRAMES)), axis=1)
    points_mm = drawn_points_mm(np.random.default_rng(1), 5)
    mirror, found = Mirror(), []
    for k in range(2):
        walk = places_um[k]
        effects = Effects(
            film_motion_um=lambda time_s, walk=walk: float(walk[round(time_s / FRAME_S)]),
            stale_frame=2,
        )
        world = World(mirror, Bench.paper(0.125), effects, seed=k)
        truth = world.write_set(tmp_path / f"set{k}")
        found.append(measured_errors(tmp_path / f"set{k}", mirror, truth, points_mm))
    first, second = found
    assert first.error_um is not None
    assert second.error_um is not None
    sigma_um = second.change_sigma_um(first)[0]
    assert abs(second.error_um[0] - first.error_um[0]) < 3 * sigma_um
    assert 0.15 < sigma_um < 0.5
