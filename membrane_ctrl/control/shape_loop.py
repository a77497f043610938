"""The shape loop: moves the setpoint so that the figure stays although the laser's mount drifts. Pure.

The laser reads y = d + b: the mirror's centre d and the drift b of its mount. The camera sees the sag, and the ring
stays where it is, so the change of sag is the change of d. Against a reference taken at lock

    b = (change of the laser) - (change of sag),    both at the time of the exposures.

With the trim at b the inner loop holds y = target + b, that is d = target. b does not depend on the setpoint, so a
user's setpoint change never counts as drift, and the trim closes no feedback loop that could become unstable: there
is only a tracker to tune.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import ShapeConfig
from membrane_ctrl.control.filters import DriftTracker
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.arrays import FloatArray

# The reference of the shape loop: the mean of the first shapes.


# An error of the reference remains as an offset of the figure: the mean has less than half the scatter of one shape,
# at the price of a few cycles without the trim.
SHAPES = 5
# Figures of single frames come faster than the laser's noise averages out: as many readings as five cycles have.
TRACKED_SHAPES, TRACKED_EVERY_S = 25, 0.4


class ReferenceMean:
    """Mean coefficients, laser reading and time of a few shapes."""

    def __init__(self) -> None:
        self._taken: list[shape_estimate.ShapeEstimate] = []
        self.coeffs_um: FloatArray = np.empty(0)
        self.displacement_um = self.time_s = math.nan

    @property
    def wanted(self) -> int:
        """Number of shapes that make a reference."""
        return TRACKED_SHAPES if self._taken and self._taken[-1].kind == "track" else SHAPES

    @property
    def count(self) -> int:
        """Number taken."""
        return len(self._taken)

    @property
    def complete(self) -> bool:
        """Whether there are enough."""
        return self.count >= self.wanted

    def take(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Take one more; of single frames, one per `TRACKED_EVERY_S`."""
        if self._taken and estimate.kind == "track" and estimate.time_s < self._taken[-1].time_s + TRACKED_EVERY_S:
            return
        self._taken.append(estimate)
        self.coeffs_um = np.mean([e.coeffs_um for e in self._taken], axis=0)
        self.displacement_um = float(np.mean([e.displacement_um for e in self._taken]))
        self.time_s = float(np.mean([e.time_s for e in self._taken]))


# Change of sag from the change of a Zernike vector.
#
# A change of sag moves the coefficients along a known direction s (the sensitivity, um per um). With the change
# dc = c - c_ref and its covariance C the best linear unbiased estimate and its variance are (Gauss-Markov)
#
#     d = (s' W dc) / (s' W s),    var d = 1 / (s' W s),    W = (C + f^2 I)^-1
#
# C comes from pixel noise: nanometres, and nearly singular where terms are hard to separate. Alone it would put all
# weight on a few terms whose *model* error (the film's motion between frames, geometry, gamma) is far
# larger. f stands for that: it is the same for every term, and bounds the condition of W.


# Standard deviation of a coefficient's model error (assumed; a bench shows it as the scatter of the estimates):
# 0.05 um RMS over the disc is 0.17 um of sag, which is what a cycle gives.
MODEL_FLOOR_UM = 0.05

MEASURED = slice(1, None)  # all but piston, which is set by the surface being 0 at the vertex


@dataclass(frozen=True, slots=True)
class SagChange:
    """Change of sag in um, positive when the bowl deepens, and its standard deviation."""

    change_um: float
    sigma_um: float


def sag_change(
    coeffs_um: FloatArray, reference_um: FloatArray, covariance_um2: FloatArray, sensitivity: FloatArray
) -> SagChange:
    """Sag now minus sag at the reference, from coefficients (terms,) and their covariance (terms, terms).

    The reference is constant, hence no noise of the change. `sensitivity` (terms,) is the coefficients' change per um
    of sag.
    """
    s = sensitivity[MEASURED]
    covariance = covariance_um2[MEASURED, MEASURED] + MODEL_FLOOR_UM**2 * np.eye(s.size)
    weighted = np.linalg.solve(covariance, s)
    information = float(weighted @ s)
    change_um = float(weighted @ (coeffs_um - reference_um)[MEASURED]) / information
    return SagChange(change_um, information**-0.5)


@dataclass(frozen=True, slots=True)
class ShapeOutput:
    """Output of the shape loop, with its reason."""

    state: telemetry.ShapeState
    reason: str  # why it does not track, or what limits it; may be empty
    trim_um: float  # to be added to the setpoint
    # change of sag since lock as last admitted, and its standard deviation; NaN until there is one
    sag_change_um: float
    sigma_um: float
    age_s: float  # age of the last admitted estimate; NaN until there is one


class ShapeLoop:
    """Trim from shape estimates; off until switched on. `sensitivity` as for `sag_change`."""

    def __init__(self, config: ShapeConfig, sensitivity: FloatArray) -> None:
        self._config = config
        self._sensitivity = sensitivity
        self._state = telemetry.ShapeState.OFF
        self._reason = "switched off"
        self._trim_um = 0.0
        self._base_um = 0.0
        self._reference = ReferenceMean()
        self._drift = DriftTracker(config.time_constant_s)
        self._change = SagChange(math.nan, math.nan)
        self._admitted_s = math.nan
        self._seen_s = math.nan
        self._settled_since_s = math.inf

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self._state != telemetry.ShapeState.OFF

    def set_memory(self, time_constant_s: float) -> None:
        """Set the tracker's memory; the trim does not jump."""
        self._drift.memory_s = time_constant_s

    def switch(self, on: bool, now_s: float) -> None:
        """Switch on, taking a new reference from the present trim, or off, holding the trim."""
        if on and self._state == telemetry.ShapeState.OFF:
            self.lock(now_s)
        elif not on:
            self._state, self._reason = telemetry.ShapeState.OFF, "switched off"

    def lock(self, now_s: float) -> None:
        """Take the figure from now on as the reference; hold the trim meanwhile."""
        self._state, self._reason = telemetry.ShapeState.WAITING, "waiting for the first shape"
        self._reference = ReferenceMean()
        self._change = SagChange(math.nan, math.nan)
        self._admitted_s, self._seen_s = math.nan, now_s

    def step(
        self,
        now_s: float,
        dt_s: float,
        estimate: shape_estimate.ShapeEstimate | None,
        displacement_um: float,
        settled: bool,
        distrust: str = "",
    ) -> ShapeOutput:
        """One tick.

        The estimate is given only when new; `settled`: the inner loop holds its setpoint; `distrust`: why the
        camera must not be believed, if so.
        """
        if not settled:
            self._settled_since_s = math.inf
        elif math.isinf(self._settled_since_s):
            self._settled_since_s = now_s
        if self._state != telemetry.ShapeState.OFF:
            if estimate is not None:
                self._seen_s = estimate.time_s
            refusal = distrust or self._refusal(now_s, estimate, displacement_um, settled)
            if refusal:
                self._refuse(refusal)
            elif estimate is not None:
                self._admit(estimate)
            if self._state == telemetry.ShapeState.TRACKING:
                self._move_trim(now_s, dt_s)
        return self.output(now_s)

    def output(self, now_s: float) -> ShapeOutput:
        """The output of the last tick, with the present age of its estimate."""
        return ShapeOutput(
            self._state,
            self._reason,
            self._trim_um,
            self._change.change_um,
            self._change.sigma_um,
            now_s - self._admitted_s,
        )

    def _refusal(
        self, now_s: float, estimate: shape_estimate.ShapeEstimate | None, displacement_um: float, settled: bool
    ) -> str:
        """Why this tick's estimate must not be used; empty if it may be."""
        config = self._config
        if not settled:
            return "the inner loop is not settled"
        if now_s - self._seen_s > config.fresh_s:
            return f"no shape younger than {config.fresh_s:g} s"
        if estimate is None:
            return ""
        if estimate.verdict == "rejected":
            return f"shape rejected: {estimate.reason}"
        if estimate.time_s < self._settled_since_s:
            return "the shape was taken while the inner loop was not settled"
        if estimate.time_s <= self._admitted_s:
            return "the shape is not newer than the last one"
        if not np.isfinite(estimate.coeffs_um).all() or not np.isfinite(estimate.covariance_um2).all():
            return "the shape is not finite"
        moved_um = abs(displacement_um - estimate.displacement_um)
        if math.isnan(moved_um):
            return "no laser reading to compare the shape with"
        if moved_um > config.disagreement_max_um:
            return f"the laser has moved by {moved_um:.1f} um since the exposures"
        return ""

    def _refuse(self, reason: str) -> None:
        """Hold the trim and say why."""
        if self._state != telemetry.ShapeState.WAITING:
            self._state = telemetry.ShapeState.SUSPENDED
        self._reason = reason

    def _admit(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Use an estimate: for the reference first, then for the drift, unless camera and laser disagree."""
        if self._state == telemetry.ShapeState.WAITING:
            self._admitted_s = estimate.time_s
            self._reference.take(estimate)
            self._reason = f"reference: shape {self._reference.count} of {self._reference.wanted}"
            if self._reference.complete:
                self._state, self._reason = telemetry.ShapeState.TRACKING, ""
                self._base_um = self._trim_um
                self._drift.begin(self._reference.time_s)
            return
        change = sag_change(estimate.coeffs_um, self._reference.coeffs_um, estimate.covariance_um2, self._sensitivity)
        drift_um = estimate.displacement_um - self._reference.displacement_um - change.change_um
        apart_um = drift_um - self._drift.at(estimate.time_s)
        if abs(apart_um) > self._config.disagreement_max_um:
            self._refuse(f"camera and laser disagree by {apart_um:+.1f} um: check the laser's mount, or lock anew")
            return
        self._admitted_s, self._change = estimate.time_s, change
        self._drift.take(drift_um, estimate.time_s)
        self._state, self._reason = telemetry.ShapeState.TRACKING, ""

    def _move_trim(self, now_s: float, dt_s: float) -> None:
        """Move the trim to the drift, bounded in rate and range."""
        config = self._config
        goal_um = self._base_um + self._drift.at(now_s)
        bounded_um = min(max(goal_um, -config.trim_max_um), config.trim_max_um)
        step_um = config.trim_rate_max_um_per_s * dt_s
        self._trim_um += min(max(bounded_um - self._trim_um, -step_um), step_um)
        at_limit = bounded_um != goal_um
        self._reason = f"trim at its limit of {config.trim_max_um:g} um" if at_limit else ""
