"""The last minute of a signal, second by second."""

from __future__ import annotations

import math
from collections import deque

MINUTE_S = 60


class Trend:
    """Means over whole seconds of the run's clock, for the last minute."""

    def __init__(self) -> None:
        self._seconds: deque[tuple[int, list[float]]] = deque(maxlen=MINUTE_S)

    def add(self, mono_s: float, value: float) -> None:
        """Take one value; NaN leaves a gap."""
        second = math.floor(mono_s)
        if not self._seconds or self._seconds[-1][0] != second:
            self._seconds.append((second, []))
        if math.isfinite(value):
            self._seconds[-1][1].append(value)

    def means(self) -> tuple[float, ...]:
        """Mean of each of the last 60 s, oldest first; NaN where there is none."""
        if not self._seconds:
            return (math.nan,) * MINUTE_S
        newest = self._seconds[-1][0]
        known = {second: math.fsum(values) / len(values) for second, values in self._seconds if values}
        return tuple(known.get(second, math.nan) for second in range(newest - MINUTE_S + 1, newest + 1))

    def values(self) -> list[float]:
        """Every finite value of the last minute, oldest first."""
        if not self._seconds:
            return []
        oldest = self._seconds[-1][0] - MINUTE_S + 1
        return [value for second, values in self._seconds if second >= oldest for value in values]
