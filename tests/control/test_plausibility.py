"""The third sensor identifies the faulty one, within a stated time and from a stated size."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.control.plausibility import PlausibilityCheck
from membrane_ctrl.model.events import FaultySensor
from membrane_ctrl.model.shape_estimate import ShapeEstimate, Verdict
from tests.worlds.sound_figure import SOUND_FIGURE

RATE_HZ = 10.0
SAG_UM, PRESSURE_PA = 37_100.0, 600.0
Story = Callable[
    [float], tuple[float, float, float]
]  # time -> true sag change, laser's error, camera's error; µm


def estimate(time_s: float, sag_um: float, verdict: Verdict = "ok") -> ShapeEstimate:
    return replace(SOUND_FIGURE, time_s=time_s, sag_um=sag_um, verdict=verdict)


def judge_story(
    story: Story, duration_s: float = 400.0, seed: int = 1, gauge_drift_pa_per_s: float = 0.0
) -> list[FaultySensor]:
    """The verdict on every tick of a story; noise 1 µm, 1 µm and 0.5 Pa."""
    rng = np.random.default_rng(seed)
    check = PlausibilityCheck(10.0, 37_100.0)
    verdicts: list[FaultySensor] = []
    for tick in range(round(duration_s * RATE_HZ)):
        time_s = tick / RATE_HZ
        true_um, laser_um, camera_um = story(time_s)
        noise = rng.standard_normal(3)
        gauge_pa = (
            PRESSURE_PA * (1 + 3 * true_um / SAG_UM)
            + 0.5 * noise[0]
            + gauge_drift_pa_per_s * time_s
        )
        shape = (
            estimate(time_s, SAG_UM + true_um + camera_um + noise[1]) if tick % 20 == 0 else None
        )
        verdicts.append(check.step(1 / RATE_HZ, true_um + laser_um + noise[2], gauge_pa, shape))
    return verdicts


def after(start_s: float, value: float) -> Callable[[float], float]:
    return lambda time_s: value if time_s >= start_s else 0.0


@pytest.mark.parametrize("seed", range(5))
def test_consistent_sensors_raise_no_suspicion(seed: int) -> None:
    wander: Story = lambda t: (8 * math.sin(t / 30), 0.0, 0.0)  # noqa: E731
    assert set(judge_story(wander, 1200.0, seed)) == {FaultySensor.NONE}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size_um", [-40.0, -20.0, 20.0, 40.0])
def test_a_displaced_laser_is_identified_within_a_minute(size_um: float, seed: int) -> None:
    # the loop returns the reading to its setpoint, and moves the mirror off it
    findings = judge_story(
        lambda t: (-after(200.0, size_um)(t), after(200.0, size_um)(t), 0.0), seed=seed
    )
    found = findings.index(FaultySensor.LASER) / RATE_HZ
    assert 200.0 < found < 260.0
    assert FaultySensor.OPTICS not in findings


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size_um", [-40.0, -20.0, 20.0, 40.0])
def test_a_displaced_camera_is_identified_within_a_minute(size_um: float, seed: int) -> None:
    findings = judge_story(lambda t: (0.0, 0.0, after(200.0, size_um)(t)), seed=seed)
    found = findings.index(FaultySensor.OPTICS) / RATE_HZ
    assert 200.0 < found < 260.0
    assert FaultySensor.LASER not in findings


def test_a_sensor_error_that_ends_is_cleared() -> None:
    findings = judge_story(lambda t: (0.0, 0.0, 30.0 if 100 <= t < 200 else 0.0))
    assert FaultySensor.OPTICS in findings
    assert set(findings[-500:]) == {FaultySensor.NONE}


def test_slow_drifts_raise_no_suspicion() -> None:
    assert set(judge_story(lambda t: (0.0, 2.0 * t / 60, 0.0), 900.0)) == {
        FaultySensor.NONE
    }  # the laser's mount
    assert set(judge_story(lambda t: (0.0, 0.0, 0.0), 900.0, gauge_drift_pa_per_s=0.01)) == {
        FaultySensor.NONE
    }


def test_a_drifting_gauge_does_not_blame_another_sensor() -> None:
    # 0.1 Pa a minute, far more than a gauge's zero moves
    findings = judge_story(
        lambda t: (0.0, after(200.0, 30.0)(t), 0.0), gauge_drift_pa_per_s=0.1 / 60
    )
    assert FaultySensor.LASER in findings
    assert FaultySensor.OPTICS not in findings


def test_without_camera_or_gauge_there_is_no_verdict() -> None:
    judge = PlausibilityCheck(10.0, 37_100.0)
    for tick in range(2000):
        assert judge.step(0.1, 500.0 * (tick > 1000), 600.0, None) == FaultySensor.NONE
        assert (
            judge.step(0.1, 500.0 * (tick > 1000), math.nan, estimate(tick * 0.1, SAG_UM))
            == FaultySensor.NONE
        )
        judge.reset()


def test_a_rejected_shape_is_not_used_as_evidence() -> None:
    judge = PlausibilityCheck(10.0, 37_100.0)
    for tick in range(3000):
        bad = estimate(tick * 0.1, SAG_UM + 500.0, "rejected") if tick % 20 == 10 else None
        good = estimate(tick * 0.1, SAG_UM) if tick % 20 == 0 else None
        assert judge.step(0.1, 0.0, 600.0, bad or good) == FaultySensor.NONE


def shown(
    judge: PlausibilityCheck, time_s: float, laser_um: float, camera_um: float, gauge_um: float
) -> FaultySensor:
    """One tick of a second without noise."""
    gauge_pa = PRESSURE_PA * (1 + 3 * gauge_um / SAG_UM)
    return judge.step(1.0, laser_um, gauge_pa, estimate(time_s, SAG_UM + camera_um))


def settled(laser_um: float, camera_um: float, gauge_um: float) -> tuple[PlausibilityCheck, float]:
    """A monitor after a minute without error and a minute of this."""
    judge, time_s = PlausibilityCheck(10.0, 37_100.0), 0.0
    for _ in range(60):
        time_s += 1.0
        shown(judge, time_s, 0.0, 0.0, 0.0)
    for _ in range(60):
        time_s += 1.0
        shown(judge, time_s, laser_um, camera_um, gauge_um)
    return judge, time_s


def test_an_identified_sensor_stays_faulty_for_any_later_gauge_reading() -> None:
    judge, time_s = settled(30.0, 0.0, 0.0)
    assert judge.faulty == FaultySensor.LASER
    for second in range(1, 121):  # the gauge now agrees with the laser
        assert shown(judge, time_s + second, 30.0, 0.0, 30.0) == FaultySensor.LASER


def test_an_identified_sensor_is_cleared_only_below_half_the_limit() -> None:
    judge, time_s = settled(30.0, 0.0, 0.0)
    for second in range(1, 121):
        findings = shown(judge, time_s + second, 7.0, 0.0, 0.0)
    assert findings == FaultySensor.LASER  # 7 µm apart: less than the limit, more than half of it
    for second in range(121, 241):
        findings = shown(judge, time_s + second, 4.0, 0.0, 0.0)
    assert findings == FaultySensor.NONE


def test_if_the_gauge_is_between_laser_and_camera_the_verdict_is_unsure() -> None:
    judge, time_s = settled(20.0, 0.0, 10.0)
    assert judge.faulty == FaultySensor.UNKNOWN
    for second in range(1, 121):  # it is not settled: a later verdict of the gauge counts
        findings = shown(judge, time_s + second, 20.0, 0.0, 0.0)
    assert findings == FaultySensor.LASER


@pytest.mark.parametrize("speed_um_per_s", [-4.0, 4.0])
@pytest.mark.parametrize("lag_s", [0.0, 4.5])
def test_figures_that_lag_behind_a_moving_film_are_not_found_wrong(
    lag_s: float, speed_um_per_s: float
) -> None:
    """The film moves for a minute, and each figure shows it as it was 4.5 s before: a check that
    knows this lag finds nothing wrong, one that takes the figures for present blames the optics.
    """
    check = PlausibilityCheck(10.0, SAG_UM, figure_lag_s=lag_s)
    verdicts = set()
    for tick in range(round(260.0 * RATE_HZ)):
        time_s = tick / RATE_HZ
        film_um, shown_um = (
            speed_um_per_s * min(max(at_s - 200.0, 0.0), 60.0) for at_s in (time_s, time_s - 4.5)
        )
        gauge_pa = PRESSURE_PA * (1 + film_um / SAG_UM) ** 3
        figure = estimate(time_s, SAG_UM + shown_um) if tick % 20 == 0 else None
        verdicts.add(check.step(1 / RATE_HZ, film_um, gauge_pa, figure))
    assert verdicts == ({FaultySensor.NONE} if lag_s else {FaultySensor.NONE, FaultySensor.OPTICS})


@pytest.mark.parametrize("moved_um", [-60.0, 60.0])
def test_a_laser_after_a_gap_is_compared_by_its_new_readings(moved_um: float) -> None:
    """The film moves by some tens of micrometres while the laser is lost; optics and gauge have
    followed when it comes back. Its mean of before the gap would accuse it.
    """
    check = PlausibilityCheck(10.0, SAG_UM)
    verdicts = set()
    for tick in range(round(400.0 * RATE_HZ)):
        time_s = tick / RATE_HZ
        film_um = moved_um * min(max((time_s - 200.0) / 60.0, 0.0), 1.0)
        laser_um = math.nan if 200.0 <= time_s < 330.0 else film_um
        gauge_pa = PRESSURE_PA * (1 + film_um / SAG_UM) ** 3
        figure = estimate(time_s, SAG_UM + film_um) if tick % 20 == 0 else None
        verdicts.add(check.step(1 / RATE_HZ, laser_um, gauge_pa, figure))
    assert verdicts == {FaultySensor.NONE}


@pytest.mark.parametrize("size_um", [-345.0, 25.0, 330.0])
def test_a_displaced_laser_is_not_blamed_again_in_its_new_place(size_um: float) -> None:
    """Its mean was 16 µm behind when the comparison began again."""
    check, now_s = settled(0.0, 0.0, 0.0)
    rng = np.random.default_rng(3)

    def judge(duration_s: float) -> list[FaultySensor]:
        nonlocal now_s
        verdicts: list[FaultySensor] = []
        for _ in range(round(duration_s * RATE_HZ)):
            now_s += 1.0 / RATE_HZ
            laser_um = size_um + rng.standard_normal()
            figure = estimate(now_s, SAG_UM)
            verdicts.append(check.step(1.0 / RATE_HZ, laser_um, PRESSURE_PA, figure))
        return verdicts

    assert judge(31.0)[-1] == FaultySensor.LASER
    check.rebase()
    assert set(judge(120.0)) == {FaultySensor.NONE}
