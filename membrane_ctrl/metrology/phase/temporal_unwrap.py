"""Temporal unwrapping: each coarser fringe gives the order of the next finer one.

Every pixel is unwrapped by itself. With the position p from the coarser fringes, the finer fringe
of f periods has the position nearest to p among those that its phase allows; the difference e, in
its periods, is below 1/2 and shows how well the two agree.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import BoolArray, FloatArray

# A wrong order begins at half a period; for a pixel half way there, twice its error would be wrong.
CONSISTENT_PERIODS = 0.25


@dataclass(frozen=True)
class Unwrapped:
    """Positions on the screen from all frequencies."""

    screens: (
        FloatArray  # (...): position along the axis, 0 to 1 over the screen, from the finest fringe
    )
    step_periods: (
        FloatArray  # (F - 1, ...): e of each step, in periods of the finer fringe, within +-1/2
    )
    consistent: (
        BoolArray  # (...): all |e| below `CONSISTENT_PERIODS` and the position on the screen
    )


def unwrap_in_time(wrapped_rad: FloatArray, periods: Sequence[float] | FloatArray) -> Unwrapped:
    """Unwrap in time. Raises ValueError if the periods are not rising from at most one, or do not
    match the phases.

    Parameters
    ----------
    wrapped_rad : (F, ...) array
        Phase of each frequency, any branch; zero where position 0 is.
    periods : (F,) array
        Periods a screen, rising; the first at most 1.
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


def predict_phase(
    wrapped_rad: FloatArray, periods: Sequence[float] | FloatArray, index: int
) -> FloatArray:
    """Phase that the other frequencies expect of frequency `index`, (...), not wrapped.

    The chain always needs the coarsest; in the coarsest's own prediction it only chooses the order.
    """
    counts = np.asarray(periods, float)
    keep = np.array([k for k in range(len(counts)) if k != index or k == 0])
    return np.asarray(
        2 * math.pi * counts[index] * unwrap_in_time(wrapped_rad[keep], counts[keep]).screens
    )
