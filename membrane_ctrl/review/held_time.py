"""How long the mirror was held, by the times of the ticks: not every one of them need be there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]

# Segments have some rows a second while nothing happens, and now and then one comes late.
_ROWS_APART = 2.0
_LEAST_GAP_S = 2.0


class HeldTime:
    """Sum of the times between ticks whose first is held, over blocks that come in their order.

    Parameters
    ----------
    quiet_hz : float
        Fewest rows a second that are recorded. A gap longer than twice that is a loss: nobody knows what was in it.
    """

    def __init__(self, quiet_hz: float) -> None:
        self._longest_s = max(_LEAST_GAP_S, _ROWS_APART / quiet_hz)
        self._last = (math.nan, False)
        self.held_s = 0.0

    def add(self, time_s: Column, held: NDArray[np.bool_]) -> None:
        """Take in (n,) times and whether the mirror was held."""
        if not time_s.size:
            return
        lasted_s = np.diff(np.concatenate(([self._last[0]], time_s)))
        first = np.concatenate(([self._last[1]], held[:-1]))
        self.held_s += float(lasted_s[first & (lasted_s <= self._longest_s)].clip(0.0).sum())
        self._last = float(time_s[-1]), bool(held[-1])

    def result_s(self, period_s: float) -> float:
        """Seconds held; the last tick lasts for one more period."""
        return self.held_s + (period_s if self._last[1] else 0.0)
