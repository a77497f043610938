"""Gas in transit between pump and mirror: a dead time, then a lag. Pure."""

from collections import deque
from dataclasses import dataclass, field
from itertools import islice

from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.model.state_tree import StateNode


@dataclass(slots=True)
class TransitState(StateNode):
    """The gas on its way."""

    flows: deque[float] = field(default_factory=deque)  # of the last ticks, newest first
    arriving: float = 0.0


class Transit:
    """Gas between pump and mirror: a dead time, then a lag, in ticks of `period_s`."""

    def __init__(
        self, delay_s: float, lag_s: float, period_s: float, memory: TransitState | None = None
    ) -> None:
        self._ticks = int(delay_s / period_s + 1e-9)
        self._rest = max(0.0, delay_s / period_s - self._ticks)
        self._delay_s = delay_s
        self._lag_s = lag_s
        self._period_s = period_s
        self.memory = memory or TransitState()
        if not self.memory.flows:
            self.memory.flows.extend([0.0] * (self._ticks + 2))

    def place(self, flow_um_per_s: float) -> None:
        """Everything flows at this rate."""
        for place in range(len(self.memory.flows)):
            self.memory.flows[place] = flow_um_per_s
        self.memory.arriving = flow_um_per_s

    def advance(self, flow_um_per_s: float, dt_s: float) -> float:
        """Pump at a rate for a step.

        Parameters
        ----------
        flow_um_per_s : float
            Commanded since the last step.
        dt_s : float
            For how long.

        Returns
        -------
        float
            Rise of the centre in it, µm, by the gas that has arrived.
        """
        memory = self.memory
        # A queue of the commanded flows, one a tick: a late tick fills several places
        for _ in range(max(1, round(dt_s / self._period_s))):
            memory.flows.appendleft(flow_um_per_s)
            memory.flows.pop()
        # The flow of one dead time ago, linear between the two ticks about it; then the pump's lag.
        # Over a step the lag passes on the flow less what it keeps: lag times its own change
        late = (1 - self._rest) * memory.flows[self._ticks] + self._rest * memory.flows[
            self._ticks + 1
        ]
        moved = lag_step_fraction(dt_s, self._lag_s) * (late - memory.arriving)
        memory.arriving += moved
        return late * dt_s - self._lag_s * moved

    def coming_um(self, drift_um_per_s: float) -> float:
        """Rise still to come, if from now on the pump gives the drift."""
        # The flows in the queue, less the drift during the dead time, and what the lag still keeps
        flows = self.memory.flows
        pending = self._period_s * (
            sum(islice(flows, self._ticks)) + self._rest * flows[self._ticks]
        )
        return (
            pending
            - drift_um_per_s * self._delay_s
            + self._lag_s * (self.memory.arriving - drift_um_per_s)
        )

    def due_um_per_s(self) -> float:
        """Flow at the end of the dead time: what the pump now receives comes on top of it."""
        # The lag fed by the queue, oldest flow first
        flow = self.memory.arriving
        for late in range(self._ticks, -1, -1):
            step_s = self._period_s * (self._rest if late == self._ticks else 1.0)
            flow += lag_step_fraction(step_s, self._lag_s) * (self.memory.flows[late] - flow)
        return flow
