"""The centre's motion for pump commands, through the identified delay and lag."""

import math
from collections import deque

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control import pump_curve
from tuning.identification import plant_model

_SUBSTEPS = 4  # per tick: resolves a dead time to 2.5 ms at 50 Hz


class DrivenCentre:
    """Way of the centre for the commands of a pump, through the identified delay and lag, with unit
    leak left out.
    """

    def __init__(
        self, model: plant_model.PlantModel, pump: PumpConfig, flow_um_per_s: float, dt_s: float
    ) -> None:
        self._model = model
        self._pump = pump
        self._curve = pump_curve.make_branch(pump, pump.curve_um_per_s)
        self._step_s = dt_s / _SUBSTEPS
        self._tube = deque([flow_um_per_s] * (1 + round(model.dead_time_s / self._step_s)))
        self._arriving = flow_um_per_s
        self._running = True
        self.way_um = 0.0

    def step(self, pump_fraction: float) -> float:
        """Run one tick; return the way since the start, without the leak's."""
        pump = self._pump
        self._running = pump_fraction >= (
            pump.stall_fraction if self._running else pump.start_fraction
        )
        flow = self._curve.flow(pump_fraction) if self._running else 0.0
        follow = -math.expm1(-self._step_s / self._model.lag_s)
        for _ in range(_SUBSTEPS):
            self._tube.append(flow)
            self._arriving += (self._tube.popleft() - self._arriving) * follow
            self.way_um += self._model.gain * self._arriving * self._step_s
        return self.way_um
