"""Range and rate of the pump's flow, the manipulated value. Pure."""

from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode


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
        """Return the flow nearest to the wanted one that range and rate allow.

        Parameters
        ----------
        wanted_um_per_s : float
            Any, also negative or beyond the pump.
        dt_s : float
            Time since the last flow, which bounds the change.
        """
        step_um_per_s = self.rate_um_per_s2 * dt_s
        flow_um_per_s = self.memory.flow_um_per_s
        low, high = flow_um_per_s - step_um_per_s, flow_um_per_s + step_um_per_s
        return self.place(min(max(wanted_um_per_s, low), high))
