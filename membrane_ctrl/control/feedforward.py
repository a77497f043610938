"""Flow that answers the weather before the laser sees it.

Ambient pressure moves the centre by g_p (um/Pa) at once, gas temperature by g_T (um/K), and the gas follows the air
with a lag T_g. The speed that cancels them is

    v = -g_p d/dt lag(p, T_f) - g_T d/dt lag(T_air, T_g)

T_f is only there to keep the barometer's noise from the pump; T_g is the physics itself and needs no more filter.
"""

from __future__ import annotations

import math

from membrane_ctrl.config import LoopConfig
from membrane_ctrl.control.filters import LagRate

# From one tick to the next no weather and no door does this (a slammed one: 100 Pa); a sensor that fails does, as one
# that says 85 or -127 C
_STEP_MAX_PA, _STEP_MAX_K = 500.0, 2.0
# Where people work, from 5000 m to a mine; hPa, mmHg and psi are far outside, and so are K for C
_PRESSURE_PA = (50e3, 110e3)
_TEMPERATURE_C = (-20.0, 60.0)


def weather_complaint(ambient_pressure_pa: float, air_temperature_c: float) -> str:
    """Which of the two cannot be what it is said to be; a sensor that is not there (NaN) is none."""
    if not _believed(ambient_pressure_pa, _PRESSURE_PA):
        return f"the barometer reads {ambient_pressure_pa:g} Pa: check its unit; the feed-forward does without it"
    if not _believed(air_temperature_c, _TEMPERATURE_C):
        return f"the air thermometer reads {air_temperature_c:g} C: check its unit; the feed-forward does without it"
    return ""


def _believed(value: float, within: tuple[float, float]) -> bool:
    return math.isnan(value) or within[0] <= value <= within[1]


class FeedForward:
    """Feed-forward from barometer and air thermometer; either may be switched off, or come and go (NaN), at any time.

    A value that jumps further than the weather can, or that no place where people work has, is a sensor's own, and
    moves nothing.

    Parameters
    ----------
    loop : LoopConfig
    """

    def __init__(self, loop: LoopConfig) -> None:
        self._pressure = LagRate(loop.feedforward_filter_s, _STEP_MAX_PA)
        self._temperature = LagRate(loop.gas_follows_air_s, _STEP_MAX_K)
        self.set_gains(loop)

    def set_gains(self, loop: LoopConfig) -> None:
        """Take new gains, switches and time constants; a channel switched off dies away like a lost sensor."""
        self._loop = loop
        self._pressure.time_constant_s = loop.feedforward_filter_s
        self._temperature.time_constant_s = loop.gas_follows_air_s

    def update(self, ambient_pressure_pa: float, air_temperature_c: float, dt_s: float) -> float:
        """Flow in um/s; NaN for a quantity that is not there."""
        loop = self._loop
        use_pressure = loop.feedforward_barometer and _believed(ambient_pressure_pa, _PRESSURE_PA)
        use_temperature = loop.feedforward_temperature and _believed(air_temperature_c, _TEMPERATURE_C)
        pressure_pa = ambient_pressure_pa if use_pressure else math.nan
        temperature_c = air_temperature_c if use_temperature else math.nan
        pressure_um_per_s = loop.barometer_gain_um_per_pa * self._pressure.update(pressure_pa, dt_s)
        temperature_um_per_s = loop.temperature_gain_um_per_k * self._temperature.update(temperature_c, dt_s)
        return -(pressure_um_per_s + temperature_um_per_s)
