"""With any readings and any commands in any order, the invariants of the state machine hold
(hypothesis).
"""

from __future__ import annotations

import json
import math

from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, DevicesConfig, LoopConfig, ShapeConfig, StatesConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import TABLE
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.state_sets import MOVING
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.telemetry import SafeLevel, State

DT_S = 0.1
INTERLOCKS = tuple(
    {"driver": "board_input", "name": level, "text": "x", "safe_level": level, "input": place}
    for place, level in enumerate(("ramp_down", "pump_off", "vent"))
)
CONFIG = Config(
    devices=DevicesConfig.model_validate({"board": "tcp://twin", "interlocks": INTERLOCKS}),
    loop=LoopConfig(rate_hz=1 / DT_S),
    shape=ShapeConfig(enabled=False),
    states=StatesConfig(
        check_s=0.3, actuator_test=False, settle_s=0.3, hold_flow_max_s=1.0, ramp_down_s=1.0
    ),
)
MAY_PUMP = MOVING | {State.CHECK, State.FAULT}

anything = st.floats(allow_nan=True, allow_infinity=True, width=32)
readings = st.builds(
    BenchReading,
    displacement_um=st.one_of(st.floats(-30, 30), anything),
    displacement_quality=st.sampled_from([0, 0, 0, 1]),
    gauge_pressure_pa=st.one_of(st.floats(590, 610), anything),
    ambient_pressure_pa=st.one_of(st.just(101325.0), anything),
    air_temperature_c=st.one_of(st.just(23.0), anything),
    gas_temperature_c=anything,
    pump_fraction=st.one_of(
        st.just(math.inf), st.floats(0, 1), anything
    ),  # inf: what was commanded
    vent_fraction=st.one_of(st.just(0.0), anything),
    sample_counter=st.integers(0, 3),  # how far it advances
    device_time_s=st.just(0.0),
    watchdog_tripped=st.sampled_from([False] * 9 + [True]),
    latched_faults=st.sampled_from([0] * 9 + [1]),
    interlocks_open=st.sampled_from([0] * 9 + [1, 2, 4]),
)
steady = BenchReading(0.0, 0, 600.0, 101325.0, 23.0, 23.0, math.inf, 0.0, 1, 0.0, False, 0)
commands = st.builds(
    Command,
    kind=st.sampled_from(
        [*sorted(set(TABLE) - {"tune"}), "manual", "manual", "manual", "hold", "setpoint", "ack"]
    ),
    who=st.just("hypothesis"),
    value=st.one_of(st.floats(0, 5), st.floats(0, 5), st.floats(-20, 20), anything),
    text=st.sampled_from(["", "x"]),
    loop=st.sampled_from([None, CONFIG.loop]),
)
steps = st.tuples(
    st.one_of(st.just(steady), st.just(steady), st.just(steady), readings, st.none()),
    st.lists(commands, max_size=2),
    st.integers(1, 12),  # repeated so often
    st.sampled_from([True] * 9 + [False]),  # link up
)
warms = st.sampled_from([0, 5, 20, 40])


class Driver:
    """Feeds a controller, and checks its outputs against the invariants."""

    def __init__(self, warm: int = 0) -> None:
        self.controller = Controller(CONFIG, zernike_projection())
        self.tick, self.counter, self.pump = 0, 0, 0.0
        self.safe_level, self.finished = SafeLevel.NONE, False
        self.fault_pump = math.inf
        self.feed(steady, (Command("hold", "hypothesis"),), True)
        for _ in range(warm):
            self.feed(steady, (), True)

    def feed(self, reading: BenchReading | None, asked: tuple[Command, ...], link_up: bool) -> None:
        if self.finished:
            return
        self.tick += 1
        if reading is not None:
            self.counter += reading.sample_counter
            pump = self.pump if reading.pump_fraction == math.inf else reading.pump_fraction
            noise = 1e-3 * (self.tick % 7)
            reading = BenchReading(
                reading.displacement_um + noise,
                reading.displacement_quality,
                reading.gauge_pressure_pa,
                reading.ambient_pressure_pa,
                reading.air_temperature_c,
                reading.gas_temperature_c,
                pump,
                reading.vent_fraction,
                self.counter,
                0.1 * self.counter,
                reading.watchdog_tripped,
                reading.latched_faults,
                interlocks_open=reading.interlocks_open,
            )
        inputs = TickInputs(
            now_s=self.tick * DT_S,
            dt_s=DT_S,
            reading=reading if link_up else None,
            link_up=link_up,
            commands=asked,
        )
        interlock_open = inputs.reading is not None and inputs.reading.interlocks_open != 0
        self.look(self.controller.tick(inputs), len(asked), interlock_open)

    def look(self, outputs: TickOutputs, asked: int, interlock_open: bool) -> None:
        row, command = outputs.row, outputs.command
        state, safe_level = State(int(row.state)), SafeLevel(int(row.safe_level))
        assert 0.0 <= command.pump_fraction <= 1.0
        assert 0.0 <= command.vent_fraction <= 1.0
        assert command.pump_fraction == 0 or state in MAY_PUMP
        assert command.pump_fraction == 0 or safe_level < SafeLevel.PUMP_OFF
        assert safe_level != SafeLevel.VENT or command.vent_fraction == 1.0
        assert (safe_level > SafeLevel.HOLD_FLOW) == (state == State.FAULT)
        assert (row.fault != 0) == (safe_level != SafeLevel.NONE)
        assert (
            safe_level >= self.safe_level
            or self.safe_level == SafeLevel.HOLD_FLOW
            or state == State.STANDBY
        )
        if state == State.FAULT:
            assert command.pump_fraction <= self.fault_pump
            self.fault_pump = command.pump_fraction
        else:
            self.fault_pump = math.inf
        assert not interlock_open or state in (State.STANDBY, State.LOWER, State.FAULT)
        assert len(outputs.answers) == asked
        for event in outputs.events:
            json.dumps(event.to_dict(), allow_nan=False, default=str)
        if outputs.finished is not None:
            assert command.pump_fraction == 0
            self.finished = True
        self.safe_level, self.pump = safe_level, command.pump_fraction


@settings(max_examples=120, deadline=None, derandomize=True)
@given(warms, st.lists(steps, min_size=1, max_size=40))
def test_no_order_of_readings_and_commands_breaks_an_invariant(
    warm: int,
    given_steps: list[tuple],  # type: ignore[type-arg]
) -> None:
    driver = Driver(warm)
    for reading, asked, repeats, link_up in given_steps:
        for repeat in range(repeats):
            driver.feed(reading, tuple(asked) if repeat == 0 else (), link_up)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(warms, st.lists(commands.filter(lambda command: command.kind != "latch"), max_size=60))
def test_no_order_of_commands_alone_trips_a_healthy_mirror(warm: int, asked: list[Command]) -> None:
    driver = Driver(warm)
    for command in asked:
        driver.feed(steady, (command,), True)
        for _ in range(5):
            driver.feed(steady, (), True)
        assert driver.controller.state != State.FAULT, command


def test_the_generated_sequences_reach_every_state() -> None:
    """The properties above would not cover states that their examples never reach."""
    seen: set[State] = set()

    @settings(max_examples=240, deadline=None, derandomize=True, database=None)
    @given(warms, st.lists(steps, min_size=10, max_size=40))
    def walk(warm: int, given_steps: list[tuple]) -> None:  # type: ignore[type-arg]
        driver = Driver(warm)
        for reading, asked, repeats, link_up in given_steps:
            for repeat in range(repeats):
                driver.feed(reading, tuple(asked) if repeat == 0 else (), link_up)
                seen.add(driver.controller.state)

    walk()
    assert seen >= set(State) - {State.TUNE}
