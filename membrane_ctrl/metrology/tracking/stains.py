"""Stains that came since the reference: a breath, drops or dust on mirror, lens or screen.

A stain multiplies the light I of a place, and the fit leaves s I of it. A motion of the bench turns
the phases, and what no surface explains of it is e dI/dphi. The cells of the mirror are smaller
than a fringe, so that in each of them a part of one looks like the other; over all cells the true
cause explains more of what the fit leaves. Light that changes slowly over the mirror is fitted, and
no stain.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# Explained power over that of the pixels' noise: frames without a stain reach 2, and one of 1 % of
# the light, in patches of 30 mm, has 17.
_LEAST_POWER = 8.0
# Power that changed light explains over that of changed phases. Stains reach 2.2 to 3.
_LEAST_RATIO = 1.5
# Share of the median power of a cell's own light, below which it is too dark to count.
_LEAST_LIGHT = 0.3
# By how much a stain bends the figure at most, per share of the light: 0.14 µm are measured for
# 2 % RMS in patches of 30 mm, and a stain that follows the fringes by chance may do three times as
# much.
_UM_PER_SHARE = 20.0


@dataclass(frozen=True)
class Stain:
    """Light that has changed in patches.

    Attributes
    ----------
    share : float
        RMS change over the light.
    """

    share: float

    def explains(self, figure_um: float) -> bool:
        """Whether it may bend a figure by so much, RMS in µm."""
        return figure_um < _UM_PER_SHARE * self.share

    def describe(self) -> str:
        """For people."""
        return (
            f"stained: the light has changed by {self.share:.1%} in patches since the reference; "
            "look for a breath, drops or dust on mirror, lens or screen"
        )


def find_stain(products: FloatArray, powers: FloatArray, noise_adu: float) -> Stain | None:
    """Find a stain in what the fit of a frame leaves.

    Parameters
    ----------
    products : (3, cells) array
        Sums over the bins of a cell of the residual times the light, and times the light's
        derivatives by the phases of x and of y.
    powers : (3, cells) array
        Sums of the squares of these three.
    noise_adu : float
        Noise of a bin.

    Returns
    -------
    Stain or None
        None if noise, or a change of the phases, explains as much.
    """
    is_lit = (powers > _LEAST_LIGHT * np.median(powers, axis=1)[:, None]).all(axis=0)
    if not is_lit.any():
        return None
    products = products[:, is_lit]
    powers = powers[:, is_lit]
    by_light, *by_phases = np.mean(products**2 / powers, axis=1)
    if by_light < _LEAST_POWER * noise_adu**2 or by_light < _LEAST_RATIO * max(by_phases):
        return None
    return Stain(math.sqrt(float(np.mean((products[0] / powers[0]) ** 2))))
