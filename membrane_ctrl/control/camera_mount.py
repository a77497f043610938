"""Thermal growth of the camera mount, which changes the measured sag. Pure."""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.control import EstimatorConfig
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.state_tree import StateNode


@dataclass(slots=True)
class CameraMountState(StateNode):
    """Temperatures of the mount: the present one, and at the lock."""

    mount_c: LowPass = field(default_factory=LowPass)
    locked_c: float = math.nan


class CameraMountGrowth:
    """Error of the measured sag by a camera mount that has become warmer since the lock.

    No sensor shows it: laser and optics differ by the laser's mount, too, and a gauge's zero drifts
    more. It is computed from the air's temperature, which the mount follows with a lag.
    """

    def __init__(self, config: EstimatorConfig, memory: CameraMountState | None = None) -> None:
        self._um_per_k = config.camera_mount_um_per_k
        self._sigma_um_per_k = config.camera_mount_sigma_um_per_k
        self._follows_air_s = config.camera_mount_follows_air_s
        self.memory = memory or CameraMountState()

    def lock(self) -> None:
        """From now on the present temperature is that of the reference."""
        self.memory.locked_c = self.memory.mount_c.value

    def step(self, air_c: float, dt_s: float) -> None:
        """Follow the air's temperature by one tick.

        Parameters
        ----------
        air_c : float
            NaN without a good reading: the growth stays.
        dt_s : float
            Time since the last tick.
        """
        if math.isfinite(air_c):
            self.memory.mount_c.update(air_c, dt_s, self._follows_air_s)
            if math.isnan(self.memory.locked_c):
                self.lock()

    @property
    def warmed_k(self) -> float:
        """By how much the mount is warmer than at the lock; 0 if unknown."""
        locked_c = self.memory.locked_c
        if math.isnan(locked_c):
            return 0.0
        return self.memory.mount_c.value - locked_c

    @property
    def um(self) -> float:
        """What the sag shows too much."""
        return self._um_per_k * self.warmed_k

    @property
    def sigma_um(self) -> float:
        """Standard deviation of that."""
        return self._sigma_um_per_k * abs(self.warmed_k)
