"""Short losses of the laser that repeat are counted; long ones are listed."""

from __future__ import annotations

import itertools

import pytest

from membrane_ctrl.config.schema import Config, LoopConfig, ShapeConfig, StatesConfig, TwinConfig
from membrane_ctrl.controller import short_losses as counting
from membrane_ctrl.controller.commands import Command
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Cleared, Event, Fault, ShortLosses
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

CONFIG = Config(
    loop=LoopConfig(rate_hz=10.0),
    shape=ShapeConfig(enabled=False),
    states=StatesConfig(actuator_test=False, hold_flow_max_s=5.0, stay_after_trip=True),
    twin=TwinConfig(scenario="quiet", start_error_um=-1.0),
)
BEGIN_S = 40.0
REPORT_S = 300.0  # instead of an hour


def hold_with_losses(losses: list[tuple[float, float]], until_s: float) -> list[VirtualTick]:
    """A hold whose laser is lost in these intervals, in seconds."""
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
    run = VirtualRun(CONFIG, bench, zernike_projection())
    ticks: list[VirtualTick] = []
    commands: tuple[Command, ...] = (Command("hold", "a test"),)
    while run.now_s < until_s:
        bench.wrong.no_light = any(begin <= run.now_s < end for begin, end in losses)
        tick = run.run_tick(commands)
        commands = ()
        assert tick is not None
        ticks.append(tick)
    return ticks


def events_of(ticks: list[VirtualTick], kind: type[Event]) -> list[tuple[float, Event]]:
    return [
        (tick.row.mono_s, event)
        for tick in ticks
        for event in tick.events
        if isinstance(event, kind)
    ]


def short_losses(
    count: int, every_s: float = 30.0, first_s: float = BEGIN_S
) -> list[tuple[float, float]]:
    return [(first_s + every_s * n, first_s + every_s * n + 0.6) for n in range(count)]


def test_three_short_losses_are_listed() -> None:
    ticks = hold_with_losses(short_losses(3), 150.0)
    assert len(events_of(ticks, Fault)) == len(events_of(ticks, Cleared)) == 3
    assert not events_of(ticks, ShortLosses)


def test_further_short_losses_are_counted_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(counting, "_REPORT_S", REPORT_S)
    ticks = hold_with_losses(short_losses(10), 500.0)
    assert len(events_of(ticks, Fault)) == len(events_of(ticks, Cleared)) == 4
    (begin_s, begin), (hour_s, hour) = events_of(ticks, ShortLosses)
    assert (begin.name, begin.count) == ("displacement_missing", 4)  # type: ignore[attr-defined]
    assert (hour.count, hour.over_min) == (6, 5.0)  # type: ignore[attr-defined]
    assert hour_s - begin_s == pytest.approx(REPORT_S, abs=0.2)
    held = [tick.row for tick in ticks if tick.row.safe_level == SafeLevel.HOLD_FLOW]
    begins = sum(1 for early, late in itertools.pairwise(held) if late.mono_s - early.mono_s > 1)
    assert begins == 9  # the flow is held in each loss, listed or not


def test_a_long_loss_is_listed_while_short_ones_are_counted() -> None:
    long_s = BEGIN_S + 300.0
    ticks = hold_with_losses([*short_losses(6), (long_s, long_s + 3.0)], long_s + 20.0)
    fault_s = [time_s for time_s, _ in events_of(ticks, Fault)]
    assert len(fault_s) == len(events_of(ticks, Cleared)) == 5
    assert 1.0 < fault_s[-1] - long_s < 1.6


def test_a_counted_loss_that_ends_the_hold_is_listed_before_the_state_changes() -> None:
    long_s = BEGIN_S + 300.0
    ticks = hold_with_losses([*short_losses(6), (long_s, long_s + 60.0)], long_s + 30.0)
    assert ticks[-1].row.state == State.FAULT
    assert events_of(ticks, Fault)[-1][0] < long_s + 1.6


def test_the_next_loss_after_a_time_without_one_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(counting, "_REPORT_S", REPORT_S)
    late_s = BEGIN_S + 2 * REPORT_S + 200.0
    ticks = hold_with_losses([*short_losses(5), (late_s, late_s + 0.6)], late_s + 10.0)
    assert len(events_of(ticks, ShortLosses)) == 2
    assert events_of(ticks, Fault)[-1][0] > late_s
