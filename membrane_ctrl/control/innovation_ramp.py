"""Detects innovations that grow to one side: two cumulative sums (Page 1954). Pure."""

import math
from dataclasses import dataclass, field

from membrane_ctrl.model.state_tree import Count, StateNode

# Of a ramp, in standard deviations: the drift that each cumulative sum tolerates, and the most that
# one innovation counts, so that two bad readings are no ramp
_SLACK = 0.5
_STEEPEST = 4.0
_SHORTEST_S = 0.02  # shortest duration of a ramp


@dataclass(slots=True)
class CumulativeSum(StateNode):
    """One side of a `InnovationRamp`."""

    total: float = 0.0
    count: Count = 0
    began_s: float = math.nan


@dataclass(slots=True)
class InnovationRamp(StateNode):
    """Finds innovations that run away to one side: two cumulative sums (Page 1954)."""

    up: CumulativeSum = field(default_factory=CumulativeSum)
    down: CumulativeSum = field(default_factory=CumulativeSum)
    last_s: float = math.nan
    since_s: float = math.nan  # when the last ramp began
    slope: float = math.nan  # of the last ramp: its rise per second

    def update(self, innovation: float, taken_s: float, limit: float) -> bool:
        """Take an innovation into both cumulative sums.

        Parameters
        ----------
        innovation : float
            In standard deviations.
        taken_s : float
            Time of the reading.
        limit : float
            Of a sum, in standard deviations, beyond which it is a ramp.

        Returns
        -------
        bool
            Whether a ramp is found.
        """
        found = False
        innovation = min(max(innovation, -_STEEPEST), _STEEPEST)
        # S <- max(0, S + y - slack) on either side: white innovations return S to 0 again and again
        for side, sign in ((self.up, 1.0), (self.down, -1.0)):
            # The ramp began at the last reading with S = 0
            if side.total == 0.0:
                side.began_s = self.last_s
                side.count = 0
            side.count += 1
            side.total = max(0.0, side.total + sign * innovation - _SLACK)
            if side.total > limit:
                # The mean of a ramp is half of its height: the slope is twice that over its time
                mean = sign * (side.total / side.count + _SLACK)
                self.since_s = side.began_s
                self.slope = 2 * mean / max(taken_s - self.since_s, _SHORTEST_S)
                found = math.isfinite(self.since_s)
                side.total = 0.0
        self.last_s = taken_s
        return found
