"""Places on the screen from the phases of fringes of several periods (docs/how-to/library.md)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_FIVE_SIGMA = 25.0


@dataclass(frozen=True)
class Places:
    """Places on the screen from phases of several periods."""

    place_mm: (
        FloatArray  # (...): NaN where the phases contradict each other, or fit two places alike
    )
    # (...): chi-square of the phases there, a number near F - 1 if `sigma_rad` is right
    misfit: FloatArray


def places_mm(
    wrapped_rad: FloatArray,
    periods_mm: Sequence[float] | FloatArray,
    range_mm: tuple[float, float],
    sigma_rad: float = 0.1,
) -> Places:
    """Places that explain wrapped phases of any two or more periods, which need not be multiples of
    each other.

    Every order of the shortest period within the range is tried; the others choose. The place is
    then the least squares of all. It is NaN unless its chi-square is believable (below F - 1 + 25)
    and 25 better than that of every place more than half a shortest period away: five sigma.

    Parameters
    ----------
    wrapped_rad : (F, ...) array
        Phases, zero (or any multiple of 2 pi) at place 0, growing with the place; any branch.
    periods_mm : (F,) array
        In any order.
    range_mm : (float, float)
        Where on the screen to look.
    sigma_rad : float
        1 sigma of a phase, noise and the display's harmonics together.

    Raises ValueError for fewer than two periods, periods that do not match the phases, or an empty
    range.
    """
    periods = np.asarray(periods_mm, float)
    low, high = range_mm
    if (
        periods.shape != (len(wrapped_rad),)
        or periods.size < 2
        or not (periods > 0).all()
        or not high > low
    ):
        raise ValueError(
            f"{len(wrapped_rad)} phases need as many periods, at least two, all above zero, "
            "and a range"
        )
    turns = np.asarray(wrapped_rad, float) / (2 * math.pi)
    fine, pitch = int(np.argmin(periods)), float(periods.min())
    first = np.mod(turns[fine] - low / pitch, 1.0) * pitch + low
    rates = (1 / periods).reshape(-1, *[1] * first.ndim)
    best, second = np.full((2, *first.shape), np.inf)
    place = np.full(first.shape, np.nan)
    for order in range(math.ceil((high - low) / pitch)):
        tried = first + order * pitch
        left = turns - tried * rates
        left -= np.rint(left)
        tried = tried + np.sum(left * rates, axis=0) / np.sum(rates**2)
        left = turns - tried * rates
        left -= np.rint(left)
        cost = np.where((tried >= low) & (tried <= high), np.sum(left**2, axis=0), np.inf)
        second = np.minimum(second, np.maximum(cost, best))
        place = np.where(cost < best, tried, place)
        best = np.minimum(cost, best)
    scale = (2 * math.pi / sigma_rad) ** 2
    sure = (scale * best < periods.size - 1 + _FIVE_SIGMA) & (scale * (second - best) > _FIVE_SIGMA)
    return Places(np.where(sure, place, np.nan), scale * best)
