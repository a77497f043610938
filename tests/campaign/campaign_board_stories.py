"""Stories of the board: two programs on it, a gateway between, counters that wrap, its own limits
and latches.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from campaign_stage import OldBoard, Stage, another_client, sensors_say
from campaign_times import BOARD_PRESSURE_MAX_PA, TICK_S, WATCHDOG_S
from campaign_world import WatchedPlant

from firmware_iface.emulators.modbus_pdu import RegisterRefusal
from firmware_iface.emulators.pump_board import BoardSample, StoredSettings
from firmware_iface.register_map import load_default_map
from firmware_iface.roles import BenchCommand, LinkError
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.virtual_bench import VirtualBench, Wrong, at_once

_GAUGE_TIMEOUT_S, _GAUGE_FROZEN_S = 4.0, 6.0  # of the boards of these stories
_DOOR = 0b100  # bit of the interlock input that is fitted


class GuardedBoard(Stage):
    """A board with a fitted gauge and a fitted interlock input, unknown to the controller."""

    def __init__(self, gauge_fitted: bool = True) -> None:
        self._gauge_fitted = gauge_fitted
        super().__init__()

    def make_bench(self) -> VirtualBench:
        stored = StoredSettings(
            gauge_fitted=self._gauge_fitted,
            gauge_timeout_s=_GAUGE_TIMEOUT_S,
            gauge_frozen_s=_GAUGE_FROZEN_S,
            interlocks_fitted=_DOOR,
        )
        return VirtualBench(self.plant, WATCHDOG_S, stored)

    def pump_without_a_controller(self, seconds: float, check: Callable[[], str]) -> None:
        """A program writes a little flow again and again, whatever is read."""
        for _ in range(round(seconds / TICK_S)):
            self.bench.advance(TICK_S)
            self.bench.write(BenchCommand(0.3, 0.0))
            self.bench.drive_actuators()
            if wrong := check():
                self.must(False, wrong)


def _must_pump(stage: Stage) -> str:
    return "" if stage.plant.pump_given > 0 else "the board stops a pump that nothing forbids"


def counters_wrap() -> list[str]:
    """Heartbeat and sample counter wrap in a hold: nothing happens."""
    stage = OldBoard().held()
    stage.wait(40.0, lambda: "" if stage.state == State.HOLD else "the hold was lost")
    stage.near()
    return stage.violations


def a_gateway_repeats_the_last_write() -> list[str]:
    """The controller dies: neither a gateway's repetitions nor the reads of others feed the
    watchdog.
    """
    stage = Stage()
    board, command = stage.bench.board, load_default_map().block("command")
    written: list[list[int]] = []
    write = board.write

    def noting(address: int, words: Sequence[int]) -> None:
        if address == command.address:
            written.append(list(words))
        write(address, words)

    board.write = noting  # type: ignore[method-assign]
    stage.held()
    board.write = write  # type: ignore[method-assign]
    stage.bench.wrong.stalled = True
    sensors = load_default_map().block("sensors")
    died_s = stage.run.now_s

    def repeat() -> str:
        board.write(command.address, written[-1])
        board.read(sensors.address, sensors.count)
        stage.bench.drive_actuators()
        return stage.still() if stage.run.now_s > died_s + WATCHDOG_S + 3 * TICK_S else ""

    stage.wait(5.0, repeat)
    return stage.violations


def others_disarm_the_watchdog() -> list[str]:
    """Another program writes `watchdog_arm` 0 in every possible way while the pump runs; then the
    controller dies.
    """
    stage = Stage().held()
    settings = load_default_map().block("settings")
    arm = load_default_map().register("watchdog_arm")
    off = settings.encode(
        {register.name: 0.0 for register in settings.registers} | {"watchdog_period_s": 10.0}
    )
    for address, words in ((arm.address, [0]), (settings.address, off)):
        with contextlib.suppress(RegisterRefusal):
            stage.bench.board.write(address, words)
    with contextlib.suppress(LinkError):  # the holder itself, in the middle of its hold
        stage.bench.close()
    stage.bench.wrong.stalled = True
    stage.wait(WATCHDOG_S + 3 * TICK_S)
    stage.wait(5.0, stage.still)
    return stage.violations


def a_stranger_writes_the_command() -> list[str]:
    """A program without a claim writes full pump again and again during a hold: none of it reaches
    the pump.
    """
    stage = Stage().held()
    command = load_default_map().block("command")
    values = dict.fromkeys((register.name for register in command.registers), 0.0) | {
        "pump_command_fraction": 1.0
    }
    for number in range(50):
        stage.tick()
        before = stage.plant.pump_given
        with contextlib.suppress(RegisterRefusal):
            stage.bench.board.write(command.address, command.encode(values | {"heartbeat": number}))
        stage.bench.drive_actuators()
        stage.must(stage.plant.pump_given == before, "a stranger's command arrives")
    return stage.violations


def a_board_that_takes_no_settings() -> list[str]:
    """The board ignores watchdog period and arming: no hold starts with such a board."""
    stage = Stage()
    bench = VirtualBench(
        WatchedPlant(stage.world, stage.config.twin, stage.config.pump), WATCHDOG_S
    )
    settings, write = load_default_map().block("settings"), bench.board.write

    def deaf(address: int, words: Sequence[int]) -> None:
        if address != settings.address:
            write(address, words)

    bench.board.write = deaf  # type: ignore[method-assign]
    with contextlib.suppress(LinkError):
        bench.open()
        stage.must(False, "a board without its watchdog is opened")
    return stage.violations


def faults_are_cleared_and_the_pump_stands() -> list[str]:
    """The board's faults are cleared while nobody commands:
    the pump stays off until somebody does.
    """
    stage = Stage().held()
    stage.bench.wrong.stalled = True
    stage.wait(2.0)
    stage.bench.open()
    stage.bench.clear_faults(0xFFFF)
    stage.bench.drive_actuators()
    stage.must(not stage.still(), "clearing the faults starts the pump")
    stage.bench.power_cycle()
    stage.must(not stage.still(), "the pump runs after a restart of the board")
    return stage.violations


def a_latched_board_keeps_the_pump_off() -> list[str]:
    """A board that has latched over-pressure keeps the pump off and vents,
    whatever is commanded.
    """
    stage = Stage()
    stage.bench.wrong.gauge_offset_pa = 300.0
    stage.wait(1.0)
    stage.bench.wrong.gauge_offset_pa = 0.0
    for _ in range(50):
        stage.bench.advance(TICK_S)
        stage.bench.write(BenchCommand(0.7, 0.0))
        stage.must(not stage.still(), "the board pumps with a fault latched")
        stage.must(
            stage.plant.vent_given == 1.0, "the board's vent is shut with over-pressure latched"
        )
    return stage.violations


def another_program_opens_the_board_of_a_hold() -> list[str]:
    """It is refused, and the hold's watchdog stays as it was: when the hold dies,
    its pump stops.
    """
    stage = Stage().held()
    other = another_client(stage, 10.0)
    refused = False
    try:
        at_once(other.open())
    except LinkError:
        refused = True
    stage.must(refused, "two programs hold one board")
    stage.wait(
        1.0,
        lambda: (
            "" if stage.state == State.HOLD else "the hold was lost to a client that was refused"
        ),
    )
    stage.bench.wrong.stalled = True
    stage.wait(WATCHDOG_S + 3 * TICK_S)
    stage.wait(10.0, stage.still)
    return stage.violations


def another_program_takes_the_board_of_a_dead_hold() -> list[str]:
    """A hold is stopped for a second, and another program takes its board: the resumed hold moves
    no gas.
    """
    stage = Stage().held()
    stage.bench.wrong.stalled = True
    stage.wait(1.0)
    other = another_client(stage)
    at_once(other.open())
    at_once(other.clear_faults(0xFFFF))
    stage.bench.wrong.stalled = False

    def goes_on() -> str:
        at_once(other.write(BenchCommand(0.0, 0.0)))
        return stage.still()

    stage.wait(20.0, goes_on)
    stage.must(stage.state == State.FAULT, "the hold does not notice that its board is another's")
    return stage.violations


def anybody_may_stop_the_pump() -> list[str]:
    """`safe` beside a hold that may resume every fault: the pump stays off until a person clears
    it.
    """
    for resumes in (False, True):
        stage = Stage(resumes=resumes).held()
        other = another_client(stage)
        at_once(other.identify())
        at_once(other.stop())
        stage.bench.drive_actuators()
        stage.wait(60.0, stage.still)
        stage.must(stage.state == State.FAULT, "the hold does not notice that it was stopped")
        if stage.violations:
            break
    return stage.violations


def over_pressure_while_the_network_is_cut(resumes: bool = True) -> list[str]:
    """The board vents while it cannot be reached: only a person may inflate again."""
    stage = Stage(resumes=resumes).held()
    stage.bench.wrong.unreachable = True
    stage.wait(1.0)
    stage.bench.wrong.gauge_offset_pa = 300.0
    stage.wait(1.0)
    stage.bench.wrong.gauge_offset_pa = 0.0
    stage.wait(1.0)
    stage.bench.wrong.unreachable = False
    stage.wait(60.0, stage.still)
    stage.must(stage.plant.vent_given == 1.0, "the vent is shut after the board's over-pressure")
    return stage.violations


def hold_is_asked_of_a_latched_board() -> list[str]:
    """A mirror whose board has latched over-pressure is not inflated,
    however often `hold` is sent.
    """
    stage = Stage()
    stage.bench.wrong.gauge_offset_pa = 300.0
    stage.tick()
    stage.bench.wrong.gauge_offset_pa = 0.0
    stage.wait(1.0, stage.still)
    stage.ask("hold")
    stage.wait(
        30.0,
        lambda: (
            stage.still() or ("went on" if stage.state in (State.INFLATE, State.SETTLE) else "")
        ),
    )
    return stage.violations


def what_is_read_is_true() -> list[str]:
    """The driver reports the plant's values."""
    stage = Stage().held()
    for _ in range(20):
        stage.bench.advance(TICK_S)
        stage.bench.write(BenchCommand(0.4, 0.25))
        stage.bench.advance(TICK_S)
        reading, truth = stage.bench.read(), stage.bench.truth
        stage.must(
            abs(reading.gauge_pressure_pa - truth.gauge_pressure_pa) < 4.0,
            "the pressure read is not the true one",
        )
        stage.must(
            abs(reading.displacement_um - truth.displacement_um) < 8.0,
            "the sag read is not the true one",
        )
        stage.must(
            abs(reading.pump_fraction - stage.plant.pump_given) < 0.01,
            "the pump's read-back is not its drive",
        )
        stage.must(
            abs(stage.plant.pump_given - 0.4) < 0.01, "the pump is not given what was written"
        )
        stage.must(
            abs(stage.plant.vent_given - 0.25) < 0.01, "the vent is not given what was written"
        )
    return stage.violations


def the_board_alone_keeps_its_limit() -> list[str]:
    """A controller writes full pump for ever: the board stops the
    pump at its own limit and vents.
    """
    stage = Stage()
    for _ in range(round(1500.0 / TICK_S)):
        stage.bench.advance(TICK_S)
        stage.bench.write(BenchCommand(1.0, 0.0))
        pressure_pa = stage.plant.truth().gauge_pressure_pa
        if pressure_pa > BOARD_PRESSURE_MAX_PA + 2.5:
            stage.must(False, f"the board let the pressure rise to {pressure_pa:.0f} Pa")
            break
        if stage.plant.vent_given == 1.0:
            break
    stage.must(stage.plant.vent_given == 1.0, "the board never vented")
    return stage.violations


def the_board_alone_stops_without_its_gauge() -> list[str]:
    """The gauge has no value, or repeats one, and a program pumps on: the board stops the pump
    after its own times, and not before.
    """
    violations: list[str] = []
    for fault, limit_s in (("gauge_lost", _GAUGE_TIMEOUT_S), ("gauge_stuck", _GAUGE_FROZEN_S)):
        stage = GuardedBoard()
        stage.pump_without_a_controller(2.0, lambda stage=stage: _must_pump(stage))  # type: ignore[misc]
        setattr(stage.bench.wrong, fault, True)
        stage.pump_without_a_controller(limit_s - 1.0, lambda stage=stage: _must_pump(stage))  # type: ignore[misc]
        stage.pump_without_a_controller(1.0 + 3 * TICK_S, lambda: "")
        stage.pump_without_a_controller(5.0, stage.still)
        stage.bench.wrong = Wrong()
        stage.pump_without_a_controller(5.0, stage.still)  # a person must clear it
        violations += stage.violations
    return violations


def a_board_without_the_value_of_its_gauge_never_pumps() -> list[str]:
    """Switched on without a value of the gauge, or cleared while it is missing: no command drives
    the pump, not even up to the next sample.
    """
    stage = GuardedBoard()
    stage.bench.wrong.gauge_lost = True
    stage.bench.advance(TICK_S)
    stage.bench.power_cycle()
    stage.bench.open()
    stage.pump_without_a_controller(5.0, stage.still)
    for _ in range(3):
        stage.bench.clear_faults(0xFFFF)
        stage.pump_without_a_controller(2.0, stage.still)
    return stage.violations


def a_gauge_that_repeats_its_value_with_gaps() -> list[str]:
    """A frozen gauge is missing in every other second: the board stops the pump none the later."""
    stage = GuardedBoard()
    stage.pump_without_a_controller(2.0, lambda: _must_pump(stage))
    frozen_pa = stage.bench.read().gauge_pressure_pa

    def freeze(sample: BoardSample) -> BoardSample:
        missing = round(sample.device_time_s) % 2
        return replace(sample, gauge_pressure_pa=math.nan if missing else frozen_pa)

    sensors_say(stage, freeze)
    stage.pump_without_a_controller(_GAUGE_FROZEN_S + 1.0, lambda: "")
    stage.pump_without_a_controller(5.0, stage.still)
    return stage.violations


def a_board_without_a_gauge_pumps() -> list[str]:
    """Its stored settings say that no gauge is fitted: that it has no value stops nothing."""
    stage = GuardedBoard(gauge_fitted=False)
    stage.bench.wrong.gauge_lost = True
    stage.pump_without_a_controller(2 * _GAUGE_FROZEN_S, lambda: _must_pump(stage))
    return stage.violations


def the_board_alone_stops_at_an_open_interlock() -> list[str]:
    """A circuit opens for a moment, while the pump runs or stands: the board keeps the pump off
    until a person clears the fault.
    """
    violations: list[str] = []
    for runs in (True, False):
        stage = GuardedBoard()
        if runs:
            stage.pump_without_a_controller(2.0, lambda stage=stage: _must_pump(stage))  # type: ignore[misc]
        stage.bench.wrong.open_interlocks = _DOOR
        stage.bench.advance(TICK_S)
        stage.must(not stage.still(), "the pump runs beside an open circuit")
        stage.bench.wrong.open_interlocks = 0
        stage.pump_without_a_controller(5.0, stage.still)
        stage.bench.clear_faults(0xFFFF)
        stage.must(not stage.still(), "clearing the fault starts the pump")
        stage.pump_without_a_controller(1.0, lambda: "")
        stage.must(stage.plant.pump_given > 0, "the board stops a pump that nothing forbids")
        violations += stage.violations
    return violations


def other_inputs_of_the_board_stop_nothing() -> list[str]:
    """A circuit that is not fitted opens in a hold: nothing happens."""
    stage = GuardedBoard().held()
    stage.bench.wrong.open_interlocks = 0xFFFF & ~_DOOR
    stage.wait(5.0, lambda: "" if stage.state == State.HOLD else "the hold was lost")
    return stage.violations


STORIES: Sequence[Callable[[], list[str]]] = (
    counters_wrap,
    a_gateway_repeats_the_last_write,
    others_disarm_the_watchdog,
    a_stranger_writes_the_command,
    a_board_that_takes_no_settings,
    faults_are_cleared_and_the_pump_stands,
    a_latched_board_keeps_the_pump_off,
    another_program_opens_the_board_of_a_hold,
    another_program_takes_the_board_of_a_dead_hold,
    anybody_may_stop_the_pump,
    over_pressure_while_the_network_is_cut,
    hold_is_asked_of_a_latched_board,
    what_is_read_is_true,
    the_board_alone_keeps_its_limit,
    the_board_alone_stops_without_its_gauge,
    a_board_without_the_value_of_its_gauge_never_pumps,
    a_gauge_that_repeats_its_value_with_gaps,
    a_board_without_a_gauge_pumps,
    the_board_alone_stops_at_an_open_interlock,
    other_inputs_of_the_board_stop_nothing,
)
