"""The setpoint's ramp to its target, at a speed that the pump can follow. Pure."""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode

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
        """Return the setpoint after one step towards the target.

        The pump only adds gas: the mirror falls no faster than it leaks, and the mean flow balances
        the leak. So a fall is limited to a share of the mean flow, a rise to a share of the flow
        above it.

        Parameters
        ----------
        target_um : float
            Where the setpoint is to go.
        mean_flow_um_per_s : float
            The flow that balances the leak.
        dt_s : float
            Time since the last step.
        """
        down = min(self.rate_um_per_s, RAMP_SHARE * mean_flow_um_per_s)
        up = min(self.rate_um_per_s, RAMP_SHARE * (self.flow_max_um_per_s - mean_flow_um_per_s))
        speed = (target_um - self.memory.value_um) / max(APPROACH_S, dt_s)
        self.memory.value_um += min(max(speed, -down), up) * dt_s
        return self.memory.value_um
