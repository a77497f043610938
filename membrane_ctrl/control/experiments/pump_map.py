"""Runs of constant pump commands: the experiment behind the pump's curve. The mirror is the flow meter.

The session (`tuning`) decides which commands, for how long and until which height, between two experiments; here they
are only given, one after the other, inside the excursion guard.
"""

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, Field

from firmware_iface.settings import Fraction, Section
from membrane_ctrl.control.experiments.machine import BenchSample, CentreMotion, Finished

_Short = AfterValidator(lambda value: round(value, 3))  # ninety steps fit one message


class PumpStep(Section):
    """A command until the time is over or, if a height is given, the centre has sunk (command 0) or risen to it."""

    fraction: Annotated[Fraction, _Short]
    duration_s: Annotated[float, Field(ge=0.01, le=120), _Short]
    until_um: Annotated[float, Field(ge=-30, le=30), _Short] | None = None  # from where the experiment began


class PumpSteps:
    """Step machine; its answers are pump commands, 0..1."""

    def __init__(self, centre_um: float, steps: Sequence[PumpStep]) -> None:
        self._centre_um = centre_um
        self._steps = list(steps)
        self._motion = CentreMotion()
        self._in_step_s = 0.0

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick: the command until the next reading, or the end."""
        self._motion.update(measurement.displacement_um, dt_s)
        self._in_step_s += dt_s
        if self._over():
            self._steps.pop(0)
            self._in_step_s = 0.0
        return self._steps[0].fraction if self._steps else Finished(True, "pump mapped")

    def _over(self) -> bool:
        """Whether the present step is."""
        now, off_um = self._steps[0], self._motion.position_um - self._centre_um
        if now.until_um is not None and (off_um <= now.until_um if now.fraction == 0 else off_um >= now.until_um):
            return True
        return self._in_step_s > now.duration_s
