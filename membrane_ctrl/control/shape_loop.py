"""The shape loop: moves the setpoint so that the figure stays although the laser's mount drifts.
Pure.

The laser reads y = d + b: the mirror's centre d and the drift b of its mount. The camera sees the
sag, and the ring stays where it is, so the change of sag is the change of d. Against a reference
taken at lock

    b = (change of the laser) - (change of sag),    both at the time of the exposures.

With the trim at b the inner loop holds y = target + b, that is d = target. b does not depend on the
setpoint, so a user's setpoint change never counts as drift, and the trim closes no feedback loop
that could become unstable: there is only a tracker to tune.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.config.schema import ShapeConfig
from membrane_ctrl.control.drift_tracker import DriftTracker
from membrane_ctrl.control.sag_change import (
    SagChange,
    compute_sag_change,
    compute_weighted_change,
)
from membrane_ctrl.control.shape_code import ShapeCode
from membrane_ctrl.control.shape_reference import ReferenceMean
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.reason import NO_REASON, Reason, make_reason
from membrane_ctrl.model.state_tree import StateNode

_SWITCHED_OFF = make_reason(ShapeCode.SWITCHED_OFF, "switched off")


@dataclass(frozen=True, slots=True)
class ShapeOutput:
    """Output of the shape loop, with its reason."""

    state: telemetry.ShapeState
    reason: Reason  # why it does not track, or what limits it; may be empty
    trim_um: float  # to be added to the setpoint
    # change of sag since lock as last admitted, and its standard deviation; NaN until there is one
    sag_change_um: float
    sigma_um: float
    age_s: float  # age of the last admitted estimate; NaN until there is one


@dataclass(slots=True)
class ShapeLoopMemory(StateNode):
    """What the loop remembers from tick to tick."""

    state: telemetry.ShapeState = telemetry.ShapeState.OFF
    reason: Reason = _SWITCHED_OFF
    trim_um: float = 0.0
    base_um: float = 0.0  # the trim at lock
    reference: ReferenceMean = field(default_factory=ReferenceMean)
    drift: DriftTracker = field(default_factory=DriftTracker)
    change: SagChange = field(default_factory=SagChange)  # as last admitted
    admitted_s: float = math.nan
    seen_s: float = math.nan
    settled_since_s: float = math.inf


class ShapeLoop:
    """Trim from shape estimates; off until switched on.

    Parameters
    ----------
    config : ShapeConfig
        Time constant, age of a usable figure, limits of the trim and of its rate.
    sensitivity : (terms,) array
        As for `sag_change`.
    memory : ShapeLoopMemory, optional
        From the snapshot of an earlier controller; else the loop is off, with a trim of 0.
    rim_weights : (terms,) array, optional
        Height of the rim above the vertex per term. Where another scalar than the vertex is held,
        the change of sag is that of this height: along `sensitivity` a change of the figure would
        count as one of the sag.
    """

    def __init__(
        self,
        config: ShapeConfig,
        sensitivity: FloatArray,
        memory: ShapeLoopMemory | None = None,
        rim_weights: FloatArray | None = None,
    ) -> None:
        self._config = config
        self._sensitivity = sensitivity
        self._rim_weights = rim_weights
        self._time_constant_s = config.time_constant_s
        self.memory = memory or ShapeLoopMemory()

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self.memory.state != telemetry.ShapeState.OFF

    def set_time_constant(self, time_constant_s: float) -> None:
        """Set over how long the tracker averages the figures, s; the trim does not jump."""
        self._time_constant_s = time_constant_s

    def switch(self, on: bool, now_s: float) -> None:
        """Switch the loop on, with a new reference from the present trim, or off, holding the trim.

        Parameters
        ----------
        on : bool
            Whether it runs.
        now_s : float
            Time of the tick.
        """
        if on and self.memory.state == telemetry.ShapeState.OFF:
            self.lock(now_s)
        elif not on:
            self.memory.state = telemetry.ShapeState.OFF
            self.memory.reason = _SWITCHED_OFF

    def lock(self, now_s: float) -> None:
        """Take the figure from now on as the reference; hold the trim meanwhile."""
        memory = self.memory
        memory.state = telemetry.ShapeState.WAITING
        memory.reason = make_reason(ShapeCode.WAITING, "waiting for the first shape")
        memory.reference = ReferenceMean()
        memory.change = SagChange()
        memory.admitted_s = math.nan
        memory.seen_s = now_s

    def step(
        self,
        now_s: float,
        dt_s: float,
        estimate: shape_estimate.ShapeEstimate | None,
        displacement_um: float,
        settled: bool,
        distrust: Reason = NO_REASON,
    ) -> ShapeOutput:
        """Process one tick, and return the trim.

        Parameters
        ----------
        now_s, dt_s : float
            The run's clock, and the time since the last tick.
        estimate : ShapeEstimate or None
            Only when new.
        displacement_um : float
            The laser's, µm; NaN without a valid reading.
        settled : bool
            The inner loop holds its setpoint.
        distrust : Reason
            Why the camera must not be used, if so.
        """
        # 1. Since when the inner loop has held its setpoint: older figures do not count
        if not settled:
            self.memory.settled_since_s = math.inf
        elif math.isinf(self.memory.settled_since_s):
            self.memory.settled_since_s = now_s
        if self.memory.state == telemetry.ShapeState.OFF:
            return self.output(now_s)
        # 2. A figure is refused or admitted; without one, the age of the last is judged
        if estimate is not None:
            self.memory.seen_s = estimate.time_s
        refusal = distrust
        if refusal == NO_REASON:
            refusal = self._find_refusal(now_s, estimate, displacement_um, settled)
        if refusal != NO_REASON:
            self._refuse_estimate(refusal)
        elif estimate is not None:
            self._admit_estimate(estimate)
        # 3. The trim follows the change of the sag
        if self.memory.state == telemetry.ShapeState.TRACKING:
            self._move_trim(now_s, dt_s)
        return self.output(now_s)

    def output(self, now_s: float) -> ShapeOutput:
        """The output of the last tick, with the present age of its estimate."""
        return ShapeOutput(
            self.memory.state,
            self.memory.reason,
            self.memory.trim_um,
            self.memory.change.change_um,
            self.memory.change.sigma_um,
            now_s - self.memory.admitted_s,
        )

    def _find_refusal(
        self,
        now_s: float,
        estimate: shape_estimate.ShapeEstimate | None,
        displacement_um: float,
        settled: bool,
    ) -> Reason:
        """Why this tick's estimate must not be used; `NO_REASON` if it may be."""
        config = self._config
        # The loop, with or without a figure in this tick
        if not settled:
            return make_reason(ShapeCode.NOT_SETTLED, "the inner loop is not settled")
        if now_s - self.memory.seen_s > config.fresh_s:
            return make_reason(ShapeCode.NO_SHAPE, f"no shape younger than {config.fresh_s:g} s")
        if estimate is None:
            return NO_REASON
        # The figure itself
        if estimate.verdict == "rejected":
            return make_reason(ShapeCode.REJECTED, f"shape rejected: {estimate.reason}")
        if estimate.time_s < self.memory.settled_since_s:
            meanwhile = "the shape was taken while the inner loop was not settled"
            return make_reason(ShapeCode.MOVED_MEANWHILE, meanwhile)
        if estimate.time_s <= self.memory.admitted_s:
            return make_reason(ShapeCode.NOT_NEWER, "the shape is not newer than the last one")
        if (
            not np.isfinite(estimate.coeffs_um).all()
            or not np.isfinite(estimate.covariance_um2).all()
        ):
            return make_reason(ShapeCode.NOT_FINITE, "the shape is not finite")
        # The laser: the mirror has stayed where it was during the exposures
        moved_um = abs(displacement_um - estimate.displacement_um)
        if math.isnan(moved_um):
            return make_reason(ShapeCode.NO_LASER, "no laser reading to compare the shape with")
        if moved_um > config.disagreement_max_um:
            moved = f"the laser has moved by {moved_um:.1f} µm since the exposures"
            return make_reason(ShapeCode.LASER_MOVED, moved)
        return NO_REASON

    def _refuse_estimate(self, reason: Reason) -> None:
        """Hold the trim for a reason."""
        if self.memory.state != telemetry.ShapeState.WAITING:
            self.memory.state = telemetry.ShapeState.SUSPENDED
        self.memory.reason = reason

    def _admit_estimate(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Use an estimate: for the reference first, then for the drift, unless camera and laser
        disagree.
        """
        memory, reference = self.memory, self.memory.reference
        # The reference is a mean of several shapes; tracking begins once it is complete.
        if memory.state == telemetry.ShapeState.WAITING:
            memory.admitted_s = estimate.time_s
            reference.add_estimate(estimate)
            taken = f"reference: shape {reference.count} of {reference.wanted}"
            memory.reason = make_reason(ShapeCode.REFERENCE, taken)
            if reference.complete:
                memory.state = telemetry.ShapeState.TRACKING
                memory.reason = NO_REASON
                memory.base_um = memory.trim_um
                memory.drift.begin(reference.time_s)
                reference.taken.clear()  # their mean is all that is needed
            return
        # What the laser saw beyond the figure's change of sag is a drift of its mount.
        change = self._measure_change(estimate)
        drift_um = estimate.displacement_um - reference.displacement_um - change.change_um
        disagreement_um = drift_um - memory.drift.drift_at(estimate.time_s, self._time_constant_s)
        if abs(disagreement_um) > self._config.disagreement_max_um:
            disagreement = (
                f"camera and laser disagree by {disagreement_um:+.1f} µm: check the laser's "
                "mount, or lock again"
            )
            self._refuse_estimate(make_reason(ShapeCode.DISAGREE, disagreement))
            return
        memory.admitted_s = estimate.time_s
        memory.change = change
        memory.drift.add_reading(drift_um, estimate.time_s, self._time_constant_s)
        memory.state = telemetry.ShapeState.TRACKING
        memory.reason = NO_REASON

    def _measure_change(self, estimate: shape_estimate.ShapeEstimate) -> SagChange:
        """Change of the sag since the reference."""
        reference_um = self.memory.reference.coeffs_um
        if self._rim_weights is not None:
            return compute_weighted_change(
                estimate.coeffs_um, reference_um, estimate.covariance_um2, self._rim_weights
            )
        return compute_sag_change(
            estimate.coeffs_um, reference_um, estimate.covariance_um2, self._sensitivity
        )

    def _move_trim(self, now_s: float, dt_s: float) -> None:
        """Move the trim to the drift, bounded in rate and range."""
        # base: the trim at the reference; the tracker: the drift of the laser's mount since then
        config = self._config
        memory = self.memory
        goal_um = memory.base_um + memory.drift.drift_at(now_s, self._time_constant_s)
        bounded_um = min(max(goal_um, -config.trim_max_um), config.trim_max_um)
        step_um = config.trim_rate_max_um_per_s * dt_s
        memory.trim_um += min(max(bounded_um - memory.trim_um, -step_um), step_um)
        at_limit = bounded_um != goal_um
        limited = f"trim at its limit of {config.trim_max_um:g} µm"
        if at_limit:
            memory.reason = make_reason(ShapeCode.TRIM_LIMIT, limited)
        else:
            memory.reason = NO_REASON
