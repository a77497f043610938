"""The time that a mirror was held, from the times of ticks."""

import math

import numpy as np

from membrane_ctrl.model.arrays import BoolArray, Column

_LONGEST_S = 2.0  # between two ticks; a longer gap is a loss


class HeldTime:
    """Sum of the tick intervals that start in a hold, over consecutive blocks."""

    def __init__(self) -> None:
        self._last = (math.nan, False)
        self.held_s = 0.0

    def add_times(self, time_s: Column, held: BoolArray) -> None:
        """Add the next ticks; intervals longer than a gap do not count.

        Parameters
        ----------
        time_s : (n,) array
            Times of the ticks.
        held : (n,) bool array
            Whether the mirror was held at each.
        """
        if not time_s.size:
            return
        # Intervals that begin with the last time of the block before; longer ones are gaps
        last_time_s, last_held = self._last
        interval_s = np.diff(np.concatenate(([last_time_s], time_s)))
        held_at_start = np.concatenate(([last_held], held[:-1]))
        counts = held_at_start & (interval_s <= _LONGEST_S)
        self.held_s += float(interval_s[counts].clip(0.0).sum())
        self._last = float(time_s[-1]), bool(held[-1])

    def result_s(self, period_s: float) -> float:
        """Seconds held; the last tick lasts for one more period."""
        return self.held_s + (period_s if self._last[1] else 0.0)
