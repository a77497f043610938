"""Experiments on the twin: bounded on any plant, stopped by name when something is wrong, the
mirror stays held.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control.experiments.excursion_guard import ExcursionGuard
from membrane_ctrl.control.experiments.experiment import BenchSample, Experiment, Finished
from membrane_ctrl.control.experiments.operating_point import OperatingPoint, choose_filters
from membrane_ctrl.control.experiments.patterned import Patterned
from membrane_ctrl.control.experiments.patterns import make_doublets, make_multisine, make_steps
from membrane_ctrl.control.experiments.relay import Relay
from membrane_ctrl.sim.bench_events import AmbientChange, LaserDropout
from tests.studies.tuning_sessions import Case, TwinBench
from tuning.identification.experiments import ExperimentError, fit_experiments, run_experiments
from tuning.identification.record import Record
from tuning.rigs.bench_rig import Rig
from tuning.rigs.operating_point import estimate_laser_noise_um

AROUND = OperatingPoint(1.24, 0.32, 5.3, 1.0)


class SaturatingPump(TwinBench):
    """More than a share of its full command makes no difference."""

    most_fraction = 1.0

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        return super().exchange(min(pump_fraction, self.most_fraction), vent_fraction)


class StuckPump(TwinBench):
    """From a time on the pump delivers its holding flow whatever is commanded."""

    stuck_from_s = math.inf

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        stuck = self.plant.time_s >= self.stuck_from_s
        return super().exchange(0.31 if stuck else pump_fraction, vent_fraction)


class Constant:
    """An experiment that never ends."""

    FLOW_UM_PER_S = 2.0

    def step(self, measurement: BenchSample, dt_s: float) -> float:
        return self.FLOW_UM_PER_S


def run(rig: Rig, experiment: Experiment, around: OperatingPoint) -> tuple[Record, Finished]:
    """An experiment about 0 inside its guard."""
    guard = ExcursionGuard(experiment, around, 0.0, 1 / rig.dt_s)
    return rig._run_experiment(guard, around.holding_flow_um_per_s)


def relay_after_hold(bench: TwinBench, case: Case) -> tuple[Rig, Record, Finished, float]:
    """Hold for 60 s, then the relay; with the largest true excursion in it."""
    rig = Rig(bench, case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    around = rig.around(rig.hold(60.0).cut(20.0, 60.0))
    start = len(bench.true_um)
    record, end = run(rig, Relay(around, 0.0), around)
    return rig, record, end, max(abs(x) for x in bench.true_um[start:])


def held_again(rig: Rig, bench: TwinBench) -> bool:
    """After 40 s of hold the mirror stays within the band."""
    rig.hold(40.0)
    start = len(bench.true_um)
    rig.hold(10.0)
    return max(abs(x) for x in bench.true_um[start:]) < 2.0


@pytest.mark.fast_cases("nominal", "leak /3", "pump x3", "delay x3")
@pytest.mark.parametrize(
    "case",
    [
        Case("gusty"),
        Case("gusty", leak=3.0),
        Case("gusty", leak=1 / 3, bleed=1.0),
        Case("gusty", pump=3.0, bleed=1.0),
        Case("gusty", pump=1 / 3),
        Case("gusty", delay=3.0),
        Case("gusty", delay=1 / 3),
    ],
    ids=["nominal", "leak x3", "leak /3", "pump x3", "pump /3", "delay x3", "delay /3"],
)
def test_excursion_stays_bounded_on_any_plant(case: Case) -> None:
    _, record, _, excursion_um = relay_after_hold(TwinBench(case, 7), case)
    assert excursion_um < 10.0
    assert record.duration_s > 30.0


def test_a_door_slammed_in_the_relay_ends_it_and_the_mirror_is_held() -> None:
    case = Case("quiet")
    bench = TwinBench(case, 1, [AmbientChange(90.0, -30.0)])
    rig, record, end, _ = relay_after_hold(bench, case)
    assert not end.completed
    assert "something else moved the mirror" in end.reason
    assert record.duration_s < 30.0 + 41.0  # of the way back
    assert abs(bench.true_um[-1]) < 3.0
    assert held_again(rig, bench)


def test_a_lost_laser_ends_it_and_the_mirror_is_held() -> None:
    case = Case("quiet")
    bench = TwinBench(case, 1, [LaserDropout(80.0, 3.0)])
    rig, record, end, _ = relay_after_hold(bench, case)
    assert not end.completed
    assert "laser" in end.reason
    assert record.duration_s == pytest.approx(20.3, abs=0.1)
    assert held_again(rig, bench)


def test_a_stuck_pump_never_crosses_and_is_named() -> None:
    case = Case("calm", laser_noise_um=0.3)
    bench = StuckPump(case, 1)
    bench.stuck_from_s = 60.0
    _, _, end, excursion_um = relay_after_hold(bench, case)
    assert not end.completed
    assert "did not" in end.reason
    assert excursion_um < 10.0


def test_characterising_gives_up_by_name_when_no_relay_can_be_completed() -> None:
    case = Case("calm", laser_noise_um=0.3)
    bench = StuckPump(case, 1)
    bench.stuck_from_s = 60.0
    with pytest.raises(ExperimentError, match="did not"):
        fit_experiments(
            run_experiments(Rig(bench, case.loop(), PumpConfig(), case.holding_flow_um_per_s))
        )


@pytest.mark.parametrize("most_fraction", [pytest.param(0.38, marks=pytest.mark.campaign), 0.6])
def test_a_saturating_pump_is_no_weak_one(most_fraction: float) -> None:
    """With a single gain it would be: 0.29 and 0.57 of the true one, known to 3 %."""
    case = Case("typical")
    bench = SaturatingPump(case, 1)
    bench.most_fraction = most_fraction
    rig = Rig(bench, case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    found = fit_experiments(run_experiments(rig)).quality
    assert found.verdict == "refused"
    assert any(
        "the pump saturates" in reason and "run `tune pump`" in reason for reason in found.reasons
    )
    assert held_again(rig, bench)


@pytest.mark.parametrize(("rate_hz", "least_um"), [(50.0, 7.7), (10.0, 5.3)])
def test_the_guard_keeps_more_in_hand_where_readings_are_few(
    rate_hz: float, least_um: float
) -> None:
    """White readings of 1 µm: three standard deviations of position and coast are never taken for
    the limit.
    """
    rng = np.random.default_rng(3)
    guard = ExcursionGuard(Patterned(AROUND, lambda _: 0.0, 600.0, 0.0), AROUND, 0.0, rate_hz)
    seen = [
        guard.step(BenchSample(float(x), math.nan, math.nan), 1 / rate_hz)
        for x in rng.standard_normal(5000)
    ]
    assert not any(isinstance(out, Finished) and not out.completed for out in seen)
    slow = ExcursionGuard(Constant(), AROUND, 0.0, rate_hz)
    out = [
        slow.step(BenchSample(float(x), math.nan, math.nan), 1 / rate_hz)
        for x in np.arange(0.0, 10.0, 1e-3)
    ]
    stopped = next(i for i, flow in enumerate(out) if flow != Constant.FLOW_UM_PER_S)
    assert stopped * 1e-3 == pytest.approx(least_um, abs=0.5)


def test_a_limit_within_the_noise_is_refused() -> None:
    around = OperatingPoint(1.24, 0.32, 5.3, 3.0)
    with pytest.raises(ValueError, match="noise alone takes 13"):
        ExcursionGuard(Patterned(around, lambda _: 0.0, 60.0, 0.0), around, 0.0, 10.0)


def test_for_a_mirror_that_is_too_tight_the_advice_is_to_open_the_bleed() -> None:
    case = Case("calm", laser_noise_um=0.3, leak=0.2)
    rig = Rig(TwinBench(case, 1), case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    around = rig.around(rig.hold(60.0).cut(20.0, 60.0))
    with pytest.raises(ValueError, match="open the bleed"):
        make_doublets(around, 1.0)


@pytest.mark.parametrize("make", [make_steps, make_doublets, make_multisine])
@pytest.mark.parametrize("gain", [1 / 3, 1.0, 3.0])
def test_patterns_stay_in_the_pump_and_near_the_centre(make: object, gain: float) -> None:
    assert callable(make)
    pattern = make(AROUND, gain)
    flow = np.array([pattern(0.02 * i) for i in range(3000)])
    assert (flow + AROUND.holding_flow_um_per_s).min() >= AROUND.least_flow_um_per_s - 1e-9
    assert (flow + AROUND.holding_flow_um_per_s).max() <= AROUND.full_flow_um_per_s + 1e-9
    way_um = np.cumsum(flow - flow.mean()) * 0.02 * gain
    assert np.ptp(way_um) < AROUND.limit_um
    assert np.ptp(flow) > 0.2


@pytest.mark.parametrize("make", [make_steps, make_multisine])
def test_patterns_run_on_the_twin_within_the_limit(make: object) -> None:
    assert callable(make)
    case = Case()
    bench = TwinBench(case, 3)
    rig = Rig(bench, case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    around = rig.around(rig.hold(60.0).cut(20.0, 60.0))
    start = len(bench.true_um)
    record, end = run(rig, Patterned(around, make(around, 1.0), 40.0, 0.0), around)
    assert end.completed, end.reason
    assert record.duration_s == pytest.approx(40.0, abs=5.0)  # and back
    assert max(abs(x) for x in bench.true_um[start:]) < 10.0


def test_laser_noise_is_measured_while_the_weather_moves_the_mirror() -> None:
    case = Case("gusty", laser_noise_um=0.7)
    rig = Rig(TwinBench(case, 2), case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    assert estimate_laser_noise_um(rig.hold(40.0)) == pytest.approx(0.7, rel=0.05)


def test_handing_over_between_loop_and_experiment_is_bumpless() -> None:
    """In still air, the flow jumps by no more than the loop's own ripple when the loop takes over
    again.
    """
    case = Case("calm", laser_noise_um=0.0)
    bench = TwinBench(case, 1)
    rig = Rig(bench, case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    around = rig.around(rig.hold(60.0).cut(20.0, 60.0))
    run(rig, Patterned(around, lambda time_s: 0.0, 5.0, 0.0), around)
    after = rig.hold(5.0)
    assert np.abs(after.flow_um_per_s - around.holding_flow_um_per_s).max() < 0.05


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 50.0, 100.0])
@pytest.mark.parametrize("laser_um", [0.3, 1.0, 2.0])
def test_noise_alone_stops_no_experiment_at_any_rate(rate_hz: float, laser_um: float) -> None:
    """A sound relay turns the centre at 4.5 µm in a limit of 10; two minutes of noise there."""
    around = choose_filters(replace(AROUND, laser_um=laser_um), rate_hz)
    guard = ExcursionGuard(Patterned(around, lambda _: 0.0, 1e9, 0.0), around, 0.0, rate_hz)
    noise_um = laser_um * np.random.default_rng(2).standard_normal(round(120 * rate_hz))
    noise_um[0] = 0.0  # the filters start there
    for reading_um in (4.5 + noise_um).tolist():
        assert not isinstance(guard.step(BenchSample(reading_um), 1 / rate_hz), Finished)


def test_the_noise_kept_in_hand_is_that_of_the_tick_rate() -> None:
    """4 µm of laser noise leave something of 10 µm at 50 readings a second (3 x 0.652 x 4), nothing
    at 25.
    """
    noisy = replace(AROUND, laser_um=4.0)
    ExcursionGuard(Relay(noisy, 0.0), noisy, 0.0, rate_hz=50.0)
    with pytest.raises(
        ValueError, match=r"takes 11\.1 µm of it at 25 readings/s; give a larger limit"
    ):
        ExcursionGuard(Relay(noisy, 0.0), noisy, 0.0, rate_hz=25.0)


def test_after_its_end_an_experiment_brings_the_mirror_back_without_winding_up() -> None:
    """On a pump that gives little at small commands a loop came back from +8.5 µm and went on to
    -12.9.
    """
    guard = ExcursionGuard(Constant(), AROUND, 0.0, 50.0)
    at_um, lowest_um, out = 9.5, 9.5, 0.0
    for _ in range(50 * 60):
        step = guard.step(BenchSample(at_um), 0.02)
        if isinstance(step, Finished):
            break
        out = step
        at_um += 0.02 * (
            8.0 * (out / 5.3) ** 2 - 0.438
        )  # a quadratic pump; the configured one is straight
        lowest_um = min(lowest_um, at_um)
    assert isinstance(step, Finished)
    assert not step.completed
    assert abs(at_um) < 2.5
    assert lowest_um > -1.0


def test_a_mirror_that_strays_on_the_way_back_is_given_to_the_loop_and_its_safety_rules() -> None:
    """Behind an open vent the way back went on for 40 s, in which no rule tripped."""
    guard = ExcursionGuard(Constant(), AROUND, 0.0, 50.0)
    at_um, step = -9.5, guard.step(BenchSample(-9.5), 0.02)
    while not isinstance(step, Finished):
        at_um -= 0.02 * 5.0
        step = guard.step(BenchSample(at_um), 0.02)
    assert -22.0 < at_um < -19.0
    assert "the limit of 10 µm was near" in step.reason


def test_a_raw_experiment_ends_where_it_is_and_one_without_readings_at_once() -> None:
    raw = ExcursionGuard(Constant(), AROUND, 0.0, 50.0, raw=True)
    assert isinstance(raw.step(BenchSample(9.5), 0.02), Finished)
    back = ExcursionGuard(Constant(), AROUND, 0.0, 50.0)
    assert back.step(BenchSample(9.5), 0.02) == 0.0
    lost = [back.step(BenchSample(math.nan), 0.02) for _ in range(20)]
    assert isinstance(lost[-1], Finished)
    assert "the limit of 10 µm was near" in lost[-1].reason


def test_what_is_known_of_the_delay_stops_a_moving_mirror_earlier_unless_the_noise_forbids() -> (
    None
):
    def stopped_um(laser_um: float, late_s: float) -> float:
        around = choose_filters(replace(AROUND, laser_um=laser_um, late_s=late_s), 50.0)
        guard = ExcursionGuard(Constant(), around, 0.0, 50.0)
        way_um = np.arange(0.0, 10.0, 0.06)  # 3 µm/s
        return next(
            float(x)
            for x in way_um
            if guard.step(BenchSample(float(x)), 0.02) != Constant.FLOW_UM_PER_S
        )

    assert stopped_um(0.1, 0.9) < stopped_um(0.1, 0.4) - 1.2
    assert stopped_um(0.1, 2.0) == stopped_um(0.1, 1.0)  # pulses turn within it
    assert stopped_um(4.0, 0.9) == stopped_um(4.0, 0.4)
