"""Stories of interlocks: circuits that open, and signals that are lost, in every state in which gas
moves.

Each story returns its violations; it judges the pump's drive and the vent, as the matrix does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from campaign_run import config_of
from campaign_stage import Stage
from campaign_times import OFF_AFTER_S, TICK_S, VENTS_AFTER_S, WATCHDOG_S
from campaign_world import World

from firmware_iface.settings import BoardInputConfig, InterlockDriver, ModbusInputConfig
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.controller.command import Kind
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.virtual_bench import VirtualBench
from membrane_ctrl.sim.virtual_interlocks import VirtualInterlocks

_AGE_MAX_S = 0.5
_SLACK_S = 0.5
_INTERLOCKS: tuple[InterlockDriver, ...] = (
    BoardInputConfig(
        driver="board_input", name="door", text="shut it", safe_level="pump_off", input=3
    ),
    BoardInputConfig(driver="board_input", name="stop", text="pull it", safe_level="vent", input=0),
    ModbusInputConfig(
        driver="modbus_input",
        name="supply",
        text="open it",
        safe_level="ramp_down",
        link="tcp://plc",
        address=7,
    ),
)
_LEVELS = {"door": SafeLevel.PUMP_OFF, "stop": SafeLevel.VENT, "supply": SafeLevel.RAMP_DOWN}
# The commands that lead to a state, after a hold has begun if it is not on the way to one
_WAYS: dict[State, tuple[Kind, ...]] = {
    State.CHECK: (),
    State.INFLATE: (),
    State.SETTLE: (),
    State.HOLD: (),
    State.MANUAL: ("manual",),
}


class InterlockStage(Stage):
    """A mirror whose board and modules have interlocks."""

    def __init__(self, resumes: bool = False) -> None:
        world = World()
        config = config_of(1, world, resumes)
        devices = DevicesConfig(board="tcp://twin", watchdog_s=WATCHDOG_S, interlocks=_INTERLOCKS)
        self.circuits = VirtualInterlocks(_INTERLOCKS)
        super().__init__(world, resumes, config=config.model_copy(update={"devices": devices}))

    def make_bench(self) -> VirtualBench:
        return VirtualBench(self.plant, WATCHDOG_S, interlocks=self.circuits)

    def enter(self, state: State) -> None:
        """Go to a state."""
        self.ask("hold")
        if _WAYS[state]:
            self.until(State.HOLD)
            self.ask(*_WAYS[state], value=self.world.holding_flow_um_per_s)
        self.until(state)

    def must_become_safe(self, level: SafeLevel, within_s: float) -> None:
        """The pump is off, and the vent open, after the level's own times."""
        self.wait(within_s + OFF_AFTER_S[level] + _SLACK_S)
        self.wait(5.0, self.still)
        self.wait(max(0.0, VENTS_AFTER_S[level] - OFF_AFTER_S[level]))
        self.must(self.plant.vent_given == 1.0, "the vent is shut")
        self.must(self.state == State.FAULT, "the fault went away by itself")


def an_open_interlock_in_every_state() -> list[str]:
    """A circuit opens in check, inflate, settle, hold and manual: its own safe level,
    in its time.
    """
    violations: list[str] = []
    for name, level in _LEVELS.items():
        for state in _WAYS:
            stage = InterlockStage()
            stage.enter(state)
            stage.circuits.open_names = {name}
            stage.must_become_safe(level, 2 * TICK_S)
            violations += stage.violations
    return violations


def the_signal_of_an_interlock_is_lost() -> list[str]:
    """The wire of a board's input is cut, the module behind another stops answering: both are open
    circuits.
    """
    violations: list[str] = []
    for name, level in _LEVELS.items():
        stage = InterlockStage()
        stage.held()
        stage.circuits.lost_names = {name}
        stage.must_become_safe(level, _AGE_MAX_S + 2 * TICK_S)
        violations += stage.violations
    return violations


def an_interlock_that_closes_again_resumes_nothing() -> list[str]:
    """A door is opened and shut: no gas before a person acknowledges and asks for a hold."""
    stage = InterlockStage(resumes=True)
    stage.held()
    stage.circuits.open_names = {"door"}
    stage.wait(1.0)
    stage.circuits.open_names = set()
    stage.wait(60.0, stage.still)
    stage.ask("ack")
    stage.until(State.STANDBY, 10.0)
    stage.wait(20.0, stage.still)
    stage.ask("hold")
    stage.until(
        State.INFLATE, 20.0
    )  # for an hour: the levels have timed out, and the mirror was vented
    return stage.violations


def an_open_interlock_forbids_the_hold() -> list[str]:
    """Holds are asked for again and again while a door is open; shutting it begins none."""
    stage = InterlockStage()
    stage.circuits.open_names = {"door"}
    for _ in range(20):
        stage.ask("hold")
        stage.wait(1.0, stage.still)
    stage.circuits.open_names = set()
    stage.wait(20.0, stage.still)
    stage.held()
    return stage.violations


def an_interlock_during_a_fault_that_may_resume() -> list[str]:
    """The emergency stop is pushed for a moment while the network is cut for longer: it is vented,
    for good.
    """
    stage = InterlockStage(resumes=True)
    stage.held()
    stage.bench.wrong.unreachable = True
    stage.wait(3.0)
    stage.circuits.open_names = {"stop"}
    stage.bench.wrong.unreachable = False
    stage.wait(1.0)
    stage.circuits.open_names = set()
    stage.wait(60.0, stage.still)
    stage.must(stage.plant.vent_given == 1.0, "the vent is shut")
    stage.must(stage.state == State.FAULT, "resumed by itself")
    return stage.violations


def an_interlock_opens_on_the_way_down() -> list[str]:
    """A circuit opens while the mirror is vented on command: a fault, and the vent stays open."""
    stage = InterlockStage()
    stage.held()
    stage.ask("vent")
    stage.until(State.LOWER)
    stage.wait(1.0)
    stage.circuits.open_names = {"stop"}
    stage.must_become_safe(SafeLevel.VENT, 2 * TICK_S)
    return stage.violations


def a_door_that_is_open_while_the_program_ends() -> list[str]:
    """A stop in standby with an open door ends the run without a fault, and with the pump off."""
    stage = InterlockStage()
    stage.circuits.open_names = {"door"}
    stage.wait(1.0)
    stage.ask("stop")
    stage.wait(3.0, stage.still)
    stage.must(stage.run.finished is not None, "the run continues")
    stage.must(stage.state != State.FAULT, "a fault")
    return stage.violations


STORIES: Sequence[Callable[[], list[str]]] = (
    an_open_interlock_in_every_state,
    the_signal_of_an_interlock_is_lost,
    an_interlock_that_closes_again_resumes_nothing,
    an_open_interlock_forbids_the_hold,
    an_interlock_during_a_fault_that_may_resume,
    an_interlock_opens_on_the_way_down,
    a_door_that_is_open_while_the_program_ends,
)
