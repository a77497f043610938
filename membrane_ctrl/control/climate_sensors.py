"""Decides which readings of the climate's sensors may be used. Pure.

None of them can end a hold: a reading that is impossible, missing or frozen is not used, and
reported once. The strains then stay, and their errors grow (`climate`).
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated

from pydantic import Field

from membrane_ctrl.model.state_tree import StateNode

_MISSING_S = 300.0  # a slow instrument may miss minutes
_FROZEN_S = 3600.0  # in a steady room the last digit may stay for long, but not all digits


class ClimateSensor(IntEnum):
    """What shows the climate."""

    FILM = 0
    RING = 1
    HUMIDITY = 2


NAMES = {
    ClimateSensor.FILM: "film thermometer",
    ClimateSensor.RING: "ring thermometer",
    ClimateSensor.HUMIDITY: "hygrometer",
}
_POSSIBLE = {
    ClimateSensor.FILM: (-20.0, 60.0),
    ClimateSensor.RING: (-20.0, 60.0),
    # No laboratory is as dry as 1 %: that is a fraction for per cent, or an input without current
    ClimateSensor.HUMIDITY: (1.0, 100.0),
}


@dataclass(slots=True)
class ClimateSensorWatch(StateNode):
    """What is known of one sensor."""

    value: float = math.nan  # the last reading
    repeated_s: float = 0.0  # for how long it has not changed
    unusable_s: float = math.inf  # since the last usable reading
    fault: str = ""  # as reported


@dataclass(slots=True)
class ClimateSensorsState(StateNode):
    """Of all sensors, by `ClimateSensor`."""

    watches: Annotated[
        list[ClimateSensorWatch],
        Field(min_length=len(ClimateSensor), max_length=len(ClimateSensor)),
    ] = field(default_factory=lambda: [ClimateSensorWatch() for _ in ClimateSensor])


class ClimateSensors:
    """Judges the readings, tick by tick."""

    def __init__(self, memory: ClimateSensorsState | None = None) -> None:
        self.memory = memory or ClimateSensorsState()

    @property
    def any_fresh(self) -> bool:
        """Whether a sensor has given a usable reading within minutes."""
        return any(watch.unusable_s <= _MISSING_S for watch in self.memory.watches)

    def judge(self, sensor: ClimateSensor, value: float, dt_s: float) -> tuple[float, str | None]:
        """Judge a reading.

        Parameters
        ----------
        sensor : ClimateSensor
            Each has its own possible range and history.
        value : float
            °C or per cent; NaN without one.
        dt_s : float
            Since the last tick.

        Returns
        -------
        value : float
            NaN if it must not be used.
        news : str or None
            A fault that begins, in words; empty for one that is over; None if nothing changed. A
            sensor that never had a value is none of the bench.
        """
        # 1. Is the reading there, possible, and not the same for an hour?
        watch = self.memory.watches[sensor]
        low, high = _POSSIBLE[sensor]
        is_present = math.isfinite(value)
        is_possible = is_present and low <= value <= high
        if is_present:
            watch.repeated_s = watch.repeated_s + dt_s if value == watch.value else 0.0
            watch.value = value
        usable = is_possible and watch.repeated_s < _FROZEN_S
        watch.unusable_s = 0.0 if usable else watch.unusable_s + dt_s
        # 2. The fault in words: a missing value counts only after a while, and only of a sensor
        #    that has had one
        fault = ""
        if is_present and not is_possible:
            fault = f"the {NAMES[sensor]} reads {value:g}: check its unit"
        elif is_present and not usable:
            fault = f"the {NAMES[sensor]} has read {value:g} for an hour: it is stuck"
        elif not is_present and math.isfinite(watch.value) and watch.unusable_s > _MISSING_S:
            fault = f"the {NAMES[sensor]} gives no value"
        news = None
        # One fault may turn into another: it is the same notice
        if bool(fault) != bool(watch.fault):
            news = fault
            watch.fault = fault
        return (value if usable else math.nan), news
