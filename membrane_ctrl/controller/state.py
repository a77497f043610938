"""What the controller remembers from tick to tick: one tree of dataclasses, and nothing beside it.

`Controller` works on the tree in place. A snapshot is the tree as JSON (`encode_state`); a
controller that is made with a decoded snapshot continues to the last bit (docs/how-to/replay.md).
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.held_offset import HeldOffsetMemory
from membrane_ctrl.control.inner_loop import InnerLoopState
from membrane_ctrl.control.shape_loop import ShapeLoopMemory
from membrane_ctrl.controller.centre_estimation import CentreEstimationState
from membrane_ctrl.controller.climate_part import ClimatePartState
from membrane_ctrl.controller.gains_trial import GainsInUse, GainsState
from membrane_ctrl.controller.interlocks import InterlocksState
from membrane_ctrl.controller.observer import ObserverState
from membrane_ctrl.controller.process_value import ProcessValueState
from membrane_ctrl.controller.resume_rule import ResumeState
from membrane_ctrl.controller.safe_levels import SafeLevelsState
from membrane_ctrl.controller.safety import SafetyState
from membrane_ctrl.controller.sample_rate import SampleRateState
from membrane_ctrl.controller.sensor_consistency import SensorConsistencyState
from membrane_ctrl.controller.short_losses import ShortLossesState
from membrane_ctrl.controller.standstill import StandstillState
from membrane_ctrl.controller.tick_context import TickContextState
from membrane_ctrl.model.state_tree import Count, StateNode
from membrane_ctrl.model.telemetry import ShapeState, State


@dataclass(frozen=True, slots=True)
class ReportedShape(StateNode):
    """State and reason of the shape loop, as last reported."""

    state: ShapeState
    reason_code: str


@dataclass(slots=True)
class ControllerState(StateNode):
    """All that a tick needs of the ticks before it."""

    gains: GainsState
    context: TickContextState
    consistency: SensorConsistencyState
    ticks: Count = 0
    state: State = State.STANDBY
    state_since_s: float = math.nan
    fault: Count | None = None  # code of the standing fault's rule
    tick_error: str = ""
    reported_why_code: str = ""  # of the operator's line as last reported
    why_code: str = ""  # as it is
    why_since_s: float = 0.0
    reported_shape: ReportedShape | None = None
    setpoint_back_um: float = math.nan  # after a trial that steps the setpoint
    shape_back: bool = False  # the shape loop is on again
    safety: SafetyState = field(default_factory=SafetyState)
    levels: SafeLevelsState = field(default_factory=SafeLevelsState)
    short_losses: ShortLossesState = field(default_factory=ShortLossesState)
    resume: ResumeState = field(default_factory=ResumeState)
    observer: ObserverState = field(default_factory=ObserverState)
    standstill: StandstillState = field(default_factory=StandstillState)
    interlocks: InterlocksState = field(default_factory=InterlocksState)
    sample_rate: SampleRateState = field(default_factory=SampleRateState)
    loop: InnerLoopState = field(default_factory=InnerLoopState)
    shape: ShapeLoopMemory = field(default_factory=ShapeLoopMemory)
    held: HeldOffsetMemory = field(default_factory=HeldOffsetMemory)
    estimation: CentreEstimationState = field(default_factory=CentreEstimationState)
    process_value: ProcessValueState = field(default_factory=ProcessValueState)
    climate: ClimatePartState = field(default_factory=ClimatePartState)


def make_first_state(config: Config) -> ControllerState:
    """The state before a run's first tick."""
    gains = GainsInUse(config.loop, config.shape.time_constant_s, config.pump)
    return ControllerState(
        gains=GainsState(good=gains, tried=gains),
        context=TickContextState(config.loop.setpoint_um),
        consistency=SensorConsistencyState(config.loop.setpoint_um, config.loop.bleed_fraction),
    )
