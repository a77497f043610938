"""Places on the screen from the phases of fringes of several periods (docs/how-to/library.md)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_FIVE_SIGMA = 25.0  # of chi-square


@dataclass(frozen=True)
class Places:
    """Places on the screen from phases of several periods.

    Attributes
    ----------
    place_mm : (...) array
        NaN where the phases contradict each other, or fit two places equally well.
    misfit : (...) array
        Chi-square of the phases there, a number near F - 1 if `sigma_rad` is right.
    """

    place_mm: FloatArray
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

    Returns
    -------
    Places

    Raises
    ------
    ValueError
        Fewer than two periods, periods that do not match the phases, or an empty range.
    """
    periods = np.asarray(periods_mm, float)
    low, high = range_mm
    matches = periods.shape == (len(wrapped_rad),)
    is_valid = matches and periods.size >= 2 and (periods > 0).all()
    if not is_valid or not high > low:
        raise ValueError(
            f"{len(wrapped_rad)} phases need as many periods, at least two, all above zero, "
            "and a range"
        )
    turns = np.asarray(wrapped_rad, float) / (2 * math.pi)

    # The lowest place in the range that the shortest period allows.
    shortest = int(np.argmin(periods))
    pitch_mm = float(periods.min())
    turns_beyond_low = np.mod(turns[shortest] - low / pitch_mm, 1.0)
    first_mm = turns_beyond_low * pitch_mm + low

    # Each order of the shortest period is a hypothesis; the best and the second best chi-square.
    axes_of_pixels = [1] * first_mm.ndim
    turns_per_mm = (1 / periods).reshape(-1, *axes_of_pixels)
    best = np.full(first_mm.shape, np.inf)
    second = np.full(first_mm.shape, np.inf)
    place_mm = np.full(first_mm.shape, np.nan)
    for order in range(math.ceil((high - low) / pitch_mm)):
        # The place of this order, and the residuals of all phases there, within half a turn.
        tried_mm = first_mm + order * pitch_mm
        residual = turns - tried_mm * turns_per_mm
        residual -= np.rint(residual)

        # Least squares of all phases near it, and what it leaves.
        correction_mm = np.sum(residual * turns_per_mm, axis=0) / np.sum(turns_per_mm**2)
        tried_mm = tried_mm + correction_mm
        residual = turns - tried_mm * turns_per_mm
        residual -= np.rint(residual)
        in_range = (tried_mm >= low) & (tried_mm <= high)
        squares = np.where(in_range, np.sum(residual**2, axis=0), np.inf)

        # The best and the second best place so far.
        second = np.minimum(second, np.maximum(squares, best))
        place_mm = np.where(squares < best, tried_mm, place_mm)
        best = np.minimum(squares, best)

    # Accepted if the chi-square is believable, and far better than that of any other place.
    chi_square_per_square = (2 * math.pi / sigma_rad) ** 2
    misfit = chi_square_per_square * best
    fits = misfit < periods.size - 1 + _FIVE_SIGMA
    is_only_one = chi_square_per_square * (second - best) > _FIVE_SIGMA
    return Places(np.where(fits & is_only_one, place_mm, np.nan), misfit)
