"""Commands of one tick: the safest is executed, in every order and in every state."""

from __future__ import annotations

import copy
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, LoopConfig, ShapeConfig, StatesConfig
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.controller.command_precedence import DOWN, sort_commands
from membrane_ctrl.controller.commands import TABLE
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.state_sets import MOVING
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import CommandTaken
from membrane_ctrl.model.telemetry import SafeLevel, State

DT_S = 0.1
CONFIG = Config(
    loop=LoopConfig(rate_hz=1 / DT_S),
    shape=ShapeConfig(enabled=False),
    states=StatesConfig(
        check_s=0.3,
        actuator_test=False,
        settle_s=0.3,
        ramp_down_s=1.0,
        stay_after_trip=True,
        vented_pressure_pa=0.0,
    ),
)
SPEC = ExperimentSpec.model_validate(
    {"kind": "relay", "duration_s": 20.0, "holding_flow_um_per_s": 1.24, "laser_um": 1.0}
)
LIFTING: tuple[Kind, ...] = ("hold", "manual", "tune", "resume", "ack", "unlock")
RISKY: tuple[Kind, ...] = ("hold", "ack", "unlock", "manual", "resume", "stop", "lower", "vent")


def command(kind: Kind) -> Command:
    values = {"manual": 2.0, "setpoint": 3.0}
    return Command(
        kind,
        "tester",
        value=values.get(kind, math.nan),
        text="" if kind == "unlock" else "hands inside",
        account="tester" if kind in ("latch", "unlock") else "",
        loop=CONFIG.loop if kind == "gains" else None,
        experiment=SPEC if kind == "tune" else None,
    )


class Mirror:
    """A controller with a bench without faults, unless given."""

    def __init__(self) -> None:
        self.controller = Controller(CONFIG, zernike_projection())
        self.ticks = 0
        self.last: TickOutputs | None = None

    def tick(self, *kinds: Kind, **wrong: float) -> TickOutputs:
        return self.tick_with([command(kind) for kind in kinds], **wrong)

    def tick_with(self, given: Sequence[Command], **wrong: float) -> TickOutputs:
        self.ticks += 1
        self.last = self.controller.tick(self.inputs(given, **wrong))
        return self.last

    def inputs(self, given: Sequence[Command], **wrong: float) -> TickInputs:
        pump = self.last.command.pump_fraction if self.last else 0.0
        below_um = -1.5 + 1e-3 * (self.ticks % 7)  # inside the band, and so that the loop wants gas
        reading = BenchReading(
            below_um,
            0,
            600.0,
            101325.0,
            23.0,
            23.0,
            pump,
            0.0,
            self.ticks,
            DT_S * self.ticks,
            False,
            0,
        )
        reading = replace(reading, **wrong)  # type: ignore[arg-type]  # numbers all of them
        return TickInputs(self.ticks * DT_S, DT_S, reading, commands=tuple(given))

    def until(self, state: State) -> Mirror:
        for _ in range(60):
            if self.controller.state == state:
                return self
            self.tick()
        raise AssertionError(f"never in {state.name}")


@functools.cache
def _in(state: State) -> Mirror:
    mirror = Mirror()
    mirror.tick()
    if state == State.STANDBY:
        return mirror
    mirror.tick("hold")
    if state in (State.CHECK, State.INFLATE, State.SETTLE, State.HOLD):
        return mirror.until(state)
    mirror.until(State.HOLD)
    match state:
        case State.MANUAL | State.TUNE:
            mirror.tick("manual" if state == State.MANUAL else "tune")
        case State.LOWER:
            mirror.tick("vent")
        case State.FAULT:
            mirror.tick(latched_faults=4)
            mirror.until(State.FAULT)
            mirror.tick()
    assert mirror.controller.state == state
    return mirror


def in_state(state: State) -> Mirror:
    return copy.deepcopy(_in(state))


def stays_down(mirror: Mirror) -> None:
    """Whatever is commanded except `unlock`, again and again, the pump stays off."""
    assert mirror.last is not None
    assert mirror.last.command.pump_fraction == 0.0
    for kind in ("hold", "ack", "manual", "resume", "lower", "ack", "hold", "hold", "hold", "hold"):
        assert mirror.tick(kind).command.pump_fraction == 0.0
        assert mirror.controller.state not in MOVING | {State.CHECK}


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_a_latch_wins_over_any_other_command_in_either_order(state: State) -> None:
    for other in TABLE:
        for batch in {("latch", other), (other, "latch")}:
            mirror = in_state(state)
            mirror.tick(*batch)
            stays_down(mirror)


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_a_latch_wins_over_any_two_others_in_every_order(state: State) -> None:
    for batch in sorted(
        {order for two in itertools.product(RISKY, repeat=2) for order in orders("latch", *two)}
    ):
        mirror = in_state(state)
        mirror.tick(*batch)
        stays_down(mirror)


def orders(*kinds: Kind) -> set[tuple[Kind, ...]]:
    return set(itertools.permutations(kinds))


@pytest.mark.parametrize(
    "state", [State.STANDBY, State.HOLD, State.MANUAL, State.FAULT], ids=lambda state: state.name
)
def test_after_a_latch_an_unlock_and_an_ack_let_the_mirror_be_held_again(state: State) -> None:
    """The tests above would not notice a controller that never inflates again."""
    mirror = in_state(state)
    mirror.tick("latch", "ack", "unlock")
    for _ in range(10):
        mirror.tick()
    mirror.tick("unlock")
    mirror.tick("ack")
    mirror.until(State.STANDBY)
    mirror.tick("hold")
    mirror.until(State.HOLD)
    assert mirror.tick().command.pump_fraction > 0.0


def test_a_latch_cancels_an_ack_that_still_waits_for_the_pump_to_stop() -> None:
    mirror = in_state(State.HOLD)
    mirror.tick(latched_faults=4)
    mirror.tick("ack", pump_fraction=0.5)
    mirror.tick(pump_fraction=0.5)
    assert mirror.controller.state == State.FAULT
    mirror.tick("latch", pump_fraction=0.5)
    for _ in range(5):
        mirror.tick()
    assert mirror.controller.state == State.FAULT


def test_a_latch_ends_a_ramp_down_at_once() -> None:
    mirror = in_state(State.HOLD)
    for _ in range(12):
        mirror.tick(gauge_pressure_pa=math.nan)
    assert mirror.last is not None
    assert mirror.last.row.safe_level == SafeLevel.RAMP_DOWN
    assert mirror.last.command.pump_fraction > 0.0
    assert mirror.tick("latch").command.pump_fraction == 0.0


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_a_lowering_command_overrules_a_lifting_one_in_either_order(state: State) -> None:
    for down, lifting in itertools.product(("vent", "stop", "lower"), LIFTING):
        answers = []
        for batch in orders(down, lifting):  # type: ignore[arg-type]  # literals of the table
            mirror = in_state(state)
            outputs = mirror.tick(*batch)
            events = {
                event.command: bool(event.refused)
                for event in outputs.events
                if isinstance(event, CommandTaken)
            }
            answers.append(events)
            assert events[lifting] or events[down], batch
            if not events[down]:
                assert mirror.controller.state not in MOVING | {State.CHECK}
        assert answers[0] == answers[1]


def test_vent_and_stop_in_one_tick_end_the_run_with_an_open_vent() -> None:
    for batch in orders("vent", "stop"):
        mirror = in_state(State.HOLD)
        mirror.tick(*batch)
        for _ in range(60):
            outputs = mirror.tick()
            assert outputs.command.vent_fraction == 1.0
            if outputs.finished is not None:
                break
        assert outputs.finished is not None


def test_a_stop_while_venting_leaves_the_vent_open() -> None:
    mirror = in_state(State.LOWER)
    assert mirror.tick("stop").command.vent_fraction == 1.0
    assert mirror.tick().command.vent_fraction == 1.0


def test_a_vent_in_the_tick_of_a_fault_opens_the_vent() -> None:
    mirror = in_state(State.HOLD)
    outputs = mirror.tick("vent", latched_faults=4)
    assert mirror.controller.state == State.FAULT
    assert outputs.command.vent_fraction == 1.0
    assert mirror.tick().command.vent_fraction == 1.0


def test_commands_follow_the_table_and_otherwise_their_arrival() -> None:
    kinds: tuple[Kind, ...] = ("hold", "lower", "mark", "stop", "vent", "latch", "ack")
    ordered = [made.kind for made in sort_commands(command(kind) for kind in kinds)]
    assert ordered == [*DOWN, "hold", "mark", "ack"]
