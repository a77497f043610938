"""Notices that a sensor of the film is lost while the others still hold the mirror. Pure."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.duties import FilmSensor, ProcessValue
from membrane_ctrl.controller.protection import Failure, find_bound
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver
from membrane_ctrl.model.state_tree import StateNode

# A sensor that comes and goes within this, as a laser behind a waving hand does, is not reported.
LOST_S = 2.0
# A notice ends once the sensor has stayed this long.
BACK_S = 10.0
_IS = {FilmSensor.LASER: "is", FilmSensor.OPTICS: "are", FilmSensor.GAUGE: "is"}


@dataclass(slots=True)
class RedundancyState(StateNode):
    """When each sensor showed the film, and whose loss was reported."""

    last_present_s: dict[FilmSensor, float] = field(default_factory=dict)
    present_again_since_s: dict[FilmSensor, float] = field(default_factory=dict)
    reported: list[FilmSensor] = field(default_factory=list)


class RedundancyWatch:
    """Reports each sensor that had shown the film in this hold and does no longer.

    Without it the mirror is bounded by fewer independent sensors (`controller/protection.py`).
    """

    def __init__(self, config: Config, memory: RedundancyState | None = None) -> None:
        self.memory = memory or RedundancyState()
        self._config = config
        self._process_value = ProcessValue.from_config(config)
        optics_lost_s = LOST_S
        if self._process_value is ProcessValue.LASER:
            # A rejected cycle must not raise a notice: as long as the shape loop uses the last one.
            optics_lost_s += config.shape.fresh_s
        self._lost_s = {
            FilmSensor.LASER: LOST_S,
            FilmSensor.OPTICS: optics_lost_s,
            FilmSensor.GAUGE: LOST_S,
        }

    def step(
        self, now_s: float, pump_may_run: bool, present: Mapping[FilmSensor, bool]
    ) -> list[Event]:
        """One tick.

        Parameters
        ----------
        now_s : float
            Time of the tick.
        pump_may_run : bool
            In other states a lost sensor is no loss of protection.
        present : mapping of FilmSensor to bool
            Whether each shows the film in this tick.

        Returns
        -------
        list of Event
            A maintenance notice `laser_lost`, `optics_lost` or `gauge_lost` once for each loss, and
            its end.
        """
        events: list[Event] = []
        if not pump_may_run:
            ended = sort_sensors(self.memory.reported)
            self.memory.start_afresh()
            return [MaintenanceOver(name_notice(sensor), "the hold has ended") for sensor in ended]
        for sensor, is_present in present.items():
            if is_present:
                self.memory.last_present_s[sensor] = now_s
                events += self._report_return(sensor, now_s)
            else:
                self.memory.present_again_since_s.pop(sensor, None)
                events += self._report_loss(sensor, now_s, present)
        return events

    def _report_loss(
        self, sensor: FilmSensor, now_s: float, present: Mapping[FilmSensor, bool]
    ) -> list[Event]:
        # A sensor that was never present (NaN) is not lost
        missing_s = now_s - self.memory.last_present_s.get(sensor, math.nan)
        if sensor in self.memory.reported or not missing_s > self._lost_s[sensor]:
            return []
        self.memory.reported.append(sensor)
        left = [other for other in FilmSensor if present.get(other, False)]
        lost = f"the {sensor.value} {_IS[sensor]} lost"
        message = f"{lost}; {self._describe_bounds(left)}. Find out why before another sensor fails"
        return [Maintenance(name_notice(sensor), message)]

    def _report_return(self, sensor: FilmSensor, now_s: float) -> list[Event]:
        if sensor not in self.memory.reported:
            return []
        since_s = self.memory.present_again_since_s.setdefault(sensor, now_s)
        if now_s - since_s < BACK_S:
            return []
        self.memory.reported.remove(sensor)
        del self.memory.present_again_since_s[sensor]
        return [MaintenanceOver(name_notice(sensor), f"the {sensor.value} {_IS[sensor]} back")]

    def _describe_bounds(self, left: Collection[FilmSensor]) -> str:
        """What still bounds the true displacement, with the distances of the protection table."""
        followed = [sensor for sensor in left if sensor is not FilmSensor.GAUGE]
        if not left:
            return "no sensor shows the film"
        if not followed:
            return "only the gauge is left, and the mean flow is held"
        if FilmSensor.GAUGE not in left:
            names = " and ".join(sensor.value for sensor in followed)
            return f"{names} left, without a gauge"
        if len(followed) > 1:
            return "laser, optics and gauge are left"
        # One sensor and the gauge: how far off it may be before the gauge shows it.
        (sensor,) = followed
        bounds = [
            find_bound(
                self._process_value, sensor, failure, self._config, laser_and_optics=False
            ).distance_um
            for failure in (Failure.STEP, Failure.DRIFT, Failure.DRIFT_WITHIN_CLIMATE)
        ]
        return (
            f"{sensor.value} and gauge are left, and the gauge bounds an error of the "
            f"{sensor.value} to "
            f"{bounds[0]:.0f} µm within minutes, {bounds[1]:.0f} µm within hours, "
            f"{bounds[2]:.0f} µm within days"
        )


def name_notice(sensor: FilmSensor) -> str:
    """Name of the maintenance notice for a lost sensor."""
    return f"{sensor.value}_lost"


def sort_sensors(sensors: Collection[FilmSensor]) -> list[FilmSensor]:
    """The sensors in the order of their class."""
    return [sensor for sensor in FilmSensor if sensor in sensors]
