"""Notices that a sensor of the film is lost while the others still hold the mirror. Pure."""

import math
from collections.abc import Collection, Mapping
from enum import Enum

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver

# A sensor that comes and goes within this, as a laser behind a waving hand does, is not reported.
LOST_S = 2.0
# A notice ends once the sensor has stayed this long.
BACK_S = 10.0


class FilmSensor(Enum):
    """The sensors that show where the film is; the value is what people call them."""

    LASER = "laser"
    OPTICS = "optics"
    GAUGE = "gauge"


class RedundancyWatch:
    """Reports each sensor that had shown the film in this hold and does no longer.

    Without it the mirror is bounded by fewer independent sensors (`controller/protection.py`).
    """

    def __init__(self, config: Config) -> None:
        limits = config.limits
        self._bound = (
            f"{limits.laser_gauge_apart_max_um:g} um within minutes, {limits.laser_gauge_drift_max_um:g} um within "
            f"an hour, {limits.laser_gauge_day_max_um:g} um within a day"
        )
        # The optics take their time: a cycle that is rejected must not raise a notice.
        by_laser = config.estimator.process_value == "laser"
        self._lost_s = {
            FilmSensor.LASER: LOST_S,
            FilmSensor.OPTICS: LOST_S + (config.shape.fresh_s if by_laser else 0.0),
            FilmSensor.GAUGE: LOST_S,
        }
        self._forget()

    def _forget(self) -> None:
        self._present_s: dict[FilmSensor, float] = {}  # when each was last present
        self._returned_s: dict[FilmSensor, float] = {}  # since when a reported one is back
        self._reported: set[FilmSensor] = set()

    def step(self, now_s: float, moving: bool, present: Mapping[FilmSensor, bool]) -> list[Event]:
        """One tick; `moving`: the pump may be driven, otherwise a loss is no loss of protection.

        Returns
        -------
        list of Event
            `redundancy_lost` once for each loss, and its end.
        """
        if not moving:
            over = [
                MaintenanceOver(name_notice(sensor), "the hold has ended") for sensor in sort_sensors(self._reported)
            ]
            self._forget()
            return [*over]
        events: list[Event] = []
        for sensor, is_present in present.items():
            if is_present:
                self._present_s[sensor] = now_s
                events += self._return(sensor, now_s)
            else:
                self._returned_s.pop(sensor, None)
                events += self._lose(sensor, now_s)
        return events

    def _lose(self, sensor: FilmSensor, now_s: float) -> list[Event]:
        missing_s = now_s - self._present_s.get(sensor, math.nan)
        if sensor in self._reported or not missing_s > self._lost_s[sensor]:
            return []
        self._reported.add(sensor)
        left = [other for other in self._present_s if other not in self._reported]
        message = f"the {sensor.value} is lost; {self._describe(left)}. Find out why before another sensor fails"
        return [Maintenance(name_notice(sensor), message)]

    def _return(self, sensor: FilmSensor, now_s: float) -> list[Event]:
        if sensor not in self._reported:
            return []
        since_s = self._returned_s.setdefault(sensor, now_s)
        if now_s - since_s < BACK_S:
            return []
        self._reported.discard(sensor)
        del self._returned_s[sensor]
        return [MaintenanceOver(name_notice(sensor), f"the {sensor.value} is back")]

    def _describe(self, left: list[FilmSensor]) -> str:
        """What still bounds the true displacement."""
        holders = [sensor.value for sensor in sort_sensors(left) if sensor is not FilmSensor.GAUGE]
        if FilmSensor.GAUGE in left and holders:
            return f"{' and '.join(holders)} and gauge are left, and the gauge bounds an error to {self._bound}"
        return f"only {' and '.join(holders) or 'the gauge'} left, and no other sensor bounds an error"


def name_notice(sensor: FilmSensor) -> str:
    """Name of the maintenance notice for a lost sensor."""
    return f"{sensor.value}_lost"


def sort_sensors(sensors: Collection[FilmSensor]) -> list[FilmSensor]:
    """The sensors in the order of their class."""
    return [sensor for sensor in FilmSensor if sensor in sensors]
