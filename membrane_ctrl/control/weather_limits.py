"""Limits beyond which a reading of the weather is a sensor fault. Pure."""

import math

# Any workplace from 5000 m to a mine; hPa, mmHg and psi are far outside, and so are K for C
_PRESSURE_PA = (50e3, 110e3)
_TEMPERATURE_C = (-20.0, 60.0)


def explain_weather_fault(ambient_pressure_pa: float, air_temperature_c: float) -> str:
    """Name the sensor with an impossible reading, and the remedy.

    Parameters
    ----------
    ambient_pressure_pa : float
        NaN without a barometer.
    air_temperature_c : float
        NaN without a thermometer.

    Returns
    -------
    str
        Empty if both are possible or absent.
    """
    if not _is_possible(ambient_pressure_pa, _PRESSURE_PA):
        return (
            f"the barometer reads {ambient_pressure_pa:g} Pa: check its unit; the feed-forward "
            "does without it"
        )
    if not _is_possible(air_temperature_c, _TEMPERATURE_C):
        return (
            f"the air thermometer reads {air_temperature_c:g} C: check its unit; the "
            "feed-forward does without it"
        )
    return ""


def discard_impossible_weather(
    ambient_pressure_pa: float, air_temperature_c: float
) -> tuple[float, float]:
    """Return the readings, an impossible one as NaN.

    Parameters
    ----------
    ambient_pressure_pa, air_temperature_c : float
        NaN if absent.
    """
    if not _is_possible(ambient_pressure_pa, _PRESSURE_PA):
        ambient_pressure_pa = math.nan
    if not _is_possible(air_temperature_c, _TEMPERATURE_C):
        air_temperature_c = math.nan
    return ambient_pressure_pa, air_temperature_c


def _is_possible(value: float, within: tuple[float, float]) -> bool:
    return math.isnan(value) or within[0] <= value <= within[1]
