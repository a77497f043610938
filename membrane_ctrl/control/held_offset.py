"""How far the vertex must stand from the setpoint so that another scalar of the figure is constant.
Pure.

With w_v and w_h the weights of the vertex and of the held scalar
(`metrology.figure.held_quantities`), a figure whose terms changed by dc since the reference needs

    offset = (w_v - w_h) dc

A change of the sag alone changes both scalars by the same: setpoint and offset do not act on each
other, and the noise of the laser is in neither. Laser, estimate and safety rules keep judging the
vertex; the offset moves its setpoint, slowly and within a limit. Without a usable figure it stays.
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from membrane_ctrl.config.schema import ShapeConfig
from membrane_ctrl.control.drift_tracker import DriftTracker
from membrane_ctrl.control.shape_code import ShapeCode
from membrane_ctrl.control.shape_reference import ReferenceMean
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.held_weights import HeldWeights
from membrane_ctrl.model.reason import NO_REASON, Reason, make_reason
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import StateNode

# Memory of the mean square of the residuals, in figures: enough for an error bar good to a tenth
_SCATTER_FIGURES = 50
# Noise of the tracker's value over that of a reading: sqrt(1.25 dt / T) (`drift_tracker`)
_TRACKER_NOISE = 1.25


class HeldState(IntEnum):
    """What the offset does."""

    OFF = 0  # switched off by a person, or the vertex is held
    WAITING = 1  # the reference is not complete
    TRACKING = 2
    KEPT = 3  # without a usable figure: the centre is held at the last offset
    EXPIRED = 4  # the same, for longer than the last offset is worth


@dataclass(frozen=True, slots=True)
class HeldFigure:
    """What decides whether and how a tick moves the offset.

    Attributes
    ----------
    now_s, dt_s : float
    figure : ShapeEstimate or None
        A figure that arrived in this tick and that the figure gate accepted.
    settled : bool
        The mirror rests at its setpoint.
    setpoint_um : float
        Where the setpoint's ramp stands.
    distrust : Reason
        Why the figures must not be used, if so.
    """

    now_s: float
    dt_s: float
    figure: ShapeEstimate | None
    settled: bool
    setpoint_um: float
    distrust: Reason = NO_REASON


@dataclass(slots=True)
class HeldOffsetMemory(StateNode):
    """What the offset remembers from tick to tick."""

    state: HeldState = HeldState.OFF
    reason: Reason = NO_REASON
    offset_um: float = 0.0
    base_um: float = 0.0  # the offset that belongs to the reference
    reference: ReferenceMean = field(default_factory=ReferenceMean)
    drift: DriftTracker = field(default_factory=DriftTracker)
    admitted_s: float = math.nan
    seen_s: float = math.nan  # since then no usable figure has come
    settled_since_s: float = math.inf
    stated_um2: float = math.nan  # variance of the newest reading, as its covariance states it
    scatter_um2: float = math.nan  # mean square of the tracker's residuals
    interval_s: float = math.nan  # mean between admitted figures
    at_limit: bool = False

    @property
    def sigma_um(self) -> float:
        """Standard deviation of `offset_um` by the figures' noise; NaN before the first ones."""
        return self._reading_sigma_um()

    def _reading_sigma_um(self) -> float:
        # Scatter includes what no covariance states: motions of bench and air
        known = [each for each in (self.stated_um2, self.scatter_um2) if math.isfinite(each)]
        return math.sqrt(max(known)) if known else math.nan


@dataclass(frozen=True, slots=True)
class HeldLimits:
    """Limits of the offset: `loop.held_offset_max_um` and `loop.held_keep_s`."""

    offset_max_um: float
    keep_s: float


class HeldOffset:
    """Follows the offset of one held scalar.

    Parameters
    ----------
    shape : ShapeConfig
        Time constant of the tracker, rate of the offset, age up to which a figure is used, largest
        jump.
    limits : HeldLimits
        How far the offset may go, and for how long the last one is worth keeping.
    weights : HeldWeights
        Of the vertex and of the held scalar, (terms,) each, in µm of sag per µm of a term.
    reference_um : (terms,) array, optional
        Terms of a stored figure that the setpoint 0 stands for; else the first figures of the run
        are the reference at the setpoint of that moment.
    memory : HeldOffsetMemory, optional
        What an earlier controller remembered, from its snapshot; else the offset begins at 0.
    """

    def __init__(
        self,
        shape: ShapeConfig,
        limits: HeldLimits,
        weights: HeldWeights,
        reference_um: FloatArray | None = None,
        memory: HeldOffsetMemory | None = None,
    ) -> None:
        self._shape = shape
        self._limits = limits
        self._held = weights.held
        self._weights = weights.vertex - weights.held
        self._reference_um = reference_um
        self._time_constant_s = shape.time_constant_s
        self.memory = memory or HeldOffsetMemory()

    def set_time_constant(self, time_constant_s: float) -> None:
        """Set over how long the tracker averages the figures, s; the offset does not jump."""
        self._time_constant_s = time_constant_s

    @property
    def sigma_um(self) -> float:
        """Standard deviation of the offset, µm; NaN before the first figures."""
        memory = self.memory
        averaged = _TRACKER_NOISE * memory.interval_s / self._time_constant_s
        if math.isnan(averaged):
            return memory.sigma_um
        return memory.sigma_um * math.sqrt(min(1.0, averaged))

    def lock(self, now_s: float) -> None:
        """Take the figures from now on as the reference; keep the offset meanwhile."""
        memory = self.memory
        memory.state = HeldState.WAITING
        memory.reason = make_reason(ShapeCode.WAITING, "waiting for the first figure")
        memory.reference = ReferenceMean()
        memory.admitted_s = math.nan
        memory.seen_s = now_s

    def switch_off(self) -> None:
        """Keep the offset until `lock`."""
        self.memory.state = HeldState.OFF
        self.memory.reason = make_reason(ShapeCode.SWITCHED_OFF, "switched off")

    def step(self, given: HeldFigure) -> float:
        """Run one tick, and return the offset in µm."""
        memory = self.memory
        if not given.settled:
            memory.settled_since_s = math.inf
        elif math.isinf(memory.settled_since_s):
            memory.settled_since_s = given.now_s
        if memory.state == HeldState.OFF:
            return memory.offset_um
        # 1. A figure is refused or admitted; without one, the age of the last is judged
        refusal = self._find_refusal(given)
        if refusal != NO_REASON:
            self._keep_offset(refusal, given.now_s)
        elif given.figure is not None:
            self._admit_figure(given.figure, given)
        # 2. The offset follows the tracker
        if memory.state == HeldState.TRACKING:
            self._move_offset(given)
        return memory.offset_um

    def _find_refusal(self, given: HeldFigure) -> Reason:
        """Why the figures must not be used in this tick; `NO_REASON` if they may be."""
        memory, figure = self.memory, given.figure
        if given.distrust != NO_REASON:
            return given.distrust
        if not given.settled:
            return make_reason(ShapeCode.NOT_SETTLED, "the mirror does not rest at its setpoint")
        # A figure from before the mirror settled does not count; without a new one for long, the
        # loop waits.
        usable = figure is not None and figure.time_s >= memory.settled_since_s
        if not usable:
            waits_since_s = max(memory.seen_s, memory.settled_since_s)
            if given.now_s - waits_since_s > self._shape.fresh_s:
                stale = f"no usable figure for {self._shape.fresh_s:g} s"
                return make_reason(ShapeCode.NO_SHAPE, stale)
            return NO_REASON
        assert figure is not None
        finite = np.isfinite(figure.coeffs_um).all() and np.isfinite(figure.covariance_um2).all()
        if not finite:
            return make_reason(ShapeCode.NOT_FINITE, "the terms of the figure are not finite")
        # A jump beyond the drift so far is none of the mirror.
        if memory.state != HeldState.WAITING:
            jump_um = self._find_offset_change(figure) - memory.drift.drift_at(
                figure.time_s, self._time_constant_s
            )
            if abs(jump_um) > self._shape.disagreement_max_um:
                jumped = f"the figure jumped by {jump_um:+.1f} µm of sag; lock again to accept it"
                return make_reason(ShapeCode.FIGURE_JUMP, jumped)
        return NO_REASON

    def _keep_offset(self, reason: Reason, now_s: float) -> None:
        """Hold the centre at the last offset for a reason."""
        memory = self.memory
        if memory.state != HeldState.WAITING:
            memory.state = HeldState.KEPT
            if now_s - memory.seen_s > self._limits.keep_s:
                memory.state = HeldState.EXPIRED
        memory.reason = reason

    def _admit_figure(self, figure: ShapeEstimate, given: HeldFigure) -> None:
        """Use a figure: for the reference first, then for the tracker."""
        memory, reference = self.memory, self.memory.reference
        if figure.time_s < memory.settled_since_s:
            return
        memory.seen_s = given.now_s
        if memory.state == HeldState.WAITING:
            reference.add_estimate(figure)
            taken = f"reference: figure {reference.count} of {reference.wanted}"
            memory.reason = make_reason(ShapeCode.REFERENCE, taken)
            if reference.complete:
                self._begin_tracking(given.setpoint_um)
            return
        # A figure older than the tracker's last reading adds nothing
        reading_um = self._find_offset_change(figure)
        expected_um = memory.drift.drift_at(figure.time_s, self._time_constant_s)
        interval_s = figure.time_s - memory.drift.time_s
        if interval_s <= 0.0:
            return
        self._note_scatter(reading_um - expected_um, interval_s, figure)
        memory.drift.add_reading(reading_um, figure.time_s, self._time_constant_s)
        memory.admitted_s = figure.time_s
        memory.state = HeldState.TRACKING
        memory.reason = NO_REASON

    def _begin_tracking(self, setpoint_um: float) -> None:
        """The reference is complete: the offset follows its changes from here."""
        memory, reference = self.memory, self.memory.reference
        memory.state = HeldState.TRACKING
        memory.reason = NO_REASON
        memory.admitted_s = reference.time_s
        memory.drift.begin(reference.time_s)
        memory.stated_um2 = memory.scatter_um2 = memory.interval_s = math.nan
        memory.base_um = memory.offset_um
        if self._reference_um is not None:
            # The vertex rests at setpoint + offset; there the held scalar is w_h (c - c_ref)
            held_um = float(self._held @ (reference.coeffs_um - self._reference_um))
            memory.base_um = setpoint_um + memory.offset_um - held_um
        reference.taken.clear()  # their mean is all that is needed

    def _find_offset_change(self, figure: ShapeEstimate) -> float:
        """(w_v - w_h) dc since the reference, µm."""
        return float(self._weights @ (figure.coeffs_um - self.memory.reference.coeffs_um))

    def _note_scatter(self, residual_um: float, interval_s: float, figure: ShapeEstimate) -> None:
        """Learn the noise of the readings, and their interval."""
        memory = self.memory
        memory.stated_um2 = max(0.0, float(self._weights @ figure.covariance_um2 @ self._weights))
        share = 1.0 / _SCATTER_FIGURES
        if math.isnan(memory.scatter_um2):
            memory.scatter_um2 = memory.stated_um2
            memory.interval_s = interval_s
        memory.scatter_um2 += share * (residual_um**2 - memory.scatter_um2)
        memory.interval_s += share * (min(interval_s, self._shape.fresh_s) - memory.interval_s)

    def _move_offset(self, given: HeldFigure) -> None:
        """Move the offset to the tracker's value, bounded in rate and size."""
        # base: the offset at the reference; the tracker: what the figure has changed by since then
        memory, most_um = self.memory, self._limits.offset_max_um
        goal_um = memory.base_um + memory.drift.drift_at(given.now_s, self._time_constant_s)
        bounded_um = min(max(goal_um, -most_um), most_um)
        step_um = self._shape.trim_rate_max_um_per_s * given.dt_s
        memory.offset_um += min(max(bounded_um - memory.offset_um, -step_um), step_um)
        memory.at_limit = bounded_um != goal_um
        memory.reason = NO_REASON
        if memory.at_limit:
            limited = f"offset at its limit of {most_um:g} µm"
            memory.reason = make_reason(ShapeCode.OFFSET_LIMIT, limited)
