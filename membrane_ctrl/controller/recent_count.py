"""Counts events of the last ten minutes, to find a sensor that is unsteady."""

from collections import deque
from dataclasses import dataclass, field

from membrane_ctrl.model.state_tree import StateNode

# Within this time a knock or two are possible; a sensor that jumps more often is unsteady.
_UNSTEADY_S = 600.0


@dataclass(slots=True)
class RecentCount(StateNode):
    """Counts events of the last ten minutes."""

    times_s: deque[float] = field(default_factory=deque)

    def add(self, now_s: float, most: int) -> None:
        """Count an event; no more are kept than `too_many` needs.

        Parameters
        ----------
        now_s : float
            Time of the tick.
        most : int
            As in `too_many`.
        """
        self.times_s.append(now_s)
        if len(self.times_s) > most + 1:
            self.times_s.popleft()

    def too_many(self, now_s: float, most: int) -> bool:
        """Return whether there were more events than allowed within ten minutes.

        Parameters
        ----------
        now_s : float
            Time of the tick.
        most : int
            Allowed number.
        """
        return len(self.times_s) > most and now_s - self.times_s[0] <= _UNSTEADY_S
