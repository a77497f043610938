"""An experiment that follows a given pattern of flow about the holding flow. Pure."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from membrane_ctrl.control.experiments.centre_motion import CentreMotion, MotionState
from membrane_ctrl.control.experiments.experiment import BenchSample, ExperimentEnd, Finished
from membrane_ctrl.control.experiments.operating_point import PULL_PER_S, OperatingPoint
from membrane_ctrl.model.state_tree import StateNode


@dataclass(slots=True)
class PatternState(StateNode):
    """Where a pattern is."""

    motion: MotionState = field(default_factory=MotionState)
    time_s: float = 0.0


class Patterned:
    """A flow that follows a pattern (s to µm/s) about the holding flow, with a weak pull back to
    where it began.

    The pull is needed because the holding flow is never known exactly and the mirror integrates the
    difference; it is too slow to disturb the pattern, and harmless to the identification, which
    knows the flow.
    """

    def __init__(
        self,
        around: OperatingPoint,
        pattern: Callable[[float], float],
        duration_s: float,
        centre_um: float,
        memory: PatternState | None = None,
    ) -> None:
        self.memory = memory or PatternState()
        self._around = around
        self._pattern = pattern
        self._duration_s = duration_s
        self._centre_um = centre_um
        self._motion = CentreMotion(around.stretch, around.late_s, self.memory.motion)

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick of the pattern."""
        memory = self.memory
        if memory.time_s >= self._duration_s:
            return Finished(ExperimentEnd.COMPLETED, "done")
        self._motion.update(measurement.displacement_um, dt_s)
        # An experiment may begin in a tick without a reading: nothing to pull back then
        back_um_per_s = 0.0
        if math.isfinite(self._motion.position_um):
            back_um_per_s = PULL_PER_S * (self._centre_um - self._motion.position_um)
        pattern_um_per_s = self._pattern(memory.time_s)
        memory.time_s += dt_s
        return self._around.within(
            self._around.holding_flow_um_per_s + pattern_um_per_s + back_um_per_s
        )
