"""Flow that cancels the weather before the laser shows its effect. Pure.

Ambient pressure moves the centre by g_p (µm/Pa) at once, gas temperature by g_T (µm/K), and the
gas follows the air with a lag T_g. The speed that cancels them is

    v = -g_p d/dt lag(p, T_f) - g_T d/dt lag(T_air, T_g)

T_f only keeps the barometer's noise from the pump; T_g is physical and needs no further filter.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control.filters import LagRate
from membrane_ctrl.control.weather_limits import discard_impossible_weather
from membrane_ctrl.model.state_tree import StateNode

# Neither weather nor a door (slammed: 100 Pa) changes this much between ticks, but a failed sensor
# does, such as one that reads 85 or -127 C
_STEP_MAX_PA = 500.0
_STEP_MAX_K = 2.0


@dataclass(slots=True)
class FeedForwardState(StateNode):
    """Rates of change of pressure and temperature."""

    pressure: LagRate = field(default_factory=LagRate)
    temperature: LagRate = field(default_factory=LagRate)


class FeedForward:
    """Feed-forward from barometer and air thermometer; either may be switched off, or drop out
    (NaN), at any time.

    A value that jumps further than weather can, or is outside the range of any workplace, is a
    sensor fault and has no effect.
    """

    def __init__(self, loop: LoopConfig, memory: FeedForwardState | None = None) -> None:
        self._loop = loop
        self.memory = memory or FeedForwardState()

    def set_gains(self, loop: LoopConfig) -> None:
        """Set gains, switches and time constants; a channel switched
        off decays like a lost sensor.
        """
        self._loop = loop

    def update(self, ambient_pressure_pa: float, air_temperature_c: float, dt_s: float) -> float:
        """Return the flow that cancels the weather.

        Parameters
        ----------
        ambient_pressure_pa, air_temperature_c : float
            NaN for a missing quantity, whose rate decays.
        dt_s : float
            Time since the last tick.

        Returns
        -------
        float
            In µm/s.
        """
        # The centre follows gain x weather; the opposite flow is gain x its rate. The temperature
        # acts through the gas, which follows the air behind a lag
        loop = self._loop
        pressure_pa, temperature_c = discard_impossible_weather(
            ambient_pressure_pa, air_temperature_c
        )
        pressure_pa = pressure_pa if loop.feedforward_barometer else math.nan
        if not loop.feedforward_temperature:
            temperature_c = math.nan
        pa_per_s = self.memory.pressure.update(
            pressure_pa, dt_s, loop.feedforward_filter_s, _STEP_MAX_PA
        )
        k_per_s = self.memory.temperature.update(
            temperature_c, dt_s, loop.gas_follows_air_s, _STEP_MAX_K
        )
        pressure_um_per_s = loop.barometer_gain_um_per_pa * pa_per_s
        temperature_um_per_s = loop.temperature_gain_um_per_k * k_per_s
        return -(pressure_um_per_s + temperature_um_per_s)
