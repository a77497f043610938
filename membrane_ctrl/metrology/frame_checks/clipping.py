"""Shares of a set's bins that are clipped, and the cause that they state for a set without figure.

A clipped bin is no evidence of the surface and is left out. A set with few others has no figure:
then the clipping is the cause, not the number of bins that remain.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase.frame_stack import Binned
from membrane_ctrl.model.arrays import BoolArray
from membrane_ctrl.model.shape_estimate import (
    SATURATED_REJECTED_FRACTION,
    describe_black_clipping,
    describe_saturation,
)

_LIT_SHARE = 0.5  # of the brightest bins: what sees the panel


@dataclass(frozen=True)
class ClippedShares:
    """Shares of bins with a clipped pixel in some frame."""

    white: float
    black: float

    @property
    def cause(self) -> str:
        """Why such a set has no figure; empty if it is not the clipping."""
        if max(self.white, self.black) <= SATURATED_REJECTED_FRACTION:
            return ""
        if self.white >= self.black:
            return describe_saturation(self.white)
        return describe_black_clipping(self.black)


def clipped_shares(binned: Binned, frames: list[int], seen: BoolArray) -> ClippedShares:
    """Return the shares of bins that are clipped in at least one of some frames.

    Parameters
    ----------
    binned : Binned
        The set's frames as bins.
    frames : list of int
        The frames that count.
    seen : (rows, columns) bool array
        The bins that count.

    Returns
    -------
    ClippedShares
        At white and at black; 0 without frames or bins.
    """
    if not frames or not seen.any():
        return ClippedShares(0.0, 0.0)
    clipped = binned.saturated[frames]
    if binned.black is None:
        return ClippedShares(_share_of(clipped, seen), 0.0)
    black = binned.black[frames]
    # A bin clipped at both ends in one frame counts as black: its mean is that of an edge
    return ClippedShares(_share_of(clipped & ~black, seen), _share_of(black, seen))


def _share_of(clipped: BoolArray, seen: BoolArray) -> float:
    in_some_frame: BoolArray = np.any(clipped, axis=0)
    return float(np.mean(in_some_frame[seen]))


def clipped_shares_of_lit(binned: Binned, frames: list[int], near: BoolArray) -> ClippedShares:
    """Return the clipped shares of the bins that see the panel.

    Parameters
    ----------
    binned : Binned
        The set's frames as bins.
    frames : list of int
        The frames that count.
    near : (rows, columns) bool array
        Bins whose rays may meet the mirror; of these, the bins count that are bright in one of the
        frames.

    Returns
    -------
    ClippedShares
    """
    if not frames or not near.any():
        return ClippedShares(0.0, 0.0)
    brightest = binned.means[frames].max(axis=0)
    lit = brightest > _LIT_SHARE * float(np.quantile(brightest[near], 0.99))
    return clipped_shares(binned, frames, near & lit)
