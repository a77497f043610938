"""The experiment behind the pump's curve: constant pump commands. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from membrane_ctrl.control.experiments import centre_motion, experiment
from membrane_ctrl.control.experiments.spec import PumpStep
from membrane_ctrl.model.state_tree import Count, StateNode


@dataclass(slots=True)
class PumpStepsState(StateNode):
    """Where a pump map is."""

    motion: centre_motion.MotionState = field(default_factory=centre_motion.MotionState)
    in_step_s: float = 0.0
    steps_done: Count = 0


class PumpSteps:
    """The experiment behind the pump's curve: constant pump commands, 0..1; the mirror is the flow
    meter.

    The session (`tuning`) decides which commands, for how long and until which height, between two
    experiments.
    """

    def __init__(
        self,
        centre_um: float,
        steps: Sequence[PumpStep],
        stretch: float = 1.0,
        memory: PumpStepsState | None = None,
    ) -> None:
        self.memory = memory or PumpStepsState()
        self._centre_um = centre_um
        self._steps = steps
        self._motion = centre_motion.CentreMotion(stretch, memory=self.memory.motion)

    def step(self, measurement: experiment.BenchSample, dt_s: float) -> float | experiment.Finished:
        """One tick: the command until the next reading, or the end."""
        self._motion.update(measurement.displacement_um, dt_s)
        memory = self.memory
        memory.in_step_s += dt_s
        if self._is_step_over():
            memory.steps_done += 1
            memory.in_step_s = 0.0
        if memory.steps_done == len(self._steps):
            return experiment.Finished(experiment.ExperimentEnd.COMPLETED, "pump mapped")
        return self._steps[memory.steps_done].fraction

    def _is_step_over(self) -> bool:
        """Whether the present step has reached its position or its duration."""
        now = self._steps[self.memory.steps_done]
        off_um = self._motion.position_um - self._centre_um
        if now.until_um is not None:
            falls = now.fraction == 0
            if falls and off_um <= now.until_um:
                return True
            if not falls and off_um >= now.until_um:
                return True
        return self.memory.in_step_s > now.duration_s
