"""Tracked figures while camera, screen, lens or mirror move: the figure's bar contains what the
motion does to it, and a motion that is proven is named; a film that moves is none.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.cli import run
from tests.studies.tracked_errors import CLEAN, SIZE, TrackedErrors, compared
from tests.worlds.crossed_fringes import Array
from tests.worlds.moving_bench import MovingBench

FRAME_S, BEGINS_S = 0.43, 2.8  # after the five steps that anchor the frames
FRAMES = 9
Film = Callable[[Array, Array, float], Array]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("moving")
    MovingBench(seed=1, **SIZE | CLEAN).write_reference(folder / "full")  # type: ignore[arg-type]
    assert run(["measure", str(folder / "full"), "--no-pictures"]) == 0
    return folder


def tracked(reference: Path, folder: Path, world: MovingBench, first_steps: int) -> TrackedErrors:
    """Errors of the frames of a world against the figure of the reference."""
    shutil.copytree(reference / "full", folder / "full")
    times = 0.5 + FRAME_S * np.arange(FRAMES)
    world.write_track(folder / "track", times, math.inf, first_steps=first_steps)
    assert run(["track", str(folder / "track"), "--no-pictures"]) == 0
    return compared(world, folder)


def moved(
    reference: Path, folder: Path, part: str, course: Callable[[float], float], steps: int = 5
) -> TrackedErrors:
    """Errors while a part of the bench follows a course."""
    world = MovingBench(seed=2, **SIZE | CLEAN, motions={part: course})  # type: ignore[arg-type]
    return tracked(reference, folder, world, steps)


def changed(reference: Path, folder: Path, film: Film) -> TrackedErrors:
    """Errors while the film changes and the bench rests."""
    world = MovingBench(seed=2, **SIZE | CLEAN, film_um=film)  # type: ignore[arg-type]
    return tracked(reference, folder, world, 5)


def worst_of_ok(found: TrackedErrors) -> float:
    """Largest error of an `ok` frame in sigmas: terms from astigmatism on, and the sag."""
    ok = np.array(found.verdicts)[found.given] == "ok"
    figures = np.abs(found.moved_terms[ok, 2:])
    return float(max(figures.max(initial=0.0), np.abs(found.moved_sag[ok]).max(initial=0.0)))


@pytest.mark.fast_cases("camera_ry-5.0", "screen_z-10.0", "mirror_x-5.0", "sensor_x-0.1")
@pytest.mark.parametrize(
    ("part", "amount"),
    [
        ("camera_ry", 5.0),
        ("camera_rx", 5.0),
        ("camera_rz", 30.0),
        ("camera_x", 10.0),
        ("screen_y", 10.0),
        ("screen_z", 10.0),
        ("screen_rz", 30.0),
        ("mirror_x", 5.0),
        ("sensor_x", 0.1),
    ],
)
def test_a_small_motion_is_within_the_error_bars(
    reference: Path, tmp_path: Path, part: str, amount: float
) -> None:
    """A camera that turned by 5 µrad moved Z8 by 10 sigma in frames called ok."""
    found = moved(reference, tmp_path, part, lambda t: amount * (t > BEGINS_S))
    assert worst_of_ok(found) < 4.0


@pytest.mark.fast_cases(
    "camera_ry-<lambda>-knocked",
    "camera_rx-<lambda>-camera turned",
    "screen_x-<lambda>-screen shifted",
    "camera_rz-<lambda>-rolled",
)
@pytest.mark.parametrize(
    ("part", "course", "word"),
    [
        ("camera_ry", lambda t: 50.0 * (t > BEGINS_S), "knocked"),
        ("camera_ry", lambda t: 50.0 * (t > 0.2), "camera turned"),  # before the first
        ("camera_rx", lambda t: 15.0 * t, "camera turned"),  # a mount that bends
        ("screen_x", lambda t: 40.0 * (t > 0.2), "screen shifted"),
        ("screen_rz", lambda t: 200.0 * (t > BEGINS_S), "rolled"),
        ("camera_rz", lambda t: 200.0 * (t > 0.2), "rolled"),
    ],
)
def test_a_large_motion_degrades_the_frames(
    reference: Path, tmp_path: Path, part: str, course: Callable[[float], float], word: str
) -> None:
    found = moved(reference, tmp_path, part, course)
    assert found.verdicts[-1] == "degraded", found.reasons[-1]
    assert word in found.reasons[-1]
    assert worst_of_ok(found) < 4.0
    assert np.abs(found.moved_terms[-1, 2:]).max() < 4.0


@pytest.mark.fast_cases("60.0-camera_z", "1500.0-screen_z", "1500.0-mirror_z")
@pytest.mark.parametrize("part", ["camera_z", "screen_z", "mirror_z", "focal"])
@pytest.mark.parametrize("amount", [60.0, pytest.param(400.0, marks=pytest.mark.campaign), 1500.0])
def test_a_motion_along_an_axis_is_within_the_bars_or_degraded(
    reference: Path, tmp_path: Path, part: str, amount: float
) -> None:
    """1500 µm gave `ok` frames that were 106 sigma off."""
    found = moved(reference, tmp_path, part, lambda t: amount * (t > BEGINS_S))
    assert worst_of_ok(found) < 4.0


@pytest.mark.parametrize(
    ("part", "amount", "word"),
    [
        ("focal", 800.0, "focal"),
        ("mirror_rz", 800.0, "mirror rolled"),
    ],
)
def test_a_hidden_motion_that_is_proven_is_named(
    reference: Path, tmp_path: Path, part: str, amount: float, word: str
) -> None:
    found = moved(reference, tmp_path, part, lambda t: amount * (t > BEGINS_S))
    assert found.verdicts[-1] == "degraded", found.reasons[-1]
    assert word in found.reasons[-1]


def clamped(x: Array, y: Array) -> Array:
    """0 at the ring, where the film is held."""
    return np.asarray(1 - x * x - y * y)


@pytest.mark.fast_cases("coma", "vibration", "tilt")
@pytest.mark.parametrize(
    "film",
    [
        lambda x, y, t: 1.0 * x * clamped(x, y) * (t > BEGINS_S),
        lambda x, y, t: 1.0 * (x * x - y * y) * clamped(x, y) * (t > BEGINS_S),
        lambda x, y, t: -5.0 * t * clamped(x, y),
        lambda x, y, t: 0.5 * np.sin(9.0 * t) * x * y * clamped(x, y),
        lambda x, y, t: 0.3 * y * (t > BEGINS_S),  # tilts, as a mirror does
    ],
    ids=["coma", "astigmatism", "sag", "vibration", "tilt"],
)
def test_a_film_that_changes_is_no_knock(reference: Path, tmp_path: Path, film: Film) -> None:
    found = changed(reference, tmp_path, film)
    assert set(found.verdicts) == {"ok"}, found.reasons
    assert worst_of_ok(found) < 4.0
    # the bars of a clamped film do not contain a motion of the bench that frames show
    assert np.median(found.terms_sigma_um[-1, 2:]) < 0.015
    assert np.max(found.steady_terms_sigma_um[-1, 2:]) < 0.05
