"""Absolute phase in time: fringes of several frequencies, coarse to fine, each pixel by itself.

The coarsest pattern has at most one period on the screen, so its phase is a position; each finer one is put into
the period that lies nearest to what is known so far. With x the position in screens, p the periods a screen and
w = phi / (2 pi p) the wrapped position,

    x_f = w_f + rint((x_(f-1) - w_f) p_f) / p_f.

The distance before rounding, e = (x_f - x_(f-1)) p_f in periods, is at most 1/2 by construction and should be near
0: it is the coarser phase's error seen through the finer fringe. Near 1/2 the order is a toss-up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# A wrong order begins at half a period; a pixel half way there is within one more error of its size of being wrong.
CONSISTENT_PERIODS = 0.25


@dataclass(frozen=True)
class Unwrapped:
    """Positions on the screen from all frequencies.

    Attributes
    ----------
    screens : (...) array
        Position along the axis, 0 to 1 over the screen, from the finest fringe.
    step_periods : (F - 1, ...) array
        e of each step, in periods of the finer fringe, within +-1/2.
    consistent : (...) bool array
        All |e| below `CONSISTENT_PERIODS` and the position on the screen.
    """

    screens: FloatArray
    step_periods: FloatArray
    consistent: NDArray[np.bool_]


def unwrap(wrapped_rad: FloatArray, periods: Sequence[float] | FloatArray) -> Unwrapped:
    """Unwrap in time.

    Parameters
    ----------
    wrapped_rad : (F, ...) array
        Phase of each frequency, any branch; zero where position 0 is.
    periods : (F,) array
        Periods a screen, rising; the first at most 1.

    Raises
    ------
    ValueError
        If the periods are not rising from at most one, or do not match the phases.
    """
    counts = np.asarray(periods, float)
    if counts.ndim != 1 or len(counts) != len(wrapped_rad):
        raise ValueError(f"{len(wrapped_rad)} phases for periods {counts.tolist()}")
    if not (0 < counts[0] <= 1 and np.all(np.diff(counts) > 0)):
        raise ValueError(f"periods {counts.tolist()} must rise from at most one a screen")
    position = np.mod(wrapped_rad[0], 2 * math.pi) / (2 * math.pi * counts[0])
    steps = np.empty((len(counts) - 1, *position.shape))
    for k in range(1, len(counts)):
        fine = wrapped_rad[k] / (2 * math.pi * counts[k])
        fine = fine + np.rint((position - fine) * counts[k]) / counts[k]
        steps[k - 1] = (fine - position) * counts[k]
        position = fine
    agree = np.all(np.abs(steps) < CONSISTENT_PERIODS, axis=0) & (position >= 0) & (position <= 1)
    return Unwrapped(position, steps, agree)


def predicted_phase(wrapped_rad: FloatArray, periods: Sequence[float] | FloatArray, index: int) -> FloatArray:
    """Phase that the other frequencies expect of frequency `index`, (...), not wrapped.

    The coarsest cannot be done without; its prediction comes from a chain in which it only chose the order.
    """
    counts = np.asarray(periods, float)
    keep = np.array([k for k in range(len(counts)) if k != index or k == 0])
    return np.asarray(2 * math.pi * counts[index] * unwrap(wrapped_rad[keep], counts[keep]).screens)
