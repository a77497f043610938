"""Data that the states' handlers share: filled by commands and the tick, reported as the tick's
telemetry row.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control import inner_loop, line_slope
from membrane_ctrl.control.centre_estimate import CentreEstimate
from membrane_ctrl.control.experiments.experiment import Finished
from membrane_ctrl.control.experiments.trial import Trial, TrialState
from membrane_ctrl.control.pump_response import PumpResponse
from membrane_ctrl.controller import (
    actuator_test,
    commands,
    interlocks,
    safe_levels,
    standstill,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.observer import Observer
from membrane_ctrl.model import errors, telemetry
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.reason import NO_REASON, Reason, WhyCode, make_reason
from membrane_ctrl.model.state_tree import StateNode

# the operator's line names the sender of these commands
_MOVES = frozenset({"hold", "stop", "pause", "manual", "tune", "ack", "lower", "vent"})


@dataclass(slots=True)
class TickContextState(StateNode):
    """Requests, the states' own memory, and what the next tick needs of the last one."""

    setpoint_um: float
    # requests
    hold_wanted: bool = False
    manual_wanted: bool = False
    manual_um_per_s: float = 0.0
    manual_since_s: float = math.nan  # the last `manual` command
    mean_flow_um_per_s: float = 0.0  # the pump's mean flow when a person took over
    paused: bool = False
    trial_memory: TrialState | None = None  # of an experiment, until its end is reported
    way_down: Literal["stop", "lower"] | None = None
    venting: bool = False  # while lowering, also after a `stop`
    asked_by: str = ""
    stop_exit: errors.Exit = errors.Exit.DONE
    acknowledged: bool = False
    latched: str = ""  # a fault of an earlier run: no hold until a person acknowledges it
    locks: tuple[Lock, ...] = ()  # set by people: no gas until each is removed
    may_resume: bool = False  # the resume rule clears a latched fault now
    resume_possible: bool = False  # the rule may clear it later
    # memory of the states
    good_since_s: float = math.nan
    last_good_s: float = math.nan  # in `check`
    highest_um: float = math.nan  # filtered reading, in `inflate`
    highest_s: float = math.nan  # when the mirror was last rising
    # of the mirror with the pump off, in `check`
    sinking: line_slope.Slope = field(default_factory=line_slope.Slope)
    test_memory: actuator_test.ActuatorTestState | None = None  # of the actuator test, in `check`
    ramp_from_fraction: float = 0.0
    pump_response: PumpResponse | None = None  # identified at this run's last start
    # of the last tick
    last_pump_fraction: float = 0.0
    trim_um: float = 0.0
    held_offset_um: float = 0.0  # by how much the vertex is moved so that another scalar stays
    laser_doubted: bool = False  # optics and gauge contradict it
    output: inner_loop.LoopOutput | None = None
    why: Reason = NO_REASON
    overdue: str = ""
    unfit: str = ""
    finished: errors.Exit | None = None
    trial_ended: Finished | None = None


@dataclass(slots=True, kw_only=True)
class TickContext(TickContextState):
    """Data that the handlers share: their memory, the loop, the facts of this tick, and the
    decisions.
    """

    config: Config
    loop_config: LoopConfig  # present settings, after `gains`
    pump_config: PumpConfig  # of the pump, as the loop uses it
    loop: inner_loop.InnerLoop
    observer: Observer
    levels: safe_levels.SafeLevels
    standstill: standstill.Standstill
    interlocks: interlocks.Interlocks
    trial: Trial | None = None  # an experiment, until its end is reported
    # this tick
    now_s: float = 0.0
    dt_s: float = 0.02
    state_age_s: float = 0.0  # 0 exactly in the first tick of a state
    estimate: CentreEstimate | None = None  # held instead of the laser's reading, if there is one
    found_response: PumpResponse | None = None  # identified in this tick
    found_pump: PumpConfig | None = None  # in this tick: it is stronger than assumed
    found_leak_um_per_s: float = 0.0  # in that tick
    pump_fraction: float = 0.0
    vent_fraction: float = 0.0

    def begin_trial(self, trial: Trial) -> None:
        """Begin an experiment."""
        self.trial = trial
        self.trial_memory = trial.memory

    def end_trial(self) -> None:
        """Forget an experiment whose end was reported."""
        self.trial = None
        self.trial_memory = None
        self.trial_ended = None

    def explain(self, code: WhyCode, text: str, *details: object) -> None:
        """Set why the pump is as it is.

        Parameters
        ----------
        code : WhyCode
            Decides whether the reason is another one; the text may change its numbers.
        text : str
            For people.
        details : object
            What makes it another reason, as who asked.
        """
        self.why = make_reason(code, text, *details)

    def drive_by(self, output: inner_loop.LoopOutput) -> None:
        """Let the loop's output drive the pump, with the bleed open."""
        self.output = output
        self.pump_fraction = output.pump_fraction
        self.vent_fraction = self.loop_config.bleed_fraction

    def keep_flowing(self) -> None:
        """Continue as in the last tick: the new state takes over in the next one."""
        self.pump_fraction = self.last_pump_fraction
        self.vent_fraction = self.loop_config.bleed_fraction

    @property
    def setpoint_shift_um(self) -> float:
        """What the loop adds to the ramped setpoint: the drift of the laser's mount, and the offset
        of the held scalar.
        """
        return self.trim_um + self.held_offset_um

    @property
    def beyond_manual_range(self) -> bool:
        """Whether the mirror has moved too far from its setpoint while no loop holds it.

        By laser or optics, whichever shows more: one of them may be frozen.
        """
        target_um = self.setpoint_um + self.setpoint_shift_um
        shown_um = (self.observer.guard_um, self.observer.optics_guard_um)
        # false for a sensor without a reading
        return any(abs(um - target_um) > self.config.states.manual_range_um for um in shown_um)

    def measure_good_time_s(self, good: bool) -> float:
        """How long `good` has been true without a break, in seconds."""
        if not good:
            self.good_since_s = math.nan
            return 0.0
        if math.isnan(self.good_since_s):
            self.good_since_s = self.now_s
        return self.now_s - self.good_since_s


def collect_state_fields(memory: TickContextState) -> dict[str, Any]:
    """The fields of a memory by name, to make a `TickContext` of."""
    return {field.name: getattr(memory, field.name) for field in fields(TickContextState)}


def apply_command(context: TickContext, command: Command, state: telemetry.State) -> None:
    """Take an accepted command's request into the context; the controller does the rest.

    Parameters
    ----------
    context : TickContext
        Gets the request: wanted state, flow, setpoint, way down, and who asked.
    command : Command
        Accepted: its state and values have been checked.
    state : State
        Of the controller.
    """
    # Wishes, on which the state's handler acts in this tick if the safety table lets it. In a fault
    # a vent is the deepest safe level
    match command.kind:
        case "hold":
            context.hold_wanted = True
        case "manual":
            context.manual_wanted = True
            context.manual_um_per_s = command.value
            context.manual_since_s = context.now_s
        case "pause" | "resume":
            context.paused = command.kind == "pause"
        case "setpoint":
            context.setpoint_um = command.value
        case "latched":
            context.latched = command.text
        case "latch":
            context.hold_wanted = context.acknowledged = False
        case "ack":
            context.latched = ""
            context.acknowledged = state == telemetry.State.FAULT
        case "stop":
            context.way_down = "stop"
            context.stop_exit = (
                errors.Exit.DONE if command.who == commands.AT_END else errors.Exit.INTERRUPTED
            )
        case "vent" if state == telemetry.State.FAULT:
            context.levels.enter(telemetry.SafeLevel.VENT, context.now_s)
        case "lower" | "vent":
            context.way_down = context.way_down or "lower"
            context.venting |= command.kind == "vent"
    if command.kind in _MOVES:
        context.asked_by = command.who
