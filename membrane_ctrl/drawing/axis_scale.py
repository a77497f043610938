"""Scales of plots: which share of an axis or a colour scale belongs to a value, and its ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from membrane_ctrl.model.arrays import FloatArray

_MARGIN = 0.04  # of an axis beyond its values, on each side
_NICE = (1.0, 2.0, 2.5, 5.0, 10.0)  # steps between ticks, times powers of ten
_MOST_DECADES = 7  # with a tick each
_DECADES_APART = 2  # in decades between ticks of a wider scale
_ROUNDING = 1e-9  # of a step: a tick at the very end of a scale counts as inside
_LARGE = 1e5  # from here on, and
_SMALL = 1e-4  # below here, labels have exponents


class Spacing(Enum):
    """How values are spread over a scale."""

    LINEAR = "linear"
    LOGARITHMIC = "logarithmic"
    SYMMETRIC = "linear near zero, logarithmic beyond"


@dataclass(frozen=True)
class Tick:
    """A labelled place of a scale."""

    value: float
    label: str


@dataclass(frozen=True)
class AxisScale:
    """A scale from one value to another.

    Attributes
    ----------
    low, high : float
        Values at its beginning and end; `low` may be the larger one.
    spacing : Spacing
        How values are spread between them.
    linear_to : float
        Size of the values up to which a symmetric scale is linear.
    """

    low: float
    high: float
    spacing: Spacing = Spacing.LINEAR
    linear_to: float = 1.0

    def shares(self, values: ArrayLike) -> FloatArray:
        """Places of values: 0 at the beginning of the scale, 1 at its end."""
        low, high = self._spread(np.array([self.low, self.high]))
        return np.asarray((self._spread(np.asarray(values, float)) - low) / (high - low))

    def ticks(self, most: int) -> list[Tick]:
        """Ticks of the scale, about `most` at most."""
        match self.spacing:
            case Spacing.LINEAR:
                return _linear_ticks(self.low, self.high, most)
            case Spacing.LOGARITHMIC:
                return _decade_ticks(self.low, self.high)
            case Spacing.SYMMETRIC:
                beyond = [tick.value for tick in _decade_ticks(self.linear_to, self.high)]
                values = [0.0, self.linear_to, *beyond[-2:], self.high]
                both = sorted({side * value for value in values for side in (-1, 1)})
                return [Tick(value, f"{value + 0.0:.2g}") for value in self._thin_out(both)]

    def _spread(self, values: FloatArray) -> FloatArray:
        match self.spacing:
            case Spacing.LINEAR:
                return values
            case Spacing.LOGARITHMIC:
                return np.asarray(np.log10(np.maximum(values, 1e-300)))
            case Spacing.SYMMETRIC:
                size = np.abs(values) / self.linear_to
                beyond = 1 + np.log10(np.maximum(size, 1))
                return np.asarray(np.sign(values) * np.where(size < 1, size, beyond))

    def _thin_out(self, values: list[float]) -> list[float]:
        """Values whose labels do not touch."""
        kept: list[float] = []
        for value in values:
            if not kept or self.shares(value) - self.shares(kept[-1]) > 0.05:
                kept.append(value)
        return kept


def fit_scale(*values: ArrayLike, spacing: Spacing = Spacing.LINEAR) -> AxisScale:
    """Return the scale that shows all finite values with a margin.

    Parameters
    ----------
    *values : arrays
        What is to be shown; of a logarithmic scale only what is positive.
    spacing : Spacing
        Linear or logarithmic.
    """
    every = np.concatenate([np.ravel(np.asarray(value, float)) for value in values])
    is_shown = np.isfinite(every)
    if spacing is Spacing.LOGARITHMIC:
        is_shown &= every > 0
    if not is_shown.any():
        return AxisScale(1.0, 10.0, spacing)
    low = float(every[is_shown].min())
    high = float(every[is_shown].max())
    if spacing is Spacing.LOGARITHMIC:
        margin = (high / low) ** _MARGIN if high > low else 10.0
        return AxisScale(low / margin, high * margin, spacing)
    margin = _MARGIN * (high - low) if high > low else max(abs(high), 1.0) * _MARGIN
    return AxisScale(low - margin, high + margin, spacing)


def _linear_ticks(low: float, high: float, most: int) -> list[Tick]:
    """Multiples of the smallest nice step that gives no more than `most` ticks."""
    first = min(low, high)
    last = max(low, high)
    rough = (last - first) / max(most, 1)
    if not math.isfinite(rough) or rough <= 0:
        return []
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(nice for nice in _NICE if nice * power >= rough * (1 - _ROUNDING))
    begin = math.ceil(first / step - _ROUNDING)
    end = math.floor(last / step + _ROUNDING)
    values = [number * step for number in range(begin, end + 1)]

    # As many decimals as the step has.
    largest = max((abs(value) for value in values), default=0.0)
    if largest >= _LARGE or 0 < largest < _SMALL:
        return [Tick(value, f"{value:.3g}") for value in values]
    decimals = max(0, -math.floor(math.log10(step)))
    if round(step * 10**decimals, 6) % 1:
        decimals += 1  # a step of 2.5
    return [Tick(value, f"{value:.{decimals}f}") for value in values]


def _decade_ticks(low: float, high: float) -> list[Tick]:
    """Powers of ten, every second one of a wide scale; 1, 2 and 5 of them within one decade."""
    first = math.ceil(math.log10(low) - _ROUNDING)
    last = math.floor(math.log10(high) + _ROUNDING)
    decades = range(first, last + 1)
    if len(decades) > _MOST_DECADES:
        decades = range(first + first % _DECADES_APART, last + 1, _DECADES_APART)
    values = [10.0**decade for decade in decades]
    if len(values) < 2:
        between = [
            nice * 10.0**decade for decade in range(first - 1, last + 1) for nice in (1, 2, 5)
        ]
        values = [value for value in between if low <= value <= high]
    return [Tick(value, f"{value:.0e}") for value in values]
