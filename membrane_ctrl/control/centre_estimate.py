"""Inputs and outputs of the filter that estimates the mirror's centre."""

import math
from dataclasses import dataclass
from enum import IntEnum

from membrane_ctrl.model.state_tree import StateNode


class Sensor(IntEnum):
    """A sensor of the centre, or a cause of its motion."""

    LASER = 0
    OPTICS = 1
    BAROMETER = 2
    THERMOMETER = 3


@dataclass(frozen=True, slots=True)
class CentreReadings:
    """Readings of one tick; NaN for missing ones."""

    now_s: float
    flow_um_per_s: float  # commanded since the last tick
    laser_um: float
    ambient_pressure_pa: float
    air_temperature_c: float
    sag_um: float = math.nan
    sag_change_sigma_um: float = math.nan
    sag_time_s: float = math.nan
    # a third sensor will show whether a jump of the laser was its mount's or the film's
    judged: bool = True


@dataclass(frozen=True, slots=True)
class SensorView(StateNode):
    """One sensor's part in the estimate."""

    fresh: bool  # the estimate follows it
    innovation: (
        float  # last reading minus expectation, in standard deviations; NaN before the first
    )
    share: float  # of the corrections of the centre, 0..1


@dataclass(frozen=True, slots=True)
class CentreEstimate(StateNode):
    """The centre in µm, as the laser would read it without noise.

    Attributes
    ----------
    µm, sigma_um : float
        Centre plus mount, and the standard deviation of the centre.
    mount_um : float
        Displacement of the laser's mount: the true centre is `um - mount_um`.
    ahead_um : float
        Where the gas in transit takes it, if the pump from now on balances `drift_um_per_s`.
    due_um_per_s : float
        Flow at the end of the dead time, less `drift_um_per_s`.
    leak_um_per_s, drift_um_per_s : float
        Loss of gas, and that less the lift of the warming gas.
    sensors : tuple of SensorView
        By `Sensor`.
    jumped, jumped_sensors : tuple
        Sensors whose readings have jumped in this tick, in words and as such.
    """

    um: float
    sigma_um: float
    mount_um: float
    ahead_um: float
    due_um_per_s: float
    leak_um_per_s: float
    drift_um_per_s: float
    sensors: tuple[SensorView, ...]
    jumped: tuple[str, ...] = ()
    jumped_sensors: tuple[Sensor, ...] = ()

    def telemetry(self) -> dict[str, float]:
        """Its columns of a telemetry row."""
        values = {
            f"{sensor.name.lower()}_innovation": view.innovation
            for sensor, view in zip(Sensor, self.sensors, strict=True)
            if view.fresh
        }
        return {
            "estimate_sigma_um": self.sigma_um,
            "optics_share": self.sensors[Sensor.OPTICS].share,
            **values,
        }
