"""Live cycles while camera, screen or film move, by frames of a world of its own rays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.measure.measurement import Figures
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from tests.studies.tracked_errors import CLEAN, SIZE
from tests.worlds.crossed_fringes import PERIODS, SIDE_MM, Array, _full
from tests.worlds.moving_bench import MovingBench

MOVES_S = 10.0  # the full cycle is before it
SINUSOIDS = [0, 1, 2, 3, 8, 9, 10, 11]
Film = Callable[[Array, Array, float], Array]


@pytest.fixture(scope="module")
def optics(tmp_path_factory: pytest.TempPathFactory) -> OpticsConfig:
    folder = tmp_path_factory.mktemp("cycle") / "full"
    MovingBench(seed=1, **SIZE | CLEAN).write_reference(folder)  # type: ignore[arg-type]
    return Figures().measure_folder(folder).head.optics


def frames_of(world: MovingBench, at_s: float) -> list[NDArray[np.uint8]]:
    """The 18 frames of a full cycle, all at one time."""
    return [world.frame(at_s, pattern) for _, _, pattern in _full(SIDE_MM / PERIODS)]


def cycles(
    optics: OpticsConfig, times_s: tuple[float, ...], world: MovingBench
) -> tuple[ShapeEstimate, list[ShapeEstimate]]:
    """A full cycle at time 0, and fringes-only ones later; no laser."""
    live = LiveReconstructor(optics, 1)
    none = np.full(18, np.nan)
    first = live.measure_full(frames_of(world, 0.0), 0.1 * np.arange(18), none)
    later = []
    for at_s in times_s:
        frames = [frame for k, frame in enumerate(frames_of(world, at_s)) if k in SINUSOIDS]
        later.append(live.measure_fringes(frames, at_s + 0.1 * np.arange(8), none[:8]))
    return first, later


def moved(optics: OpticsConfig, part: str, amount: float) -> tuple[ShapeEstimate, ShapeEstimate]:
    """The full cycle and one after a part of the bench has moved."""
    course = {part: lambda t: amount * (t > MOVES_S / 2)}
    world = MovingBench(seed=3, **SIZE | CLEAN, motions=course)  # type: ignore[arg-type]
    first, (later,) = cycles(optics, (MOVES_S,), world)
    assert first.verdict == "ok", first.reason
    return first, later


def worst_sigmas(first: ShapeEstimate, later: ShapeEstimate, true_um: Array) -> float:
    """Largest error of the terms' change from defocus on."""
    variance = np.diag(first.covariance_um2) + np.diag(later.covariance_um2)
    error = later.coeffs_um - first.coeffs_um - true_um
    return float(np.abs(error / np.sqrt(variance))[3:].max())


@pytest.mark.fast_cases("camera_ry-5.0", "screen_x-10.0", "camera_z-50.0")
@pytest.mark.parametrize(
    ("part", "amount"),
    [
        ("camera_ry", 5.0),
        ("camera_rx", 20.0),
        ("camera_rz", 50.0),
        ("screen_x", 10.0),
        ("camera_z", 50.0),
        ("screen_z", 50.0),
    ],
)
def test_a_small_motion_is_within_the_error_bars(
    optics: OpticsConfig, part: str, amount: float
) -> None:
    first, later = moved(optics, part, amount)
    assert worst_sigmas(first, later, np.zeros(36)) < 4.0


@pytest.mark.fast_cases("camera_ry-50.0-tilted", "screen_rz-400.0-rolled")
@pytest.mark.parametrize(
    ("part", "amount", "word"),
    [("camera_ry", 50.0, "tilted"), ("camera_rz", 400.0, "rolled"), ("screen_rz", 400.0, "rolled")],
)
def test_a_large_motion_degrades_one_cycle_and_the_next_is_the_reference(
    optics: OpticsConfig, part: str, amount: float, word: str
) -> None:
    course = {part: lambda t: amount * (t > MOVES_S / 2)}
    world = MovingBench(seed=3, **SIZE | CLEAN, motions=course)  # type: ignore[arg-type]
    _, (before, after, next_one, last) = cycles(optics, (2.0, MOVES_S, 12.0, 14.0), world)
    assert [one.verdict for one in (before, after, next_one, last)] == [
        "ok",
        "degraded",
        "ok",
        "ok",
    ]
    assert word in after.reason


@pytest.mark.parametrize(
    "film",
    [
        lambda x, y, t: 1.0 * x * (1 - x * x - y * y) * (t > MOVES_S / 2),
        lambda x, y, t: -20.0 * (1 - x * x - y * y) * (t > MOVES_S / 2),
        lambda x, y, t: 0.3 * y * (t > MOVES_S / 2),
    ],
    ids=["coma", "sag", "tilt"],
)
def test_a_film_that_changes_is_no_knock(optics: OpticsConfig, film: Film) -> None:
    world = MovingBench(seed=3, **SIZE | CLEAN, film_um=film)  # type: ignore[arg-type]
    _, (later,) = cycles(optics, (MOVES_S,), world)
    assert (later.verdict, later.reason) == ("ok", "")
