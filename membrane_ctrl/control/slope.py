"""Slope of a straight line through samples as they come."""

from __future__ import annotations

import math


class Slope:
    """Least-squares slope of y over t, from running sums; times are counted from the first sample.

    With n evenly spread samples of noise sigma over a span T its standard deviation is sigma sqrt(12 / n) / T:
    0.25 um/s for 1 um, 50 Hz and 1.5 s.
    """

    def __init__(self) -> None:
        self._start_s = math.nan
        self._n = 0
        self._t = self._y = self._tt = self._ty = 0.0

    def add(self, time_s: float, value: float) -> None:
        """Take one sample; one that is not finite is passed over."""
        if not math.isfinite(value):
            return
        if self._n == 0:
            self._start_s = time_s
        t = time_s - self._start_s
        self._n += 1
        self._t += t
        self._y += value
        self._tt += t * t
        self._ty += t * value

    @property
    def per_s(self) -> float:
        """The slope, 0 until there are two different times."""
        spread = self._n * self._tt - self._t * self._t
        return (self._n * self._ty - self._t * self._y) / spread if spread > 0 else 0.0
