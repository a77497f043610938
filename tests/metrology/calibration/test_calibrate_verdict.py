"""Bad input of a calibration: each fault is named, and alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from membrane_ctrl.metrology.calibration.model_tests import (
    compare_left_out_sets,
    find_camera_bumps,
    find_suspects,
)
from membrane_ctrl.metrology.calibration.solver import solve_calibration
from membrane_ctrl.metrology.calibration.verdict import (
    CalibrationFinding,
    check_before_solving,
    check_solution,
)
from membrane_ctrl.metrology.cycle.geometry_monitors import CYCLES, DriftMonitor
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, prior_sigmas
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from tests.support.calibration_truth import SAGS_MM, Truth, make

SIGMAS = prior_sigmas()
VALUES = SIGMAS * np.random.default_rng(3).normal(size=len(NAMES))
Edit = Callable[[SetPhases], SetPhases]


@cache
def good() -> Truth:
    return make(VALUES, 3, points=600)


def yawed(degrees: float, *which: int) -> Truth:
    other = VALUES.copy()
    other[NAMES.index("camera_yaw_deg")] += degrees
    return make(VALUES, 3, points=600, bumped=dict.fromkeys(which, other))


def judged(
    truth: Truth, sets: tuple[SetPhases, ...] | None = None
) -> tuple[CalibrationFinding, ...]:
    problem = truth.problem(SIGMAS, sets)
    return check_before_solving(problem) or check_solution(solve_calibration(problem))


def edited(edit: Edit, *which: int) -> tuple[SetPhases, ...]:
    return tuple(edit(phases) if k in which else phases for k, phases in enumerate(good().sets))


def reading(change: Callable[[float], float]) -> Edit:
    return lambda phases: replace(phases, displacement_um=change(phases.displacement_um))


ALL_SETS = tuple(range(len(SAGS_MM)))


def test_good_sets_have_nothing_against_them() -> None:
    assert judged(good()) == ()
    solution = solve_calibration(good().problem(SIGMAS))
    assert find_suspects(solution) == ()
    assert find_camera_bumps(solution) == ()
    assert all(each.fall < 3 * each.freedom for each in compare_left_out_sets(solution))


@pytest.mark.parametrize(
    ("edit", "which", "message"),
    [
        (reading(lambda d: -d), ALL_SETS, "the laser counts the wrong way"),
        (reading(lambda d: 10 * d), ALL_SETS, "the laser's unit or scale is wrong"),
        (reading(lambda d: 1.02 * d), ALL_SETS, "the laser's scale is wrong: the optics see 0.98"),
        (
            reading(lambda d: d / 1000),
            ALL_SETS,
            "the laser's unit or scale is wrong, or it is stuck: its readings are 8",
        ),
        (
            reading(lambda d: 7.0),
            ALL_SETS,
            "the laser's unit or scale is wrong, or it is stuck: its readings are 0 µm",
        ),
        (reading(lambda d: d + 50), (1,), "set1 disagrees with all the others: its laser reads +"),
    ],
)
def test_laser_faults_are_reported(edit: Edit, which: tuple[int, ...], message: str) -> None:
    (finding,) = judged(good(), edited(edit, *which))
    assert finding.fatal
    assert finding.description.startswith(message)


@pytest.mark.parametrize(
    ("edit", "which", "message"),
    [
        (
            reading(lambda d: d + 50),
            (1,),
            "the film moved by 9 µm RMS while set1 was taken: hold it still",
        ),
        (reading(lambda d: 1.02 * d), ALL_SETS, "the laser's scale is wrong: the optics see 0.98"),
    ],
)
def test_only_a_moved_film_is_reported_unless_the_sets_at_rest_show_a_cause(
    edit: Edit, which: tuple[int, ...], message: str
) -> None:
    sets = list(edited(edit, *which))
    sets[1] = replace(sets[1], moved_um=9.0)
    (finding,) = judged(good(), tuple(sets))
    assert finding.fatal
    assert finding.description.startswith(message)
    assert "or:" not in finding.description


def test_sets_that_are_too_close_are_refused() -> None:
    (finding,) = judged(make(VALUES, 3, points=800, sags_mm=(36.8, 37.0, 37.2)))
    assert finding.fatal
    assert finding.description.startswith("the sets are only 400 µm apart")
    assert "at least 1 mm" in finding.description


def test_without_a_laser_fringes_and_ring_show_it() -> None:
    silent = edited(reading(lambda d: float("nan")), 1, 2, 3, 4)
    held = good().problem(prior_sigmas({"laser_relative": 0.0}), silent)
    solution = solve_calibration(held)
    (finding,) = check_before_solving(held) or check_solution(solution)
    assert not finding.fatal
    assert "the sag rests on fringes and ring alone" in finding.description
    error = (solution.values - VALUES)[:11] / solution.sigmas[:11]
    assert np.sqrt(np.mean(error**2)) < 2


def test_a_bumped_camera_is_reported_with_its_turn() -> None:
    (finding,) = judged(yawed(0.02, 3, 4))
    assert finding.fatal
    assert finding.sets == (3, 4)
    assert finding.description.startswith("the camera had moved from set3 on: yaw +0.0")


def test_a_camera_bumped_and_put_back_is_reported() -> None:
    (finding,) = judged(yawed(0.02, 2))
    assert finding.fatal
    assert finding.description.startswith("the camera had moved in set2")


@pytest.mark.campaign
def test_a_camera_that_moved_far_is_found_by_comparing_the_halves() -> None:
    (finding,) = judged(yawed(1.0, 3, 4))
    assert finding.fatal
    assert "between set2 and set3" in finding.description


@pytest.mark.campaign
def test_bins_are_not_averaged_about_a_bench_that_was_not_found() -> None:
    """What is asked afterwards of each half must find the points as they were seen."""
    other = VALUES.copy()
    other[NAMES.index("camera_yaw_deg")] += 1.0
    mixed = make(VALUES, 3, points=8200, sags_mm=(34.0, 36.0, 40.0), bumped={2: other})
    solution = solve_calibration(mixed.problem(SIGMAS))
    assert not solution.converged
    kept = solution.problem.sets[2].screen_mm
    assert kept.shape[1] > 1000
    assert np.isin(kept, mixed.sets[2].screen_mm).all()


def test_one_set_of_another_bench_is_reported() -> None:
    other = VALUES + SIGMAS * np.random.default_rng(9).normal(size=len(NAMES))
    (finding,) = judged(make(VALUES, 3, points=600, bumped={1: other}))
    assert finding.fatal
    assert finding.sets == (1,)


def test_sets_of_many_rigs_are_refused() -> None:
    rng = np.random.default_rng(9)
    others = {k: VALUES + 2 * SIGMAS * rng.normal(size=len(NAMES)) for k in (1, 2, 4)}
    (finding,) = judged(make(VALUES, 3, points=600, bumped=others))
    assert finding.fatal
    assert "bench" in finding.description or "one bench" in finding.description


def test_a_bow_is_found_by_its_pattern() -> None:
    bent = make(VALUES, 3, points=600, bow_mm=1.0)
    (finding,) = judged(bent)
    assert finding.fatal
    assert "the pattern of bow_mm = " in finding.description
    assert "--free bow_mm" in finding.description
    solution = solve_calibration(bent.problem(SIGMAS))
    assert find_suspects(solution)[0].value == pytest.approx(1.0, abs=0.15)
    # a tenth of a hundredth is seen by nobody
    assert judged(make(VALUES, 3, points=600, bow_mm=0.001)) == ()


def test_a_set_with_bad_fringes_has_little_weight_and_is_reported() -> None:
    rng = np.random.default_rng(1)
    noisy = edited(
        lambda p: replace(p, screen_mm=p.screen_mm + rng.normal(size=p.screen_mm.shape) * 0.2), 3
    )
    (finding,) = judged(good(), noisy)
    assert not finding.fatal
    assert finding.sets == (3,)
    assert "scatters" in finding.description


def test_sets_that_are_close_are_used_with_a_word() -> None:
    near = make(VALUES, 3, points=600, sags_mm=(36.0, 36.5, 37.0, 37.5, 38.0))
    (finding,) = judged(near)
    assert not finding.fatal
    assert "8 mm would determine the sag better" in finding.description


def test_the_monitor_waits_for_many_cycles_and_ignores_one() -> None:
    monitor = DriftMonitor(1.0, 0.6)  # 0.8 of it is film and geometry
    for residual_urad in [1.05] * CYCLES + [40.0, float("nan")]:
        monitor.add(residual_urad, 0.6)
        assert monitor.description == ""
    monitor.add(1.4, 0.6)
    assert monitor.description == ""
    for _ in range(CYCLES):
        monitor.add(1.4, 0.6)
    assert monitor.description.startswith("calibrate again: the fit leaves 1.40 µrad")
    assert monitor.description.endswith("predicts 1.00")


def test_the_monitor_distinguishes_the_cameras_noise_from_the_film() -> None:
    noisy = DriftMonitor(1.0, 0.6)
    for _ in range(CYCLES):
        noisy.add(2.15, 2.0)  # 0.8 of film and 2.0 of noise
    assert noisy.description == ""
    binned = DriftMonitor(1.0, 0.9)
    for _ in range(CYCLES):
        binned.add(0.9, 0.1)  # less than was calibrated, but the noise has gone
    assert binned.description


def test_a_warning_ends_well_below_where_it_began() -> None:
    monitor = DriftMonitor(1.0, 0.0)
    messages = []
    for residual_urad in (1.3, 1.2, 1.05):
        for _ in range(CYCLES):
            monitor.add(residual_urad, 0.0)
        messages.append(bool(monitor.description))
    assert messages == [True, True, False]
