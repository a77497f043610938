"""Refuses readings impossibly far from the last good one. Pure."""

import math

# By then the safety table has tripped, and the film may indeed have moved unseen.
_REFUSED_MAX = 10


class JumpGate:
    """Refuses values further from the last good one than a film can move; accepts the new place after ten in a row.

    Parameters
    ----------
    step_max : float
        Largest step between two values, in their unit.
    """

    def __init__(self, step_max: float) -> None:
        self._step_max = step_max
        self._good = math.nan
        self.count = 0  # refused in a row

    def refuse(self, value: float) -> bool:
        """Whether a value is a jump; NaN is not."""
        if not math.isfinite(value):
            return False
        if abs(value - self._good) > self._step_max and self.count < _REFUSED_MAX:
            self.count += 1
            return True
        self.count = 0
        self._good = value
        return False

    def forget(self) -> None:
        """Accept the next value, wherever it is."""
        self._good = math.nan
