"""Refuses readings impossibly far from the last good one. Pure."""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import Count, StateNode

# By then the safety table has tripped, and the film may indeed have moved unseen.
_REFUSED_MAX = 10


@dataclass(slots=True)
class JumpGate(StateNode):
    """Refuses values further from the last good one than a film can move, but no more than ten in a
    row.
    """

    good: float = math.nan
    count: Count = 0  # refused in a row

    def is_jump(self, value: float, step_max: float) -> bool:
        """Whether a value is a jump; NaN is not.

        Parameters
        ----------
        value : float
            Compared with the last value that was none.
        step_max : float
            Largest step between two values, in their unit.
        """
        if not math.isfinite(value):
            return False
        if abs(value - self.good) > step_max and self.count < _REFUSED_MAX:
            self.count += 1
            return True
        self.count = 0
        self.good = value
        return False

    def reset(self) -> None:
        """Accept the next value, wherever it is."""
        self.good = math.nan
