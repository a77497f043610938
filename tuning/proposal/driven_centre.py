"""The centre's motion for pump commands, through the identified delay and lag."""

import math
from collections import deque

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control import pump_curve
from tuning.identification import plant_model

_SUBSTEPS = 4  # per tick: resolves a dead time to 2.5 ms at 50 Hz


class DrivenCentre:
    """Way of the centre for the commands of a pump, without the leak.

    Parameters
    ----------
    model : PlantModel
        Gain, dead time and lag.
    pump : PumpConfig
        The pump's curve, and where it starts and stalls.
    flow_um_per_s : float
        Flow that is on its way at the start.
    dt_s : float
        A tick.

    Attributes
    ----------
    way_um : float
        The way since the start.
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
        # A pump that runs does so down to its stall; one at rest needs more to start.
        least_fraction = self._pump.start_fraction
        if self._running:
            least_fraction = self._pump.stall_fraction
        self._running = pump_fraction >= least_fraction
        flow = 0.0
        if self._running:
            flow = self._curve.flow(pump_fraction)

        # Through the tube (dead time) and the film's lag, in parts of a tick.
        follow = -math.expm1(-self._step_s / self._model.lag_s)
        for _ in range(_SUBSTEPS):
            self._tube.append(flow)
            self._arriving += (self._tube.popleft() - self._arriving) * follow
            self.way_um += self._model.gain * self._arriving * self._step_s
        return self.way_um
