"""A sensor that is slower than the loop: the loop runs at the sensor's rate; a notice states it.

The board may sample every 10 ms (docs/reference/firmware.md); at 200 Hz every other answer then
repeats a sample.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.sample_rate import NOTICE, SampleRate, SampleRateState
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Event, Fault, Maintenance, MaintenanceOver
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_config

RATE_HZ = 200.0


class SlowBoard(VirtualBench):
    """A board that samples every so often, whatever the rate of requests."""

    def __init__(self, plant: ForeignPlant, period_s: float) -> None:
        self.period_s = period_s
        self.stops_s = math.inf  # no sample from then on
        self._sampled_s = -math.inf
        super().__init__(plant)  # type: ignore[arg-type]  # it has the methods

    def _sample_sensors(self, last: BoardSample | None) -> BoardSample:
        now_s = self.plant.time_s
        self.truth = self.plant.truth()
        early = now_s < self._sampled_s + self.period_s - 1e-9 or now_s > self.stops_s
        if last is not None and early:
            return last
        self._sampled_s = now_s
        return super()._sample_sensors(last)


def run_hold(
    period_s: float, duration_s: float, stops_s: float = math.inf, config: Config | None = None
) -> list[TickOutputs]:
    plant = ForeignPlant(ForeignPump(), seed=3, weather=0.3)
    bench = SlowBoard(plant, period_s)
    bench.stops_s = stops_s
    run = VirtualRun(
        config or foreign_config(rate_hz=RATE_HZ, setpoint_um=-2.0), bench, zernike_projection()
    )
    ticks = [run.run_tick((Command("hold", "test"),))]
    while run.now_s < duration_s and run.finished is None:
        ticks.append(run.run_tick())
    return [tick for tick in ticks if tick is not None]


def held_um(ticks: list[TickOutputs], from_s: float) -> np.ndarray:
    """Error of the true centre."""
    return np.array(
        [
            tick.row.truth_displacement_um - tick.row.target_um
            for tick in ticks
            if tick.row.mono_s > from_s and tick.row.state == State.HOLD
        ]
    )


def notices(ticks: list[TickOutputs]) -> list[Event]:
    events = [event for tick in ticks for event in tick.events]
    return [
        event
        for event in events
        if isinstance(event, Maintenance | MaintenanceOver) and event.name == NOTICE
    ]


def test_a_board_at_half_the_rate_holds_as_well_as_a_loop_at_its_rate() -> None:
    slow = run_hold(0.01, 75.0)
    error_um = held_um(slow, 25.0)
    same = held_um(
        run_hold(0.01, 75.0, config=foreign_config(rate_hz=100.0, setpoint_um=-2.0)), 25.0
    )
    assert error_um.size > 5000
    assert np.sqrt(np.mean(error_um**2)) < 1.25 * np.sqrt(np.mean(same**2))
    assert abs(error_um.mean()) < 0.1
    (notice,) = notices(slow)
    assert isinstance(notice, Maintenance)
    assert "100 new samples a second in 200 answers" in notice.message
    assert "Lower loop.rate_hz to 100" in notice.message


def test_a_board_at_a_quarter_of_the_rate_holds_without_a_fault() -> None:
    ticks = run_hold(0.02, 40.0)
    assert not any(isinstance(event, Fault) for tick in ticks for event in tick.events)
    assert held_um(ticks, 25.0).std() < 0.15
    assert "50 new samples a second in 200 answers" in str(notices(ticks)[0])


def test_between_samples_the_output_stays() -> None:
    ticks = [tick.row for tick in run_hold(0.01, 22.0) if tick.row.state == State.HOLD]
    fractions = np.array([row.pump_fraction for row in ticks])
    counters = np.array([row.sample_counter for row in ticks])
    repeats = counters[1:] == counters[:-1]
    assert 0.45 < repeats.mean() < 0.55
    assert np.all(fractions[1:][repeats] == fractions[:-1][repeats])
    # a loop that acts: its command changes with most new samples
    assert np.mean(fractions[1:][~repeats] != fractions[:-1][~repeats]) > 0.9


def test_samples_that_stop_are_a_fault_as_before() -> None:
    ticks = run_hold(0.01, 26.0, stops_s=22.0)
    events = [event for tick in ticks for event in tick.events]
    assert next(event.name for event in events if isinstance(event, Fault)) == "displacement_frozen"
    since_s = next(tick.row.mono_s for tick in ticks if tick.row.fault)
    assert 22.25 < since_s < 22.45


@pytest.mark.parametrize("period_s", [0.0, 0.005])
def test_a_sensor_as_fast_as_the_loop_is_no_notice(period_s: float) -> None:
    config = foreign_config(rate_hz=50.0)
    assert notices(run_hold(period_s, 35.0, config=config)) == []


def test_the_notice_ends_when_samples_are_fresh_again() -> None:
    watch = SampleRate(SampleRateState())
    events = [
        event
        for number in range(4500)
        for event in watch.step(0.01 * number, answered=True, fresh=number > 2500 or number % 2 > 0)
    ]
    assert [type(event) for event in events] == [Maintenance, MaintenanceOver]


def test_lost_answers_are_no_slow_samples() -> None:
    watch = SampleRate(SampleRateState())
    for number in range(3000):
        answered = number % 2 > 0
        assert watch.step(0.01 * number, answered=answered, fresh=answered) == []


def test_the_step_after_kept_ticks_covers_their_time() -> None:
    """PI at half the rate: the same outputs as a loop that has half the ticks."""
    config = foreign_config(rate_hz=200.0)
    fast, half = (InnerLoop(config.loop, config.pump) for _ in range(2))
    for loop in (fast, half):
        loop.start(-1.0, 1.2)
    rng = np.random.default_rng(1)
    for _ in range(300):
        reading = LoopInput(0.0, 0.0, float(rng.standard_normal()), math.nan, math.nan)
        acts, acted = fast.step(reading, 0.005), half.step(reading, 0.01)
        kept = fast.keep_output(reading, 0.005)
        assert kept == acts
    # a step covers the time since the last one, half a period later than with half the ticks
    assert fast.mean_flow_um_per_s == pytest.approx(half.mean_flow_um_per_s, abs=0.02)
    assert acts.pump_fraction == pytest.approx(acted.pump_fraction, abs=0.02)


def test_nothing_is_kept_after_a_gap() -> None:
    config = foreign_config(rate_hz=200.0)
    loop = InnerLoop(config.loop, config.pump)
    loop.start(0.0, 1.2)
    reading = LoopInput(0.0, 0.0, 3.0, math.nan, math.nan)
    loop.step(reading, 0.005)
    loop.step_without_reading(reading, 0.005)
    assert loop.keep_output(reading, 0.005).p_um_per_s == 0.0
