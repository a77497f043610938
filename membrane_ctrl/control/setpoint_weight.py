"""The weight of the setpoint: the loop's second degree of freedom. Pure."""

from dataclasses import dataclass, field

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.state_tree import StateNode


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
        """Return the setpoint as the loop uses it: the weight's share of a change at once, the rest
        with Ti.

        Parameters
        ----------
        setpoint_um : float
            The ramped setpoint.
        dt_s : float
            Since the last tick.
        """
        slow_um = self.memory.slow.update(setpoint_um, dt_s, self.ti_s)
        return slow_um + self.weight * (setpoint_um - slow_um)
