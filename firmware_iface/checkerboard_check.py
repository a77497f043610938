"""Checks whether the screen shows every pixel as sent.

The screen shows a one-pixel checkerboard, which the camera does not resolve. Shown as sent, half of
the pixels are lit, and the camera sees half of the white screen's light everywhere. A scaler in
between mixes neighbours before the display's gamma: 0 and 255 become 127, which is a quarter of the
light (gamma 2.2: 0.22). Where its grid and the panel's agree again, the camera sees half of the
light. So a panel that announces 1360 and has 1366 columns shows six bands.
"""

import numpy as np
from numpy.typing import ArrayLike

from firmware_iface.image_blocks import block_means

_LIT_SHARE = 0.3  # of the brightest block: where the mirror shows the screen
_LEAST_LIT = 0.02  # of all blocks
# A panel's own crosstalk between neighbours takes up to a tenth of the half
_HALF_RANGE = (0.40, 0.60)
_LARGEST_BAND = 0.10


def explain_checkerboard(seen: ArrayLike, white: ArrayLike, black: ArrayLike) -> str:
    """Explain what is wrong with the screen's pixels, by frames of a one-pixel checkerboard.

    Parameters
    ----------
    seen : (H, W) array
        Frame of the checkerboard.
    white, black : (H, W) array
        Frames of a white and of a black screen, with the same exposure.

    Returns
    -------
    str
        The problem and its remedy; empty if the screen shows every pixel as sent.
    """
    # Blocks that see the screen.
    dark = block_means(black)
    full = block_means(white) - dark
    lit = full > _LIT_SHARE * float(np.max(full))
    if float(np.max(full)) <= 0 or np.mean(lit) < _LEAST_LIT:
        return "the camera does not see the screen: no block is brighter on white than on black"
    # Each should have half of the light: scaling makes bands, sharpening another mean.
    share = (block_means(seen) - dark)[lit] / full[lit]
    low, middle, high = (float(value) for value in np.percentile(share, (2, 50, 98)))
    if high - low > _LARGEST_BAND:
        return (
            f"a one-pixel checkerboard shows bands ({100 * low:.0f} .. {100 * high:.0f} % of "
            "white): the screen rescales; set the panel's own resolution and switch off overscan "
            "and scaling"
        )
    if not _HALF_RANGE[0] < middle < _HALF_RANGE[1]:
        return (
            f"a one-pixel checkerboard gives {100 * middle:.0f} % of white instead of 50: the "
            "screen sharpens or mixes pixels; set the panel's own resolution and switch off "
            "picture improvements"
        )
    return ""
