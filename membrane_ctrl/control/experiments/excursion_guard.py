"""Ends an experiment before the mirror leaves its limit, and brings it back. Pure."""

import math
from dataclasses import dataclass, field

from membrane_ctrl.control.experiments.centre_motion import CentreMotion, MotionState
from membrane_ctrl.control.experiments.experiment import (
    BenchSample,
    Experiment,
    ExperimentEnd,
    Finished,
)
from membrane_ctrl.control.experiments.operating_point import (
    NOISE_MARGIN_SIGMAS,
    PULL_PER_S,
    OperatingPoint,
)
from membrane_ctrl.model.state_tree import StateNode

_LOST_MAX_S = 0.3  # as long as the safety table tolerates a stale reading
_BACK_SHARE = 0.2  # of the limit, within which the loop takes over
_BACK_MOST_S = 40.0  # with a wrong holding flow the pull ends further off
# limits: this far off something else moves the mirror, and the loop's safety rules are needed
_STRAYED = 2.0


@dataclass(slots=True)
class GuardState(StateNode):
    """The motion that the guard has measured, and how the experiment has ended."""

    motion: MotionState = field(default_factory=MotionState)
    ended: Finished | None = None
    back_s: float = 0.0  # on the way back


class ExcursionGuard:
    """Lets an experiment run while the centre can still be stopped within the limit, then brings it
    back.

    The centre is judged where it will come to rest, position + speed x time to react, with a margin
    of three standard deviations of that figure's own noise, which grows with fewer readings per
    second. Raises ValueError, with a remedy, if the margin uses up the limit.

    It returns on the holding flow with a weak pull: behind a curve other than the configured one,
    an integrator would wind up on the way and carry the mirror further past the centre than the
    experiment may. A mirror that strays nevertheless, behind an open vent or a dead pump, is given
    to the loop at twice the limit. An experiment that sets raw commands (`raw`) ends where it is.
    """

    def __init__(
        self,
        experiment: Experiment,
        around: OperatingPoint,
        centre_um: float,
        rate_hz: float,
        raw: bool = False,
        memory: GuardState | None = None,
    ) -> None:
        self.memory = memory or GuardState()
        self._experiment = experiment
        self._around = around
        self._raw = raw
        self._motion = CentreMotion(around.stretch, around.late_s, self.memory.motion)
        self._centre_um = centre_um
        in_hand_um = (
            NOISE_MARGIN_SIGMAS * self._motion.compute_noise_per_laser(rate_hz) * around.laser_um
        )
        if in_hand_um >= around.limit_um:
            raise ValueError(
                f"limit of {around.limit_um:g} µm: the laser's noise alone takes "
                f"{in_hand_um:.1f} µm of it at "
                f"{rate_hz:g} readings/s; give a larger limit, or a faster or quieter laser"
            )
        self._bound_um = around.limit_um - in_hand_um
        self._limit_um = around.limit_um

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """Run one tick as `Experiment.step` does: the experiment's step, then the way back, then
        the experiment's end.
        """
        self._motion.update(measurement.displacement_um, dt_s)
        if self._motion.lost_s > _LOST_MAX_S:
            lost = (
                f"the reading was lost for {_LOST_MAX_S:g} s: check the laser (without one, the "
                "camera), then repeat"
            )
            return self.memory.ended or Finished(ExperimentEnd.READING_LOST, lost)
        # The experiment itself, until it ends or the guard ends it
        off_um = self._motion.position_um - self._centre_um
        if self.memory.ended is None:
            found = self._guard_step(off_um, measurement, dt_s)
            if self._raw or not isinstance(found, Finished):
                return found
            self.memory.ended = found
        # The way back, until the mirror is near the centre, strays, or takes too long
        self.memory.back_s += dt_s
        is_back = math.isnan(off_um) or abs(off_um) < _BACK_SHARE * self._limit_um
        strays = abs(off_um) > _STRAYED * self._limit_um
        if is_back or strays or self.memory.back_s > _BACK_MOST_S:
            return self.memory.ended
        back_um_per_s = self._around.holding_flow_um_per_s - PULL_PER_S * off_um
        return min(max(back_um_per_s, 0.0), self._around.full_flow_um_per_s)

    def _guard_step(self, off_um: float, measurement: BenchSample, dt_s: float) -> float | Finished:
        # Where it would come to rest if the flow were taken back now
        coming_um = off_um + self._motion.coast_s * self._motion.speed_um_per_s
        if max(abs(off_um), abs(coming_um)) > self._bound_um:
            return Finished(
                ExperimentEnd.STOPPED_BY_GUARD,
                f"stopped at {off_um:+.1f} µm, moving at {self._motion.speed_um_per_s:+.1f} "
                "µm/s: the limit of "
                f"{self._limit_um:g} µm was near; something else moved the mirror, or the "
                "pump is much stronger "
                "than configured",
            )
        return self._experiment.step(measurement, dt_s)
