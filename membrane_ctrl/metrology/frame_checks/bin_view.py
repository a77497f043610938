"""What the usable frames show of each bin: light, fringes, wrapped phase, and where the pattern is
seen.

The light of a bin has three estimates, the mean of the x fringes, that of the y fringes, and white
minus black; the fringes' swing likewise. The median of three is right when one of them is wrong,
so that one bad frame, whichever it is, does not spoil the picture that all frames are compared
with.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.full_decoder import CONTRAST_SHARE, FRINGE_SHARE
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_LEAST_SWING_ADU = 1.0  # less than a rounding step is no fringe


class NoFigureError(Exception):
    """The frames give no figure; the message says why."""


@dataclass(frozen=True)
class BinView:
    """Arrays over the bins, (rows, columns) each."""

    used: tuple[list[int], list[int]]  # the sinusoids of x and y that the phases are made of
    phase_rad: FloatArray  # (2, rows, columns): wrapped phase of x and y
    swing_adu: FloatArray  # (2, rows, columns): fringe amplitude
    light: FloatArray  # brightness, in units of the fringes' mean
    mask: BoolArray  # bins that see the pattern in the mirror


def combine_frames(
    stack: FrameStack, binned: Binned, excluded: Collection[int], estimate: FloatArray | None = None
) -> BinView:
    """Combine the frames that are not excluded.

    `estimate` (rows, columns) is the light that another set saw, the third estimate of a set
    without white and black. Raises NoFigureError if an axis has fewer than three usable steps, or
    if there are no fringes.
    """
    used = tuple([k for k in stack.sinusoids(axis) if k not in excluded] for axis in AXES)
    light, swing, phase, saturated = [], [], [], np.zeros(binned.means.shape[1:], bool)
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
    third = _third_estimate(stack, binned, excluded) if estimate is None else estimate
    seen = _median_of_maps([*swing] if third is None else [*swing, third])
    brightest = float(np.percentile(seen, 95))
    if not brightest > _LEAST_SWING_ADU:
        raise NoFigureError(f"no fringes: their largest swing is {brightest:.2g} ADU")
    mask = seen > CONTRAST_SHARE * brightest
    mask &= np.minimum(*swing) > FRINGE_SHARE * seen
    mask &= ~saturated
    every = light if third is None else [*light, third]
    return BinView(
        (used[0], used[1]), np.stack(phase), np.stack(swing), _median_of_maps(every, mask), mask
    )


def _third_estimate(
    stack: FrameStack, binned: Binned, excluded: Collection[int]
) -> FloatArray | None:
    white, black = stack.single("white"), stack.single("black")
    if white is None or black is None or {white, black} & set(excluded):
        return None
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
    a, b, c = scaled
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))
