"""Data that the states' handlers share: filled by commands and the tick, told as the tick's
telemetry row.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from firmware_iface.roles import NO_READING
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control import inner_loop, line_slope, shape_loop
from membrane_ctrl.control.centre_estimate import CentreEstimate
from membrane_ctrl.control.experiments.experiment import Finished
from membrane_ctrl.control.experiments.trial import Trial, TrialState
from membrane_ctrl.controller import (
    commands,
    interlocks,
    pump_obeys,
    safe_levels,
    safety,
    tick,
    tick_codec,
)
from membrane_ctrl.controller.observer import Observer
from membrane_ctrl.model import errors, telemetry
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.reason import NO_REASON, Reason, WhyCode, make_reason
from membrane_ctrl.model.state_tree import StateNode

# the operator's line names the sender of these commands
_MOVES = frozenset({"hold", "stop", "pause", "manual", "tune", "ack", "lower", "vent"})


@dataclass(slots=True)
class SceneState(StateNode):
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
    sinking: line_slope.Slope = field(
        default_factory=line_slope.Slope
    )  # of the mirror with the pump off, in `check`
    test_memory: pump_obeys.ActuatorTestState | None = None  # of the actuator test, in `check`
    ramp_from_fraction: float = 0.0
    # of the last tick
    last_pump_fraction: float = 0.0
    trim_um: float = 0.0
    laser_doubted: bool = False  # optics and gauge contradict it
    output: inner_loop.LoopOutput | None = None
    why: Reason = NO_REASON
    overdue: str = ""
    unfit: str = ""
    finished: errors.Exit | None = None
    trial_ended: Finished | None = None


@dataclass(slots=True, kw_only=True)
class Scene(SceneState):
    """Data that the handlers share: their memory, the loop, the facts of this tick, and the
    decisions.
    """

    config: Config
    loop_config: LoopConfig  # present settings, after `gains`
    pump_config: PumpConfig  # likewise
    loop: inner_loop.InnerLoop
    observer: Observer
    levels: safe_levels.SafeLevels
    standstill: pump_obeys.Standstill
    interlocks: interlocks.Interlocks
    trial: Trial | None = None  # an experiment, until its end is reported
    # this tick
    now_s: float = 0.0
    dt_s: float = 0.02
    state_age_s: float = 0.0  # 0 exactly in the first tick of a state
    estimate: CentreEstimate | None = None  # held instead of the laser's reading, if there is one
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
        """Set why the pump is as it is; details, as who asked, make it another reason."""
        self.why = make_reason(code, text, *details)

    def give(self, output: inner_loop.LoopOutput) -> None:
        """Let the loop's output drive the pump, with the bleed open."""
        self.output, self.pump_fraction = output, output.pump_fraction
        self.vent_fraction = self.loop_config.bleed_fraction

    def keep_flowing(self) -> None:
        """Continue as in the last tick: the new state takes over in the next one."""
        self.pump_fraction = self.last_pump_fraction
        self.vent_fraction = self.loop_config.bleed_fraction

    @property
    def strayed(self) -> bool:
        """Whether the mirror has moved too far from its setpoint while no loop holds it.

        By laser or optics, whichever shows more: one of them may be frozen.
        """
        target_um = self.setpoint_um + self.trim_um
        shown_um = (self.observer.guard_um, self.observer.optics_guard_um)
        # false for a sensor without a reading
        return any(abs(um - target_um) > self.config.states.manual_range_um for um in shown_um)

    def stay_good(self, good: bool) -> float:
        """How long `good` has been true without a break, in seconds."""
        if not good:
            self.good_since_s = math.nan
            return 0.0
        if math.isnan(self.good_since_s):
            self.good_since_s = self.now_s
        return self.now_s - self.good_since_s


def values_of(memory: SceneState) -> dict[str, Any]:
    """The fields of a memory by name, to make a `Scene` of."""
    return {field.name: getattr(memory, field.name) for field in fields(SceneState)}


def obey(scene: Scene, command: commands.Command, state: telemetry.State) -> None:
    """Take an accepted command's request into the scene; the controller does the rest."""
    match command.kind:
        case "hold":
            scene.hold_wanted = True
        case "manual":
            scene.manual_wanted, scene.manual_um_per_s = True, command.value
            scene.manual_since_s = scene.now_s
        case "pause" | "resume":
            scene.paused = command.kind == "pause"
        case "setpoint":
            scene.setpoint_um = command.value
        case "latched":
            scene.latched = command.text
        case "latch":
            scene.hold_wanted = scene.acknowledged = False
        case "ack":
            scene.latched = ""
            scene.acknowledged = state == telemetry.State.FAULT
        case "stop":
            scene.way_down = "stop"
            scene.stop_exit = (
                errors.Exit.DONE if command.who == commands.AT_END else errors.Exit.INTERRUPTED
            )
        case "vent" if state == telemetry.State.FAULT:
            scene.levels.enter(telemetry.SafeLevel.VENT, scene.now_s)
        case "lower" | "vent":
            scene.way_down = scene.way_down or "lower"
            scene.venting |= command.kind == "vent"
    if command.kind in _MOVES:
        scene.asked_by = command.who


def telemetry_row(
    scene: Scene,
    state: telemetry.State,
    fault: int,
    number: int,
    inputs: tick.TickInputs,
    observation: safety.Observation,
    shape: shape_loop.ShapeOutput,
) -> telemetry.TelemetryRow:
    """The row of tick `number`; `fault` is the standing fault's code, 0 for none."""
    reading = inputs.reading or NO_READING
    out = scene.output or inner_loop.NO_OUTPUT
    seen = scene.estimate.telemetry() if scene.estimate else {}
    return telemetry.TelemetryRow(
        mono_s=inputs.now_s,
        tick=number,
        dt_s=scene.dt_s,
        lateness_ms=inputs.lateness_ms,
        missed_ticks=inputs.missed_ticks,
        state=state,
        shape_state=shape.state,
        safe_level=scene.levels.safe_level,
        fault=fault,
        target_um=scene.setpoint_um,
        setpoint_um=out.setpoint_um,
        displacement_um=observation.displacement_um,
        filtered_um=out.filtered_um,
        error_um=out.error_um,
        p_um_per_s=out.p_um_per_s,
        i_um_per_s=out.i_um_per_s,
        d_um_per_s=out.d_um_per_s,
        feedforward_um_per_s=out.feedforward_um_per_s,
        flow_wanted_um_per_s=out.flow_wanted_um_per_s,
        flow_um_per_s=out.flow_um_per_s,
        pump_fraction=scene.pump_fraction,
        vent_fraction=scene.vent_fraction,
        pump_readback_fraction=reading.pump_fraction,
        vent_readback_fraction=reading.vent_fraction,
        gauge_pressure_pa=observation.gauge_pressure_pa,
        gas_temperature_c=reading.gas_temperature_c,
        # of the laser's readings: rows without one must not pass for such
        displacement_quality=math.nan
        if scene.config.by_optics or not inputs.reading
        else reading.displacement_quality,
        sample_counter=reading.sample_counter if inputs.reading else math.nan,
        device_time_s=reading.device_time_s,
        leak_um_per_s=out.leak_um_per_s,
        trim_um=shape.trim_um,
        truth_displacement_um=inputs.truth_displacement_um,
        truth_laser_bias_um=inputs.truth_laser_bias_um,
        interlocks_open=_interlocks_open(scene.interlocks),
        **seen,
        **{name: getattr(reading, name) for name in tick_codec.AS_READ},
    )


def _interlocks_open(found: interlocks.Interlocks) -> float:
    """The mask for the record; NaN without interlocks, and in a tick without a reading."""
    return float(found.open_mask) if found.any_configured and found.seen else math.nan
