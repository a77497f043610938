"""Range and rate of the manipulated value."""

from __future__ import annotations


class FlowLimiter:
    """Keeps a flow within [0, max] and its change within a rate.

    Parameters
    ----------
    flow_max_um_per_s : float
    rate_um_per_s2 : float
        Fastest change, either way.
    """

    def __init__(self, flow_max_um_per_s: float, rate_um_per_s2: float) -> None:
        self.flow_max_um_per_s = flow_max_um_per_s
        self.rate_um_per_s2 = rate_um_per_s2
        self.flow_um_per_s = 0.0

    def place(self, flow_um_per_s: float) -> float:
        """Set the flow within its range, whatever its rate; returns it."""
        self.flow_um_per_s = min(max(flow_um_per_s, 0.0), self.flow_max_um_per_s)
        return self.flow_um_per_s

    def limit(self, wanted_um_per_s: float, dt_s: float) -> float:
        """The flow nearest to the wanted one that range and rate allow."""
        step_um_per_s = self.rate_um_per_s2 * dt_s
        low, high = self.flow_um_per_s - step_um_per_s, self.flow_um_per_s + step_um_per_s
        return self.place(min(max(wanted_um_per_s, low), high))
