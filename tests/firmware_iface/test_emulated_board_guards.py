"""The board's guards of map version 3 in virtual time: a lost gauge, and interlock inputs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
from test_board_state import SAMPLE, Bench, pumping

from firmware_iface.emulators.pump_board import GAUGE_PRESSURE_LIMIT_PA, BoardSample, StoredSettings
from firmware_iface.register_map import load_default_map

TIMEOUT_S = 15.0
FROZEN_S = 60.0
TICK_S = 0.25  # below the watchdog's period
GAUGE_LOST, INTERLOCK = (
    load_default_map().make_fault_mask(name) for name in ("gauge_lost", "interlock")
)
NO_GAUGE = replace(SAMPLE, gauge_pressure_pa=math.nan)


def noisy() -> Iterator[BoardSample]:
    """Samples of a working gauge: no two in a row are equal."""
    while True:
        yield replace(SAMPLE, gauge_pressure_pa=600.0)
        yield replace(SAMPLE, gauge_pressure_pa=600.001)


class Run:
    """A host that feeds the board in every tick, on a plant that the test chooses."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.heartbeat = 1
        self.pumped_s = 0.0  # for how long the pump has run in all

    def wait(
        self, duration_s: float, sample: BoardSample | Iterator[BoardSample], pump: float = 0.3
    ) -> None:
        for _ in range(round(duration_s / TICK_S)):
            before = self.bench.state.pump_fraction
            now = sample if isinstance(sample, BoardSample) else next(sample)
            self.bench.at(self.bench.now_s + TICK_S, now)
            self.pumped_s += TICK_S * (before > 0)
            self.heartbeat = self.heartbeat % 100 + 1
            self.bench.command(pump, self.heartbeat, vent=0.25)

    @property
    def outputs(self) -> tuple[float, float]:
        return self.bench.state.pump_fraction, self.bench.state.vent_fraction

    @property
    def faults(self) -> float:
        return self.bench.get("sensors")["latched_faults"]


@pytest.fixture
def run() -> Run:
    return Run(pumping())


@pytest.mark.parametrize("gauge_pa", [math.nan, -math.inf, -3e6])
def test_a_gauge_without_a_value_stops_the_pump_after_the_time_out_and_not_before(
    run: Run, gauge_pa: float
) -> None:
    lost = replace(SAMPLE, gauge_pressure_pa=gauge_pa)
    run.wait(100.0, noisy())
    run.wait(TIMEOUT_S, lost)
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)
    run.wait(TICK_S, lost)
    assert (run.outputs, run.faults) == ((0.0, 0.25), GAUGE_LOST)


@pytest.mark.parametrize("gauge_pa", [math.nan, math.inf, -math.inf, 3e6, -3e6])
def test_a_value_that_its_register_cannot_hold_is_read_as_none(gauge_pa: float) -> None:
    bench = Bench(3, sample=replace(SAMPLE, gauge_pressure_pa=gauge_pa))
    assert math.isnan(bench.get("sensors")["gauge_pressure_pa"])


def test_a_short_gap_of_the_gauge_is_no_fault_and_does_not_add_up(run: Run) -> None:
    working = noisy()
    for _ in range(10):
        run.wait(TIMEOUT_S - TICK_S, NO_GAUGE)
        run.wait(TICK_S, working)
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)


def test_a_gauge_that_fails_while_the_vent_is_open_leaves_it_open(run: Run) -> None:
    run.bench.command(0.3, 200, vent=1.0)
    run.bench.at(run.bench.now_s + 0.1, NO_GAUGE)
    for tick in range(200):
        run.bench.command(0.3, tick % 2, vent=1.0)
        run.bench.at(run.bench.now_s + 0.1, NO_GAUGE)
    assert (run.outputs, run.faults) == ((0.0, 1.0), GAUGE_LOST)
    run.bench.command(0.0, 5, vent=0.5)
    assert run.outputs == (0.0, 0.5)  # the host commands the vent as before


def test_a_gauge_that_comes_back_does_not_clear_the_fault(run: Run) -> None:
    run.wait(TIMEOUT_S + 1.0, NO_GAUGE)
    run.wait(100.0, noisy())
    assert (run.outputs, run.faults) == ((0.0, 0.25), GAUGE_LOST)
    run.bench.clear()
    assert (run.outputs, run.faults) == ((0.0, 0.25), 0)  # clearing starts nothing
    run.wait(10.0, noisy())
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)


def test_clearing_without_a_gauge_never_runs_the_pump_again(run: Run) -> None:
    run.wait(100.0, NO_GAUGE)
    pumped_s = run.pumped_s
    assert pumped_s <= TIMEOUT_S + TICK_S
    for _ in range(20):
        run.bench.clear()
        run.wait(5.0, NO_GAUGE)
        assert run.faults == GAUGE_LOST
    assert run.pumped_s == pumped_s


def test_a_pump_that_is_switched_on_and_off_does_not_run_longer_without_a_gauge(run: Run) -> None:
    for _ in range(100):
        run.wait(1.0, NO_GAUGE)
        run.wait(1.0, NO_GAUGE, pump=0.0)
    assert run.pumped_s <= TIMEOUT_S + TICK_S
    assert run.faults == GAUGE_LOST


def test_a_new_claim_does_not_run_the_pump_without_a_gauge(run: Run) -> None:
    run.wait(TIMEOUT_S, NO_GAUGE, pump=0.0)
    bench = run.bench
    bench.put("settings", watchdog_period_s=0.5, watchdog_arm=0)
    bench.claim |= {"claim_id": 9, "claim_key": 9, "command_key": 9, "clear_key": 9}
    bench.at(bench.now_s + 1.0, NO_GAUGE)
    bench.arm()
    bench.command(0.3, 200)
    assert (run.outputs[0], run.faults) == (0.0, GAUGE_LOST)


def test_a_pump_at_rest_needs_no_gauge(run: Run) -> None:
    run.wait(1000.0, NO_GAUGE, pump=0.0)
    assert run.faults == 0
    run.wait(TICK_S, noisy(), pump=0.0)
    run.wait(TICK_S, noisy())
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)


def test_a_board_that_has_not_seen_its_gauge_since_power_up_does_not_pump() -> None:
    bench = Bench(3, sample=NO_GAUGE)
    bench.arm()
    bench.command(0.3, 1)
    assert (bench.state.pump_fraction, bench.get("sensors")["latched_faults"]) == (0.0, GAUGE_LOST)


def test_a_restart_does_not_give_a_pump_without_a_gauge_its_time_again(run: Run) -> None:
    run.wait(TIMEOUT_S + 1.0, NO_GAUGE)
    run.bench.state.restart()
    assert run.faults == 0
    run.bench.arm()
    run.bench.command(0.3, 1)
    assert (run.outputs[0], run.faults) == (0.0, GAUGE_LOST)


def test_a_gauge_that_repeats_its_value_stops_the_pump(run: Run) -> None:
    run.wait(1.0, noisy())
    run.wait(FROZEN_S, SAMPLE)
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)
    run.wait(2 * TICK_S, SAMPLE)
    assert (run.outputs, run.faults) == ((0.0, 0.25), GAUGE_LOST)
    run.bench.clear()
    run.wait(FROZEN_S, SAMPLE)
    assert run.outputs[0] == 0.3  # a gauge at rest shows only now whether it works
    run.wait(2 * TICK_S, SAMPLE)
    assert (run.outputs[0], run.faults) == (0.0, GAUGE_LOST)


def test_a_frozen_gauge_with_gaps_is_frozen(run: Run) -> None:
    for _ in range(10):
        run.wait(5.0, SAMPLE)
        run.wait(5.0, NO_GAUGE)
    assert run.faults == GAUGE_LOST
    assert run.pumped_s <= FROZEN_S + 2 * TICK_S


def test_a_frozen_gauge_is_judged_over_the_time_of_pumping_only(run: Run) -> None:
    """A gauge that clips at zero repeats itself on a flat film, for hours."""
    run.wait(1000.0, SAMPLE, pump=0.0)
    run.wait(FROZEN_S - 1.0, SAMPLE)
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)


def test_the_judgement_of_a_frozen_gauge_can_be_switched_off() -> None:
    run = Run(pumping(stored=StoredSettings(gauge_frozen_s=0.0)))
    run.wait(1000.0, SAMPLE)
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)
    run.wait(TIMEOUT_S + 1.0, NO_GAUGE)
    assert run.faults == GAUGE_LOST


def test_a_board_without_a_fitted_gauge_pumps_without_one() -> None:
    run = Run(pumping(stored=StoredSettings(gauge_fitted=False)))
    run.wait(1000.0, NO_GAUGE)
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)
    assert run.bench.get("identity")["gauge_fitted"] == 0


def test_the_time_out_is_that_of_the_stored_settings() -> None:
    run = Run(pumping(stored=StoredSettings(gauge_timeout_s=2.0)))
    run.wait(2.0, NO_GAUGE)
    assert run.faults == 0
    run.wait(TICK_S, NO_GAUGE)
    assert run.faults == GAUGE_LOST
    assert run.bench.get("identity")["gauge_timeout_s"] == 2.0


@pytest.mark.parametrize("version", [1, 2])
def test_boards_of_earlier_maps_have_no_guard_of_their_gauge_and_no_interlocks(
    version: int,
) -> None:
    run = Run(pumping(version, StoredSettings(interlocks_fitted=0xFFFF)))
    run.wait(1000.0, replace(NO_GAUGE, interlock_inputs=0))
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)
    assert "interlock_inputs" not in run.bench.get("sensors")
    assert "gauge_fitted" not in run.bench.get("identity")


def with_inputs(closed: int) -> BoardSample:
    return replace(SAMPLE, interlock_inputs=closed)


@pytest.mark.parametrize(
    ("closed", "stops"), [(0b101, False), (0xFFFF, False), (0b100, True), (0b001, True), (0, True)]
)
def test_an_open_input_stops_the_pump_at_once_if_it_is_fitted(closed: int, stops: bool) -> None:
    run = Run(pumping(stored=StoredSettings(interlocks_fitted=0b101)))
    run.bench.at(0.01, with_inputs(closed))
    assert run.outputs == ((0.0, 0.25) if stops else (0.3, 0.25))
    assert run.faults == (INTERLOCK if stops else 0)
    assert run.bench.get("sensors")["interlock_inputs"] == closed
    assert run.bench.get("identity")["interlocks_fitted"] == 0b101


def test_by_default_no_input_is_fitted(run: Run) -> None:
    run.bench.at(0.01, with_inputs(0))
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)


def test_an_input_that_closes_again_does_not_clear_the_fault() -> None:
    run = Run(pumping(stored=StoredSettings(interlocks_fitted=1)))
    run.bench.at(0.01, with_inputs(0))
    run.wait(10.0, noisy())
    assert (run.outputs, run.faults) == ((0.0, 0.25), INTERLOCK)
    run.bench.clear()
    assert run.outputs == (0.0, 0.25)
    run.wait(1.0, noisy())
    assert (run.outputs, run.faults) == ((0.3, 0.25), 0)


def test_clearing_with_an_open_input_latches_again_before_the_pump_runs() -> None:
    run = Run(pumping(stored=StoredSettings(interlocks_fitted=1)))
    run.bench.at(0.01, with_inputs(0))
    run.bench.clear()
    run.bench.command(0.3, 99)
    assert (run.outputs[0], run.faults) == (0.0, INTERLOCK)


def test_an_open_input_is_remembered_although_the_pump_was_off() -> None:
    """An emergency stop that is pressed and released between two strokes of the pump still needs a
    person.
    """
    run = Run(pumping(stored=StoredSettings(interlocks_fitted=1)))
    run.bench.command(0.0, 2)
    run.bench.at(0.01, with_inputs(0))
    run.bench.at(0.02, with_inputs(1))
    run.bench.command(0.3, 3)
    assert (run.outputs[0], run.faults) == (0.0, INTERLOCK)


def test_over_pressure_opens_the_vent_although_another_fault_came_first() -> None:
    run = Run(pumping(stored=StoredSettings(interlocks_fitted=1)))
    run.bench.at(0.01, with_inputs(0))
    run.bench.at(0.02, replace(SAMPLE, gauge_pressure_pa=GAUGE_PRESSURE_LIMIT_PA + 1.0))
    assert run.outputs == (0.0, 1.0)
    assert run.faults == INTERLOCK | load_default_map().make_fault_mask("over_pressure")
