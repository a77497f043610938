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
    """Positions on the screen from all frequencies.

    Attributes
    ----------
    screens : (...) array
        Position along the axis from the finest fringe, 0 to 1 over the screen.
    step_periods : (F - 1, ...) array
        e of each step, in periods of the finer fringe, within +-1/2.
    consistent : (...) bool array
        All |e| are below `CONSISTENT_PERIODS`, and the position is on the screen.
    """

    screens: FloatArray
    step_periods: FloatArray
    consistent: BoolArray


def unwrap_in_time(wrapped_rad: FloatArray, periods: Sequence[float] | FloatArray) -> Unwrapped:
    """Unwrap each pixel by its phases of rising frequency.

    Parameters
    ----------
    wrapped_rad : (F, ...) array
        Phase of each frequency, any branch; zero where position 0 is.
    periods : (F,) array
        Periods a screen, rising; the first at most 1.

    Returns
    -------
    Unwrapped

    Raises
    ------
    ValueError
        The periods do not rise from at most one, or do not match the phases.
    """
    counts = np.asarray(periods, float)
    if counts.ndim != 1 or len(counts) != len(wrapped_rad):
        raise ValueError(f"{len(wrapped_rad)} phases for periods {counts.tolist()}")
    if not (0 < counts[0] <= 1 and np.all(np.diff(counts) > 0)):
        raise ValueError(f"periods {counts.tolist()} must rise from at most one a screen")

    # The coarsest fringe has at most one period on the screen: its phase is the position.
    position = np.mod(wrapped_rad[0], 2 * math.pi) / (2 * math.pi * counts[0])
    steps = np.empty((len(counts) - 1, *position.shape))
    for k in range(1, len(counts)):
        # Among the positions that the finer phase allows, one period apart, the one nearest to the
        # coarser position.
        first = wrapped_rad[k] / (2 * math.pi * counts[k])
        periods_to_add = np.rint((position - first) * counts[k])
        fine = first + periods_to_add / counts[k]
        steps[k - 1] = (fine - position) * counts[k]
        position = fine

    # A pixel is consistent if all steps agree and its position is on the screen.
    agrees = np.all(np.abs(steps) < CONSISTENT_PERIODS, axis=0)
    is_on_screen = (position >= 0) & (position <= 1)
    return Unwrapped(position, steps, agrees & is_on_screen)


def predict_phase(
    wrapped_rad: FloatArray, periods: Sequence[float] | FloatArray, index: int
) -> FloatArray:
    """Phase of one frequency as the others predict it.

    The chain always needs the coarsest; in the coarsest's own prediction it only chooses the order.

    Parameters
    ----------
    wrapped_rad, periods
        As in `unwrap_in_time`.
    index : int
        The frequency.

    Returns
    -------
    (...) array
        Phase in rad, not wrapped.
    """
    counts = np.asarray(periods, float)
    others = [k for k in range(len(counts)) if k != index or k == 0]
    kept = np.array(others)
    position = unwrap_in_time(wrapped_rad[kept], counts[kept]).screens
    return np.asarray(2 * math.pi * counts[index] * position)
