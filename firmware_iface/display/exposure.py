"""Is the camera's exposure right for the screen? From one frame of white and one of black."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SATURATED_SHARE = 0.001  # of the pixels: dust and glints
_TARGET = 0.8  # of full scale, for the brightest pixels but a hundredth
_LEAST = 0.25  # below, noise and steps of the converter are three times what they need to be
_LEAST_CONTRAST = 3.0


def exposure_problem(
    white: NDArray[np.uint8] | NDArray[np.uint16],
    black: NDArray[np.uint8] | NDArray[np.uint16],
    full_scale_adu: int,
    exposure_ms: float,
) -> str:
    """What is wrong, with the remedy; empty when nothing is.

    Parameters
    ----------
    white, black : (H, W) arrays
        Frames of a white and of a black screen.
    full_scale_adu : int
        Highest count of the camera.
    exposure_ms : float
        What they were taken with.
    """
    saturated = float(np.mean(white >= full_scale_adu))
    bright, dark = float(np.quantile(white, 0.99)), float(np.quantile(black, 0.99))
    if saturated > _SATURATED_SHARE:
        return (
            f"{100 * saturated:.1f} % of the pixels are saturated on white; lower exposure_ms = {exposure_ms:g} "
            f"to about {_two_digits(exposure_ms / 2)}, or the gain"
        )
    if bright < _LEAST * full_scale_adu:
        wanted_ms = exposure_ms * _TARGET * full_scale_adu / max(bright, 1.0)
        return (
            f"white gives only {bright:.0f} of {full_scale_adu} counts; raise exposure_ms = {exposure_ms:g} to about "
            f"{_two_digits(wanted_ms)}, open the lens, or is the mirror covered?"
        )
    if bright < _LEAST_CONTRAST * dark:
        return (
            f"black gives {dark:.0f} counts where white gives {bright:.0f}: other light reaches the camera; darken "
            "the room"
        )
    return ""


def _two_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"
