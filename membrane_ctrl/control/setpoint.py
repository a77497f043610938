"""The setpoint's way to its target: a ramp the pump can follow, and the weight of the second degree of freedom."""

from __future__ import annotations

import math

from membrane_ctrl.control.filters import LowPass

# The ramp's last part is exponential with this time constant: it ends without a kink that the pump's lag
# (0.15 s) and transport (0.075 s) would turn into overshoot.
APPROACH_S = 1.0

# Share of the pump's free range that a ramp may ask for; the rest stays with the feedback.
RAMP_SHARE = 0.8


class SetpointRamp:
    """Setpoint that moves to its target no faster than allowed, and no faster than the pump can take the mirror.

    Parameters
    ----------
    rate_um_per_s : float
        Fastest change.
    flow_max_um_per_s : float
        The pump's full flow.
    """

    def __init__(self, rate_um_per_s: float, flow_max_um_per_s: float) -> None:
        self.rate_um_per_s = rate_um_per_s
        self.flow_max_um_per_s = flow_max_um_per_s
        self.value_um = math.nan

    def advance(self, target_um: float, mean_flow_um_per_s: float, dt_s: float) -> float:
        """Setpoint after one step towards `target_um`.

        The pump only adds gas: the mirror falls no faster than it leaks, and the leak is what the mean flow makes
        up for. So a fall is limited to a share of the mean flow, a rise to a share of what is left above it.
        """
        down = min(self.rate_um_per_s, RAMP_SHARE * mean_flow_um_per_s)
        up = min(self.rate_um_per_s, RAMP_SHARE * (self.flow_max_um_per_s - mean_flow_um_per_s))
        speed = (target_um - self.value_um) / max(APPROACH_S, dt_s)
        self.value_um += min(max(speed, -down), up) * dt_s
        return self.value_um


class SetpointWeight:
    """Proportional setpoint weight b as a filter before the loop, (1 + b Ti s) / (1 + Ti s).

    PI with weight b on the setpoint is the same as PI on the error of the setpoint so filtered
    (K (b r - y) + K / (Ti s) (r - y) = K (1 + 1 / (Ti s)) (F r - y)). In this form the integrator is the mean flow
    at any setpoint, so it can be clamped to what the pump can do.

    Parameters
    ----------
    weight : float
        b: 1 follows the ramp, 0 leaves the setpoint to the integrator alone.
    ti_s : float
        Integral time.
    """

    def __init__(self, weight: float, ti_s: float) -> None:
        self.weight = weight
        self._slow = LowPass(ti_s)

    def reset(self, setpoint_um: float) -> None:
        """Stand still at a setpoint."""
        self._slow.reset(setpoint_um)

    def update(self, setpoint_um: float, dt_s: float) -> float:
        """Setpoint as the loop is to see it."""
        slow_um = self._slow.update(setpoint_um, dt_s)
        return slow_um + self.weight * (setpoint_um - slow_um)
