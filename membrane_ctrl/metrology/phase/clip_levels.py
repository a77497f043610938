"""Levels at which a camera clips its pictures, wherever they are.

A camera clips at the converter's full scale, but also where 12 bits stand on the left of 16, at the
ends of the video range (16 and 235 of 255), at a full well below the converter's range, or at black
after too large an offset was subtracted. Clipping piles pixels up at one extreme level, with none
beyond it. Light that is not clipped leaves an end that noise and uneven light make thin.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import AnyArray, Image, IntArray

_SAMPLES = 300_000  # pixels, enough for shares of 1e-4
_STRAY_SHARE = 1e-4  # hot and dead pixels, which may lie beyond the extreme level
_LEAST_SHARE = 1e-3  # of the pixels at the extreme level; fewer do no harm
_NEIGHBOURS = 4  # levels beside the extreme one that it is compared with
# Pixels at the extreme level over the mean of its neighbours. Without noise and with even light,
# sinusoids reach 2 at the bright end. At the dark end, a panel's gamma of 2.2 makes that 6.
_PILE_WHITE = 6.0
_PILE_BLACK = 12.0
_LIT_SHARE = 0.5  # of the brightest pixels: pixels above it see the panel
_BRIGHTEST_QUANTILE = 0.99


@dataclass(frozen=True)
class ClipLevels:
    """Levels at which pixels are clipped, ADU.

    Attributes
    ----------
    white_adu : int
        Pixels at this level and above are clipped at white.
    black_adu : int
        Pixels at this level and below are clipped at black; -1: none are.
    """

    white_adu: int
    black_adu: int = -1


def find_clip_levels(frames: Sequence[Image], full_scale_adu: int) -> ClipLevels:
    """Find the levels at which pictures of sinusoids are clipped.

    Parameters
    ----------
    frames : sequence of (height, width) arrays
        Sinusoids, two or more of one axis at least: each pixel that sees the panel is bright in
        one.
    full_scale_adu : int
        Level from which a pixel counts as clipped in any case.

    Returns
    -------
    ClipLevels
        With the full scale and -1 where nothing is clipped.
    """
    unclipped = ClipLevels(full_scale_adu)
    if not frames:
        return unclipped

    # Levels of the lit pixels in all sinusoids.
    thinned = _thin(frames)
    brightest = thinned.max(axis=0)
    lit = brightest > _LIT_SHARE * float(np.quantile(brightest, _BRIGHTEST_QUANTILE))
    histogram = np.bincount(thinned[:, lit].ravel())
    levels = np.flatnonzero(histogram)
    counts = histogram[levels]

    # Levels at both ends at which the pixels pile up.
    white_adu = _piled_level(levels[::-1], counts[::-1], _PILE_WHITE)
    black_adu = _piled_level(levels, counts, _PILE_BLACK)
    if white_adu is not None and white_adu == black_adu:  # one level only: an empty picture
        return unclipped

    # Without a pile, the converter clips at its own ends.
    if white_adu is None:
        white_adu = full_scale_adu
    if black_adu is None:
        black_adu = unclipped.black_adu
    return ClipLevels(min(white_adu, full_scale_adu), black_adu)


def _thin(frames: Sequence[Image]) -> AnyArray:
    """Return every n-th pixel of the rows and of the columns; n is odd, for Bayer sensors."""
    pixels = len(frames) * frames[0].size
    step = int((pixels / _SAMPLES) ** 0.5)
    step += 1 - step % 2
    return np.stack([frame[::step, ::step] for frame in frames])


def _piled_level(levels: IntArray, counts: IntArray, pile: float) -> int | None:
    """Return the extreme level if pixels pile up there; levels are ordered from that end."""
    total = int(counts.sum())
    if not total:
        return None
    # The extreme level, but for a few stray pixels beyond it, and the levels beside it.
    stray = _STRAY_SHARE * total
    extreme = int(np.searchsorted(np.cumsum(counts), stray, side="right"))
    beside = counts[extreme + 1 : extreme + 1 + _NEIGHBOURS]
    if len(beside) < _NEIGHBOURS or counts[extreme] < _LEAST_SHARE * total:
        return None
    if counts[extreme] <= pile * float(beside.mean()):
        return None
    return int(levels[extreme])
