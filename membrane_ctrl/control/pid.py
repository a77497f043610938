"""PI(D) on a filtered measurement, with back-calculation and a clamped integrator; margins of the
loop with it.

    P = K (r - y)          D = -K Td dy/dt          u = P + I + D
    dI/dt = K / Ti (r - y) + (v - u) / Tt,    Tt = Ti,    0 <= I <= v_max

v is u within the pump's range [0, v_max].
Source: Astrom and Hagglund, Advanced PID Control (2006), sections 3.4 and 3.5.

The feed-forward is added afterwards, and the integrator ignores what the limits cut from it. Gusts
are cut on one side only, as the pump removes no gas. In the steady state dI/dt = 0, so
back-calculation would turn a mean cut (v - u) into a mean error -(v - u) / K: measured with gusts,
0.18 µm, and 0.00 without it.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.config.control import LoopConfig
from membrane_ctrl.control.filters import LowPass, smoothing
from membrane_ctrl.model.arrays import ComplexArray, FloatArray
from membrane_ctrl.model.state_tree import StateNode


@dataclass(frozen=True, slots=True)
class PidGains:
    """Gains: K in 1/s (µm/s of flow per µm), times in s."""

    kp_per_s: float
    ti_s: float
    td_s: float


@dataclass(frozen=True, slots=True)
class PidTerms:
    """The three terms of one step, µm/s."""

    p_um_per_s: float
    i_um_per_s: float
    d_um_per_s: float

    @property
    def sum_um_per_s(self) -> float:
        """P + I + D."""
        return self.p_um_per_s + self.i_um_per_s + self.d_um_per_s


@dataclass(slots=True)
class PidState(StateNode):
    """The integrator, and the last error and measurement rate (for bumpless changes)."""

    integral_um_per_s: float = 0.0
    error_um: float = 0.0
    rate_um_per_s: float = 0.0


class Pid:
    """PI(D) with the gains in force.

    The integrator stays between 0, as the pump removes no gas, and `flow_max_um_per_s`.
    """

    def __init__(
        self, gains: PidGains, flow_max_um_per_s: float, memory: PidState | None = None
    ) -> None:
        self.gains = gains
        self.flow_max_um_per_s = flow_max_um_per_s
        self.memory = memory or PidState()

    @property
    def integral_um_per_s(self) -> float:
        """The integrator: the mean flow."""
        return self.memory.integral_um_per_s

    def place(self, integral_um_per_s: float) -> None:
        """Set the integrator, within its range, and forget the last error."""
        self.memory.integral_um_per_s = self._clamped(integral_um_per_s)
        self.memory.error_um = 0.0
        self.memory.rate_um_per_s = 0.0

    def terms(self, error_um: float, measured_rate_um_per_s: float) -> PidTerms:
        """P, I and D for the (filtered) error and the rate of the filtered measurement."""
        self.memory.error_um = error_um
        self.memory.rate_um_per_s = measured_rate_um_per_s
        return self._terms()

    def integrate(self, dt_s: float) -> None:
        """Advance the integrator by the last error, back-calculated where the terms leave the
        pump's range.
        """
        wanted_um_per_s = self._terms().sum_um_per_s
        back_um_per_s = self._clamped(wanted_um_per_s) - wanted_um_per_s
        drive_um_per_s = self.gains.kp_per_s * self.memory.error_um + back_um_per_s
        integral_um_per_s = self.memory.integral_um_per_s + drive_um_per_s * dt_s / self.gains.ti_s
        self.memory.integral_um_per_s = self._clamped(integral_um_per_s)

    def set_gains(self, gains: PidGains) -> None:
        """Change the gains and let the integrator take up the difference, so that the sum does not
        jump.
        """
        before = self._terms()
        self.gains = gains
        self.memory.integral_um_per_s = self._clamped(
            self.memory.integral_um_per_s + before.sum_um_per_s - self._terms().sum_um_per_s
        )

    def _terms(self) -> PidTerms:
        kp, td_s = self.gains.kp_per_s, self.gains.td_s
        memory = self.memory
        return PidTerms(
            kp * memory.error_um, memory.integral_um_per_s, -kp * td_s * memory.rate_um_per_s
        )

    def _clamped(self, flow_um_per_s: float) -> float:
        return min(max(flow_um_per_s, 0.0), self.flow_max_um_per_s)


# Range and rate of the manipulated value.


@dataclass(slots=True)
class FlowState(StateNode):
    """The last flow behind the limits."""

    flow_um_per_s: float = 0.0


class FlowLimiter:
    """Keeps a flow within [0, max] and its change, either way, within a rate."""

    def __init__(
        self, flow_max_um_per_s: float, rate_um_per_s2: float, memory: FlowState | None = None
    ) -> None:
        self.flow_max_um_per_s = flow_max_um_per_s
        self.rate_um_per_s2 = rate_um_per_s2
        self.memory = memory or FlowState()

    @property
    def flow_um_per_s(self) -> float:
        """The last flow."""
        return self.memory.flow_um_per_s

    def place(self, flow_um_per_s: float) -> float:
        """Set the flow within its range, whatever its rate; returns it."""
        self.memory.flow_um_per_s = min(max(flow_um_per_s, 0.0), self.flow_max_um_per_s)
        return self.memory.flow_um_per_s

    def limit(self, wanted_um_per_s: float, dt_s: float) -> float:
        """The flow nearest to the wanted one that range and rate allow."""
        step_um_per_s = self.rate_um_per_s2 * dt_s
        flow_um_per_s = self.memory.flow_um_per_s
        low, high = flow_um_per_s - step_um_per_s, flow_um_per_s + step_um_per_s
        return self.place(min(max(wanted_um_per_s, low), high))


# The setpoint's path to its target: a ramp the pump can follow, and the weight of the second degree
# of freedom.


# The ramp's last part is exponential with this time constant, to avoid a kink that the pump's lag
# (0.15 s) and transport (0.075 s) would turn into overshoot.
APPROACH_S = 1.0

# Share of the pump's free range available to a ramp; the rest is for the feedback.
RAMP_SHARE = 0.8


@dataclass(slots=True)
class SetpointRampState(StateNode):
    """Where the ramp is; NaN before it is placed."""

    value_um: float = math.nan


class SetpointRamp:
    """Setpoint that moves to its target no faster than allowed, and no faster than the pump can
    take the mirror.
    """

    def __init__(
        self,
        rate_um_per_s: float,
        flow_max_um_per_s: float,
        memory: SetpointRampState | None = None,
    ) -> None:
        self.rate_um_per_s = rate_um_per_s
        self.flow_max_um_per_s = flow_max_um_per_s
        self.memory = memory or SetpointRampState()

    @property
    def value_um(self) -> float:
        """The setpoint; NaN before it is placed."""
        return self.memory.value_um

    def place(self, value_um: float) -> None:
        """Set the setpoint; NaN: it is placed later."""
        self.memory.value_um = value_um

    def advance(self, target_um: float, mean_flow_um_per_s: float, dt_s: float) -> float:
        """Setpoint after one step towards `target_um`.

        The pump only adds gas: the mirror falls no faster than it leaks, and the mean flow balances
        the leak. So a fall is limited to a share of the mean flow, a rise to a share of the flow
        above it.
        """
        down = min(self.rate_um_per_s, RAMP_SHARE * mean_flow_um_per_s)
        up = min(self.rate_um_per_s, RAMP_SHARE * (self.flow_max_um_per_s - mean_flow_um_per_s))
        speed = (target_um - self.memory.value_um) / max(APPROACH_S, dt_s)
        self.memory.value_um += min(max(speed, -down), up) * dt_s
        return self.memory.value_um


@dataclass(slots=True)
class SetpointWeightState(StateNode):
    """The lagging part of the setpoint."""

    slow: LowPass = field(default_factory=LowPass)


class SetpointWeight:
    """Proportional setpoint weight b as a filter before the loop, (1 + b Ti s) / (1 + Ti s).

    PI with weight b on the setpoint is the same as PI on the error of the setpoint so filtered (K
    (b r - y) + K / (Ti s) (r - y) = K (1 + 1 / (Ti s)) (F r - y)). In this form the integrator is
    the mean flow at any setpoint, so it can be clamped to what the pump can do. b = 1 follows the
    ramp, 0 leaves the setpoint to the integrator alone.
    """

    def __init__(
        self, weight: float, ti_s: float, memory: SetpointWeightState | None = None
    ) -> None:
        self.weight = weight
        self.ti_s = ti_s
        self.memory = memory or SetpointWeightState()

    def reset(self, setpoint_um: float) -> None:
        """Come to rest at a setpoint."""
        self.memory.slow.reset(setpoint_um)

    def update(self, setpoint_um: float, dt_s: float) -> float:
        """Setpoint as seen by the loop."""
        slow_um = self.memory.slow.update(setpoint_um, dt_s, self.ti_s)
        return slow_um + self.weight * (setpoint_um - slow_um)


# Margins of the linear inner loop: the sampled loop as it runs, its dead times exact, at every
# frequency.


# docs/explanation/physics.md, inner loop; the tick itself takes 5 ms from sample to write
PUMP_LAG_S = 0.15
DEAD_S = 0.075 + 0.005
# Below the corner frequencies of the controller by this factor, L is a double integrator
_FAR_BELOW = 0.01
_POINTS = 2000
_ALIASES = 3  # they fall with the third power of the frequency


def open_loop(loop: LoopConfig, omega: FloatArray) -> ComplexArray:
    """Return L of the sampled loop: PID and filter as difference equations, hold, dead time, pump
    lag, mirror.
    """
    dt_s = 1 / loop.rate_hz
    z = np.exp(1j * omega * dt_s)
    share = smoothing(dt_s, loop.measurement_filter_s)
    measurement_filter = share / (1 - (1 - share) / z)
    derivative = loop.td_s * (1 - 1 / z) / dt_s
    pi = loop.kp_per_s * (
        1 + dt_s / loop.ti_s / (z - 1) + derivative
    )  # the integrator moves after the output
    mirror = np.zeros_like(z)
    for k in range(-_ALIASES, _ALIASES + 1):  # what the samples fold back; at 1 Hz it decides
        s = 1j * (omega + 2 * math.pi * k / dt_s)
        mirror += (1 - 1 / z) / (s * dt_s) * np.exp(-s * DEAD_S) / (1 + s * PUMP_LAG_S) / s
    return np.asarray(pi * measurement_filter * mirror)


def peak_sensitivity(loop: LoopConfig) -> float:
    """Return the largest amplification of a disturbance at any frequency; infinity for an unstable
    loop.

    The defaults stay below 1.4. NaN for a loop with `kp_per_s` 0.
    """
    if loop.kp_per_s == 0.0:
        return math.nan
    low = _FAR_BELOW * min(loop.kp_per_s, 1 / loop.ti_s)
    omega = np.geomspace(low, math.pi * loop.rate_hz * 0.999, _POINTS)
    difference = 1 + open_loop(loop, omega)
    # Nyquist: L has two poles at the origin and none outside, so 1 + L must turn by half a turn
    # from far below to the sampling limit; each further encirclement of -1 is a pair of unstable
    # poles.
    turned = float(np.unwrap(np.angle(difference))[-1] - np.angle(difference)[0])
    if abs(turned - math.pi) > math.pi / 2:
        return math.inf
    return float(np.max(1 / np.abs(difference)))
