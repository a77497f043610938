"""What the usable frames say of each bin: light, fringes, wrapped phase, and where the pattern is seen.

The light of a bin has three witnesses, the mean of the x fringes, that of the y fringes, and white minus black; the
fringes' swing likewise. The median of three is right when one of them is wrong, so that one bad frame, whichever it
is, does not spoil the picture that all frames are compared with.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.decode import CONTRAST_SHARE, FRINGE_SHARE
from membrane_ctrl.metrology.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.patterns import AXES
from membrane_ctrl.metrology.phase import step_weights

FloatArray = NDArray[np.float64]

_LEAST_SWING_ADU = 1.0  # less than a rounding step is no fringe


class NoFigureError(Exception):
    """The frames do not carry a figure; the message says why."""


@dataclass(frozen=True)
class View:
    """Arrays over the bins, (rows, columns) each.

    Attributes
    ----------
    used : two lists of int
        The sinusoids of x and y that the phases are made of.
    phase_rad, swing_adu : (2, rows, columns) arrays
        Wrapped phase and fringe amplitude of x and y.
    light : array
        Brightness, in units of the fringes' mean.
    mask : bool array
        Bins that see the pattern in the mirror.
    """

    used: tuple[list[int], list[int]]
    phase_rad: FloatArray
    swing_adu: FloatArray
    light: FloatArray
    mask: NDArray[np.bool_]


def look(stack: FrameStack, binned: Binned, excluded: Collection[int], witness: FloatArray | None = None) -> View:
    """Combine the frames that are not excluded.

    Parameters
    ----------
    witness : (rows, columns) array, optional
        The light as another set saw it: the third witness of a set without white and black.

    Raises
    ------
    NoFigureError
        If an axis has fewer than three usable steps, or if there are no fringes.
    """
    used = tuple([k for k in stack.sinusoids(axis) if k not in excluded] for axis in AXES)
    light, swing, phase, saturated = [], [], [], np.zeros(binned.means.shape[1:], bool)
    for axis, frames in zip(AXES, used, strict=True):
        try:
            weights = step_weights(stack.shifts_rad(frames))
        except ValueError:
            raise NoFigureError(
                f"{len(frames)} of {len(stack.sinusoids(axis))} {axis} phase steps are usable: too few for a phase"
            ) from None
        mean, cosine, sine = np.tensordot(weights, binned.means[frames].astype(float), axes=1)
        light.append(mean)
        swing.append(np.hypot(cosine, sine))
        phase.append(np.arctan2(sine, cosine))
        saturated |= binned.saturated[frames].any(axis=0)
    third = _third_witness(stack, binned, excluded) if witness is None else witness
    seen = _middle([*swing] if third is None else [*swing, third])
    brightest = float(np.percentile(seen, 95))
    if not brightest > _LEAST_SWING_ADU:
        raise NoFigureError(f"no fringes: they swing by {brightest:.2g} ADU where they swing most")
    mask = seen > CONTRAST_SHARE * brightest
    mask &= np.minimum(*swing) > FRINGE_SHARE * seen
    mask &= ~saturated
    every = light if third is None else [*light, third]
    return View((used[0], used[1]), np.stack(phase), np.stack(swing), _middle(every, mask), mask)


def _third_witness(stack: FrameStack, binned: Binned, excluded: Collection[int]) -> FloatArray | None:
    white, black = stack.single("white"), stack.single("black")
    if white is None or black is None or {white, black} & set(excluded):
        return None
    return np.asarray(binned.means[white].astype(float) - binned.means[black])


def _middle(maps: list[FloatArray], where: NDArray[np.bool_] | None = None) -> FloatArray:
    """Median of two or three maps, each scaled to the median of the first (over its brighter half by default)."""
    if where is None or not where.any():
        where = maps[0] >= np.median(maps[0])
    medians = [max(float(np.median(m[where])), 1e-9) for m in maps]
    scaled = [m * (medians[0] / own) for m, own in zip(maps, medians, strict=True)]
    if len(scaled) == 2:
        return np.asarray((scaled[0] + scaled[1]) / 2)
    a, b, c = scaled
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))
