"""Light, fringe contrast, wrapped phase and mask of each bin, from the usable frames of a set.

The light of a bin has three estimates, the mean of the x fringes, that of the y fringes, and white
minus black; the fringes' swing in the same way. The median of three is right when one of them is
wrong, so that one bad frame, whichever it is, does not spoil the picture that all frames are
compared with.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.full_decoder import CONTRAST_SHARE, FRINGE_SHARE
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_LEAST_SWING_ADU = 1.0  # less than a rounding step is no fringe
_BRIGHTEST_PERCENTILE = 95  # the swing that `CONTRAST_SHARE` refers to


class NoFigureError(Exception):
    """The frames give no figure; the message states why."""


@dataclass(frozen=True)
class BinView:
    """What the usable frames show of each bin.

    Attributes
    ----------
    used : two lists of int
        The sinusoids of x and y that the phases are made of.
    phase_rad : (2, rows, columns) array
        Wrapped phase of x and y (eq. 1).
    swing_adu : (2, rows, columns) array
        Fringe amplitude.
    light : (rows, columns) array
        Brightness, in units of the fringes' mean.
    mask : (rows, columns) bool array
        Bins that see the pattern in the mirror.
    """

    used: tuple[list[int], list[int]]
    phase_rad: FloatArray
    swing_adu: FloatArray
    light: FloatArray
    mask: BoolArray


def combine_frames(
    stack: FrameStack, binned: Binned, excluded: Collection[int], estimate: FloatArray | None = None
) -> BinView:
    """Combine the frames that are not excluded.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    excluded : collection of int
        Frames that do not belong to the set.
    estimate : (rows, columns) array, optional
        Light that another set saw: the third estimate of a set without white and black.

    Returns
    -------
    BinView

    Raises
    ------
    NoFigureError
        An axis has fewer than three usable steps, or there are no fringes.
    """
    used = tuple([k for k in stack.sinusoids(axis) if k not in excluded] for axis in AXES)

    # Mean, amplitude and wrapped phase of the fringes of each axis, by least squares.
    light = []
    swing = []
    phase = []
    saturated = np.zeros(binned.means.shape[1:], bool)
    for axis, frames in zip(AXES, used, strict=True):
        try:
            weights = stack.weights(frames)
        except ValueError:
            raise NoFigureError(
                f"{len(frames)} of {len(stack.sinusoids(axis))} {axis} phase steps are "
                "usable: too few for a phase"
            ) from None
        mean, cosine, sine = np.tensordot(weights, binned.means[frames].astype(float), axes=1)
        light.append(mean)
        swing.append(np.hypot(cosine, sine))
        phase.append(np.arctan2(sine, cosine))
        saturated |= binned.saturated[frames].any(axis=0)
    light_estimates = light
    swing_estimates = swing
    third = estimate
    if estimate is None:
        third = _third_estimate(stack, binned, excluded)
    if third is not None:
        light_estimates = [*light, third]
        swing_estimates = [*swing, third]

    # The mask: bins with enough contrast in both axes, and without a clipped pixel.
    contrast = _median_of_maps(swing_estimates)
    brightest = float(np.percentile(contrast, _BRIGHTEST_PERCENTILE))
    if not brightest > _LEAST_SWING_ADU:
        raise NoFigureError(f"no fringes: their largest swing is {brightest:.2g} ADU")
    mask = contrast > CONTRAST_SHARE * brightest
    mask &= np.minimum(*swing) > FRINGE_SHARE * contrast
    mask &= ~saturated
    return BinView(
        used=(used[0], used[1]),
        phase_rad=np.stack(phase),
        swing_adu=np.stack(swing),
        light=_median_of_maps(light_estimates, mask),
        mask=mask,
    )


def _third_estimate(
    stack: FrameStack, binned: Binned, excluded: Collection[int]
) -> FloatArray | None:
    """White minus black; None unless both are usable."""
    pair = stack.white_and_black(excluded)
    if pair is None:
        return None
    white, black = pair
    return np.asarray(binned.means[white].astype(float) - binned.means[black])


def _median_of_maps(maps: list[FloatArray], where: BoolArray | None = None) -> FloatArray:
    """Median of two or three maps, each scaled to the median of the first (over its brighter half
    by default).
    """
    if where is None or not where.any():
        where = maps[0] >= np.median(maps[0])
    medians = [max(float(np.median(m[where])), 1e-9) for m in maps]
    scaled = [m * (medians[0] / own) for m, own in zip(maps, medians, strict=True)]
    if len(scaled) == 2:
        return np.asarray((scaled[0] + scaled[1]) / 2)
    # Median of three, bin by bin.
    a, b, c = scaled
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))
