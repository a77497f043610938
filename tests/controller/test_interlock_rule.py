"""Interlocks in the tick: the effect of an open circuit in each state, and an identical replay."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from firmware_iface.roles import BenchReading
from firmware_iface.settings import BoardInputConfig, ModbusInputConfig
from membrane_ctrl.config.schema import Config, DevicesConfig, ResumeConfig, StatesConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.controller.tick_checksum import output_crc
from membrane_ctrl.controller.tick_codec import pack_tick, unpack_tick
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import (
    CommandTaken,
    Event,
    Fault,
    InterlockClosed,
    InterlockOpened,
    Resumed,
    Why,
)
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from membrane_ctrl.sim.virtual_interlocks import VirtualInterlocks

DOOR, STOP, SUPPLY = 0, 1, 2
INTERLOCKS = (
    BoardInputConfig(
        driver="board_input", name="door", text="shut the door", safe_level="pump_off", input=3
    ),
    BoardInputConfig(
        driver="board_input", name="stop_button", text="pull the button", safe_level="vent", input=0
    ),
    ModbusInputConfig(
        driver="modbus_input",
        name="supply",
        text="open the bottle",
        safe_level="ramp_down",
        link="tcp://plc",
        address=7,
    ),
)
LEVELS = {"door": SafeLevel.PUMP_OFF, "stop_button": SafeLevel.VENT, "supply": SafeLevel.RAMP_DOWN}
STATES = StatesConfig(stay_after_trip=True)
RESUME = ResumeConfig(faults=("link_lost", "device_silent", "watchdog_tripped"), wait_s=1.0)
CONFIG = Config(
    loop={"rate_hz": 20.0},
    states=STATES,
    resume=RESUME,
    twin={"scenario": "quiet"},
    devices=DevicesConfig(board="tcp://twin", interlocks=INTERLOCKS),
)


class Rig:
    """A virtual run, tick by tick, with the events so far."""

    def __init__(
        self,
        config: Config = CONFIG,
        alter: Callable[[float, BenchReading], BenchReading | None] | None = None,
    ) -> None:
        plant = Plant(config.twin, config.pump)
        self.config = config
        self.circuits = VirtualInterlocks(config.interlocks)
        self.bench = VirtualBench(plant, 0.5, interlocks=self.circuits)
        self.run = VirtualRun(config, self.bench, zernike_projection(), alter=alter)
        self.ticks: list[VirtualTick] = []
        self.events: list[Event] = []

    def tick(self, *commands: Command) -> VirtualTick:
        made = self.run.run_tick(commands)
        assert made is not None
        self.ticks.append(made)
        self.events += made.events
        return made

    def go(self, seconds: float, *commands: Command) -> VirtualTick:
        last = self.tick(*commands)
        for _ in range(round(seconds * self.config.loop.rate_hz) - 1):
            last = self.tick()
        return last

    def until(self, state: State, *commands: Command, most_s: float = 60.0) -> VirtualTick:
        last = self.tick(*commands)
        while last.row.state != state and self.run.now_s < most_s:
            last = self.tick()
        assert State(int(last.row.state)) == state
        return last

    def of(self, kind: type[Event]) -> list[Event]:
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def faults(self) -> list[str]:
        return [event.name for event in self.events if isinstance(event, Fault)]

    @property
    def why(self) -> str:
        return next(event.why for event in reversed(self.events) if isinstance(event, Why))


def hold() -> Command:
    return Command("hold", "ann")


@pytest.mark.parametrize("name", LEVELS)
def test_an_open_circuit_enters_its_own_level_in_the_tick_that_shows_it_and_is_named(
    name: str,
) -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.open_names = {name}
    tick = rig.tick()
    fault = next(event for event in tick.events if isinstance(event, Fault))
    interlock = next(each for each in INTERLOCKS if each.name == name)
    assert (fault.name, fault.safe_level) == ("interlock_open", LEVELS[name].name.lower())
    assert fault.latching
    assert fault.seen == f"interlock {name} is open: {interlock.text}"
    assert State(int(tick.row.state)) == State.FAULT
    assert SafeLevel(int(tick.row.safe_level)) == LEVELS[name]
    assert tick.row.vent_fraction == (1.0 if name == "stop_button" else 0.0)
    assert (tick.row.pump_fraction == 0.0) == (
        name != "supply"
    )  # a ramp begins at the present flow
    assert rig.of(InterlockOpened) == [
        InterlockOpened(name, interlock.text, LEVELS[name].name.lower())
    ]


@pytest.mark.parametrize(
    "state", [State.CHECK, State.INFLATE, State.SETTLE, State.HOLD, State.MANUAL, State.LOWER]
)
def test_an_interlock_is_judged_in_every_state_in_which_gas_moves(state: State) -> None:
    rig = Rig()
    rig.until(State.HOLD if state in (State.MANUAL, State.LOWER) else state, hold())
    if state == State.MANUAL:
        rig.until(State.MANUAL, Command("manual", "ann", value=1.0))
    if state == State.LOWER:
        rig.until(State.LOWER, Command("vent", "ann"))
    rig.circuits.open_names = {"stop_button"}
    tick = rig.tick()
    assert SafeLevel(int(tick.row.safe_level)) == SafeLevel.VENT
    assert rig.faults[-1:] == ["interlock_open"]


def test_an_open_interlock_in_standby_is_no_fault_but_prevents_a_hold() -> None:
    rig = Rig()
    rig.go(1.0)
    rig.circuits.open_names = {"door"}
    rig.go(2.0)
    assert rig.faults == []
    assert rig.why == "standby: interlock door is open: shut the door"
    rig.tick(hold())
    (taken,) = rig.of(CommandTaken)
    assert isinstance(taken, CommandTaken)
    assert taken.refused == "interlock door is open: shut the door; close it first"
    rig.circuits.open_names = set()
    rig.go(5.0)
    assert State(int(rig.ticks[-1].row.state)) == State.STANDBY
    assert rig.of(InterlockClosed) == [InterlockClosed("door")]
    rig.until(State.HOLD, hold())


def test_a_circuit_that_opens_in_the_tick_of_the_command_refuses_it() -> None:
    rig = Rig()
    rig.go(1.0)
    rig.circuits.open_names = {"door"}
    tick = rig.tick(hold())
    assert tick.outputs.answers == ((0, "interlock door is open: shut the door; close it first"),)
    assert State(int(rig.go(1.0).row.state)) == State.STANDBY


def test_the_program_can_be_ended_in_standby_while_a_door_is_open() -> None:
    rig = Rig()
    rig.circuits.open_names = {"door"}
    rig.go(1.0)
    rig.tick(Command("stop", "ann"))
    while rig.run.finished is None:
        rig.tick()
    assert rig.faults == []
    assert rig.run.finished.name == "INTERRUPTED"


def test_an_interlock_that_opens_while_lowering_from_standby_is_a_fault() -> None:
    rig = Rig()
    rig.circuits.open_names = {"door"}
    rig.go(1.0)
    rig.until(State.LOWER, Command("vent", "ann"))
    rig.go(1.0)
    assert rig.faults == []
    rig.circuits.open_names = {"door", "stop_button"}
    rig.tick()
    assert rig.faults == ["interlock_open"]


def test_a_door_closed_and_opened_again_on_the_way_down_counts() -> None:
    rig = Rig()
    rig.circuits.open_names = {"door"}
    rig.go(1.0)
    rig.until(State.LOWER, Command("vent", "ann"))
    rig.circuits.open_names = set()
    rig.go(1.0)
    rig.circuits.open_names = {"door"}
    rig.tick()
    assert rig.faults == ["interlock_open"]


@pytest.mark.parametrize("first", ["supply", "door"])
def test_a_deeper_interlock_during_a_fault_deepens_the_level_and_a_milder_one_does_not(
    first: str,
) -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.open_names = {first}
    rig.tick()
    rig.circuits.open_names = {"stop_button"}
    assert SafeLevel(int(rig.tick().row.safe_level)) == SafeLevel.VENT
    rig.circuits.open_names = {"supply"}
    assert SafeLevel(int(rig.go(1.0).row.safe_level)) == SafeLevel.VENT
    assert len(rig.faults) == 1


def test_several_open_interlocks_enter_the_deepest_level_and_are_all_named() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.lost_names = {"supply"}
    rig.go(INTERLOCKS[SUPPLY].age_max_s - 0.05)  # type: ignore[union-attr]  # counts as open in the next tick
    rig.circuits.open_names = {"door", "stop_button"}
    tick = rig.tick()
    assert SafeLevel(int(tick.row.safe_level)) == SafeLevel.VENT
    fault = next(event for event in tick.events if isinstance(event, Fault))
    assert fault.safe_level == "vent"
    assert "interlock door is open" in fault.seen
    assert "interlock stop_button is open" in fault.seen


def test_an_interlock_that_opens_during_a_resume_cancels_the_hold() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.bench.wrong.unreachable = True
    rig.go(3.0)
    rig.bench.wrong.unreachable = False
    rig.until(State.STANDBY)
    assert len(rig.of(Resumed)) == 1
    rig.circuits.open_names = {"door"}
    assert State(int(rig.tick().row.state)) == State.STANDBY
    rig.circuits.open_names = set()
    assert State(int(rig.go(5.0).row.state)) == State.STANDBY


def test_an_interlock_deepens_another_fault_which_then_never_resumes() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.bench.wrong.unreachable = True
    rig.go(3.0)
    assert rig.faults == ["link_lost"]
    rig.circuits.open_names = {"door"}
    rig.bench.wrong.unreachable = False
    rig.go(2.0)
    rig.circuits.open_names = set()
    rig.go(30.0)
    assert State(int(rig.ticks[-1].row.state)) == State.FAULT
    assert rig.of(Resumed) == []


def test_the_same_fault_without_an_interlock_resumes() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.bench.wrong.unreachable = True
    rig.go(3.0)
    rig.bench.wrong.unreachable = False
    rig.until(State.STANDBY)
    assert len(rig.of(Resumed)) == 1


def test_an_interlock_never_resumes_automatically_and_an_ack_while_open_leads_to_standby() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.open_names = {"door"}
    rig.tick()
    rig.circuits.open_names = set()
    rig.go(30.0)
    assert State(int(rig.ticks[-1].row.state)) == State.FAULT
    rig.circuits.open_names = {"door"}
    rig.go(1.0)
    rig.until(State.STANDBY, Command("ack", "ann"))
    rig.tick(hold())
    assert State(int(rig.go(2.0).row.state)) == State.STANDBY
    rig.circuits.open_names = set()
    rig.tick()
    rig.until(State.HOLD, hold(), most_s=200.0)


def test_a_lost_signal_of_a_polled_circuit_is_open_after_its_age() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.lost_names = {"supply"}
    rig.go(INTERLOCKS[SUPPLY].age_max_s - 0.1)  # type: ignore[union-attr]
    assert rig.faults == []
    rig.go(0.3)
    assert rig.faults == ["interlock_open"]


def test_a_lost_signal_at_the_board_is_open_at_once() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.lost_names = {"door"}
    rig.tick()
    assert rig.faults == ["interlock_open"]


def test_a_tick_without_an_answer_shows_no_interlock_and_does_not_hide_one() -> None:
    lost = [False]
    rig = Rig(alter=lambda _, reading: None if lost[0] else reading)
    rig.until(State.HOLD, hold())
    lost[0] = True
    tick = rig.tick()
    assert math.isnan(tick.row.interlocks_open)
    assert rig.faults == []
    lost[0] = False
    rig.circuits.open_names = {"door"}
    assert rig.tick().row.interlocks_open == 1.0
    assert rig.faults == ["interlock_open"]


def test_a_board_without_inputs_shows_every_circuit_open() -> None:
    rig = Rig(alter=lambda _, reading: replace(reading, interlocks_open=0b11))
    rig.tick(hold())
    assert rig.run.finished is None
    assert State(int(rig.go(1.0).row.state)) == State.STANDBY


def test_bits_beyond_the_configuration_are_ignored() -> None:
    rig = Rig(
        alter=lambda _, reading: replace(reading, interlocks_open=reading.interlocks_open | 0b11000)
    )
    rig.until(State.HOLD, hold())
    assert rig.faults == []


def test_without_interlocks_the_row_has_none() -> None:
    rig = Rig(CONFIG.model_copy(update={"devices": None}))
    assert math.isnan(rig.tick().row.interlocks_open)


def test_the_status_names_the_open_ones() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.open_names = {"door", "supply"}
    rig.go(1.0)
    status = RunStatus()
    for event in rig.events:
        status = status.after_event(event)
    door, supply = (
        "Interlock door is open: shut the door",
        "Interlock supply is open: open the bottle",
    )
    assert [notice.text for notice in status.other_notices] == [door, supply]
    assert [
        notice.text for notice in status.after_event(InterlockClosed("door")).other_notices
    ] == [supply]


def test_a_replay_decides_the_same_to_the_last_bit() -> None:
    rig = Rig()
    rig.until(State.HOLD, hold())
    rig.circuits.open_names = {"supply"}
    rig.go(1.0)
    rig.circuits.open_names = {"stop_button"}
    rig.go(1.0)
    rig.circuits.open_names = set()
    rig.go(1.0, Command("ack", "ann"))
    packed = [
        message
        for number, tick in enumerate(rig.ticks, 1)
        for message in pack_tick(number, tick.inputs, tick.outputs, tick.row.pack())
    ]
    batch = TickAssembler().add_messages(packed)
    controller = Controller(CONFIG, zernike_projection())
    again = [
        controller.tick(unpack_tick(record, batch.tails.get(int(record["tick"]), b""), {}))
        for record in batch.records
    ]
    assert [output_crc(outputs, outputs.row.pack()) for outputs in again] == batch.records[
        "output_crc"
    ].tolist()
    assert {int(record["interlocks_open"]) for record in batch.records} == {0, 0b010, 0b100}


def test_the_mask_is_part_of_the_checksum() -> None:
    rig = Rig()
    outputs = rig.tick().outputs
    other = replace(outputs.row, interlocks_open=1.0)
    assert output_crc(outputs, outputs.row.pack()) != output_crc(outputs, other.pack())


def test_a_snapshot_contains_the_interlocks_open_since_standby() -> None:
    rig = Rig()
    rig.circuits.open_names = {"door"}
    rig.go(1.0)
    controller = rig.run._supervisor._controller
    again = continue_from(take_snapshot(controller), CONFIG, zernike_projection())
    inputs = replace(rig.tick(Command("vent", "ann")).inputs, commands=(Command("vent", "ann"),))
    again.tick(inputs)
    outputs = again.tick(rig.tick().inputs)
    assert not [event for event in outputs.events if isinstance(event, Fault)]
