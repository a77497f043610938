"""Moves the setpoint of the centre so that the scalar that `loop.holds` names stays constant."""

import math

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control.held_offset import (
    HeldFigure,
    HeldLimits,
    HeldOffset,
    HeldOffsetMemory,
    HeldState,
)
from membrane_ctrl.control.shape_code import ShapeCode
from membrane_ctrl.controller.figure_gate import FigureGate, FilmUnseen
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.events import Event, HeldScalarState, Maintenance, MaintenanceOver
from membrane_ctrl.model.held_weights import HeldWeights
from membrane_ctrl.model.reason import NO_REASON, Reason, make_reason
from membrane_ctrl.model.telemetry import SafeLevel, State

NOTICE = "held_offset"
_RAMP_ENDS_UM = 0.1


class HeldScalar:
    """Runs the offset beside the shape loop and the estimate; does nothing while the vertex is
    held.

    Attributes
    ----------
    rim_weights : (terms,) array or None
        For the shape loop; None while the vertex is held.
    """

    def __init__(
        self, config: Config, weights: HeldWeights | None, memory: HeldOffsetMemory
    ) -> None:
        self._holds = config.loop.holds
        self.rim_weights: FloatArray | None = None
        self._offset: HeldOffset | None = None
        if self._holds == "vertex":
            return
        if weights is None:
            raise ValueError(f"the controller needs weights to hold {self._holds}")
        self.rim_weights = weights.vertex
        stored = config.loop.reference_figure_um
        reference_um = None
        if self._holds == "best_fit" and stored:
            reference_um = np.array(stored, dtype=float)
        self._offset = HeldOffset(
            config.shape,
            HeldLimits(config.loop.held_offset_max_um, config.loop.held_keep_s),
            weights,
            reference_um,
            memory,
        )

    def set_time_constant(self, time_constant_s: float) -> None:
        """Set over how long the figures are averaged, s: as in the shape loop, also on trial."""
        if self._offset is not None:
            self._offset.set_time_constant(time_constant_s)

    def step(
        self, context: TickContext, state: State, shape_on: bool, distrust: Reason
    ) -> list[Event]:
        """One tick, after the figure and the sensors were judged; sets the context's offset.

        Parameters
        ----------
        context : TickContext
            Figures, setpoint and safe level of the tick; gets `held_offset_um`.
        state : State
            Of the controller: figures count in `hold`, with the mirror at rest.
        shape_on : bool
            Whether the shape loop is switched on.
        distrust : Reason
            Why the camera must not be followed, if so.
        """
        offset = self._offset
        if offset is None:
            return []
        before = (offset.memory.state, offset.memory.reason.code)
        noticed = self._needs_notice(offset.memory)
        # 1. Switched with the shape loop: `ctl shape off` and `on` accept the present figure
        if not shape_on:
            offset.switch_off()
        elif offset.memory.state == HeldState.OFF:
            offset.lock(context.now_s)
        # 2. The offset
        figures = context.observer.figures
        rests = (
            state == State.HOLD
            and context.levels.safe_level == SafeLevel.NONE
            and not context.paused
            and abs(context.setpoint_um - context.loop.ramp_um) < _RAMP_ENDS_UM
        )
        given = HeldFigure(
            now_s=context.now_s,
            dt_s=context.dt_s,
            figure=figures.accepted,
            settled=rests,
            setpoint_um=context.loop.ramp_um,
            distrust=distrust if distrust != NO_REASON else _distrust_figures(figures),
        )
        context.held_offset_um = offset.step(given)
        # 3. The events of a change
        memory = offset.memory
        events: list[Event] = []
        if (memory.state, memory.reason.code) != before:
            events.append(
                HeldScalarState(
                    self._holds,
                    memory.state.name.lower(),
                    round(memory.offset_um, 3),
                    memory.reason.text,
                    memory.reason.code,
                    _round_known(offset.sigma_um),
                )
            )
        if self._needs_notice(memory) != noticed:
            events.append(self._make_notice(memory))
        return events

    @property
    def row_values(self) -> dict[str, float]:
        """The offset's columns of a telemetry row; none while the vertex is held."""
        offset = self._offset
        if offset is None:
            return {}
        return {
            "held_offset_um": offset.memory.offset_um,
            "held_offset_sigma_um": offset.sigma_um,
        }

    @staticmethod
    def _needs_notice(memory: HeldOffsetMemory) -> bool:
        return memory.state == HeldState.EXPIRED or (
            memory.state == HeldState.TRACKING and memory.at_limit
        )

    def _make_notice(self, memory: HeldOffsetMemory) -> Event:
        """Open the notice, or close it."""
        offset = f"the centre stands {memory.offset_um:+.1f} µm from the setpoint"
        if not self._needs_notice(memory):
            return MaintenanceOver(NOTICE, f"{self._holds} is held again; {offset}")
        if memory.state == HeldState.EXPIRED:
            why = f"{self._holds} is not known any more: {memory.reason.text}"
        else:
            why = f"{self._holds} cannot be held: {memory.reason.text}"
        return Maintenance(NOTICE, f"{why}; {offset}")


def _round_known(value_um: float) -> float | None:
    """A value for an event, which has no NaN."""
    if not math.isfinite(value_um):
        return None
    return round(value_um, 3)


def _distrust_figures(figures: FigureGate) -> Reason:
    """Why the newest figures show no film, if the gate has found that."""
    if figures.unseen_reason is FilmUnseen.REPEATS:
        return make_reason(ShapeCode.CAMERA_REPEATS, FilmUnseen.REPEATS.value)
    return NO_REASON
