"""The diaphragm pump: command for a flow, and the flow a command gives.

    q = q_full (d - dead) / (1 - dead)   while it runs; starts at `start`, stalls below `stall`   (docs/physics.md)

There is no flow between rest and the least running flow: a wanted flow in that gap goes to the nearer end, so that
the error of the gap has no fixed sign. (Always running would add gas that nothing removes, always stopping would lose
the least flow: each is a bias.) The rest is left to the integrator, which does not know about the gap, but sees
the resulting error.
"""

import math

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.filters import LagRate

# Margin above the stall command, so that a rounded register or a cold pump does not stall.
STALL_MARGIN = 0.005

# A stopped pump gets the start command for this long: about its lag (0.15 s), in which it adds less than 0.1 um.
KICK_S = 0.1


class PumpCurve:
    """The inverse of the pump, which remembers whether the pump runs."""

    def __init__(self, pump: PumpConfig) -> None:
        self._pump = pump
        self._least_fraction = pump.stall_fraction + STALL_MARGIN
        self._kick_left_s = KICK_S

    @property
    def least_flow_um_per_s(self) -> float:
        """The smallest flow of a running pump."""
        return self.flow(self._least_fraction)

    def stopped(self) -> None:
        """Note that something else stopped the pump: the next flow starts it."""
        self._kick_left_s = KICK_S

    def flow(self, fraction: float) -> float:
        """Flow in um/s that a running pump gives for a command."""
        pump = self._pump
        return max(0.0, pump.flow_full_um_per_s * (fraction - pump.dead_fraction) / (1.0 - pump.dead_fraction))

    def command(self, flow_um_per_s: float, dt_s: float) -> float:
        """Command for a flow; a stopped pump gets a start pulse."""
        if flow_um_per_s < 0.5 * self.least_flow_um_per_s:
            self.stopped()
            return 0.0
        pump = self._pump
        fraction = pump.dead_fraction + (1.0 - pump.dead_fraction) * flow_um_per_s / pump.flow_full_um_per_s
        fraction = min(max(fraction, self._least_fraction), 1.0)
        if self._kick_left_s > 0.0:
            self._kick_left_s -= dt_s
            fraction = max(fraction, pump.start_fraction)
        return fraction


# Flow that answers the weather before the laser sees it.
#
# Ambient pressure moves the centre by g_p (um/Pa) at once, gas temperature by g_T (um/K), and the gas follows the air
# with a lag T_g. The speed that cancels them is
#
#     v = -g_p d/dt lag(p, T_f) - g_T d/dt lag(T_air, T_g)
#
# T_f only keeps the barometer's noise from the pump; T_g is physical and needs no further filter.


# Neither weather nor a door (slammed: 100 Pa) changes this much between ticks, but a failed sensor does, such as one
# that reads 85 or -127 C
_STEP_MAX_PA, _STEP_MAX_K = 500.0, 2.0
# Any workplace from 5000 m to a mine; hPa, mmHg and psi are far outside, and so are K for C
_PRESSURE_PA = (50e3, 110e3)
_TEMPERATURE_C = (-20.0, 60.0)


def weather_fault(ambient_pressure_pa: float, air_temperature_c: float) -> str:
    """Name the sensor with an impossible reading; absent ones (NaN) do not count."""
    if not _believed(ambient_pressure_pa, _PRESSURE_PA):
        return f"the barometer reads {ambient_pressure_pa:g} Pa: check its unit; the feed-forward does without it"
    if not _believed(air_temperature_c, _TEMPERATURE_C):
        return f"the air thermometer reads {air_temperature_c:g} C: check its unit; the feed-forward does without it"
    return ""


def _believed(value: float, within: tuple[float, float]) -> bool:
    return math.isnan(value) or within[0] <= value <= within[1]


class FeedForward:
    """Feed-forward from barometer and air thermometer; either may be switched off, or drop out (NaN), at any time.

    A value that jumps further than weather can, or is outside the range of any workplace, is a sensor fault and has
    no effect.
    """

    def __init__(self, loop: LoopConfig) -> None:
        self._pressure = LagRate(loop.feedforward_filter_s, _STEP_MAX_PA)
        self._temperature = LagRate(loop.gas_follows_air_s, _STEP_MAX_K)
        self.set_gains(loop)

    def set_gains(self, loop: LoopConfig) -> None:
        """Set gains, switches and time constants; a channel switched off decays like a lost sensor."""
        self._loop = loop
        self._pressure.time_constant_s = loop.feedforward_filter_s
        self._temperature.time_constant_s = loop.gas_follows_air_s

    def update(self, ambient_pressure_pa: float, air_temperature_c: float, dt_s: float) -> float:
        """Flow in um/s; NaN for a missing quantity."""
        loop = self._loop
        use_pressure = loop.feedforward_barometer and _believed(ambient_pressure_pa, _PRESSURE_PA)
        use_temperature = loop.feedforward_temperature and _believed(air_temperature_c, _TEMPERATURE_C)
        pressure_pa = ambient_pressure_pa if use_pressure else math.nan
        temperature_c = air_temperature_c if use_temperature else math.nan
        pressure_um_per_s = loop.barometer_gain_um_per_pa * self._pressure.update(pressure_pa, dt_s)
        temperature_um_per_s = loop.temperature_gain_um_per_k * self._temperature.update(temperature_c, dt_s)
        return -(pressure_um_per_s + temperature_um_per_s)
