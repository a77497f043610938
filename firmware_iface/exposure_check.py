"""Checks the camera's exposure of the screen, from one frame of white and one of black."""

import numpy as np

from firmware_iface.optical_roles import Pixels

_SATURATED_SHARE = 0.001  # of the pixels: dust and glints
_TARGET = 0.8  # of full scale, for the 99th percentile
_LEAST = 0.25  # below, noise and converter steps are three times larger than necessary
_LEAST_CONTRAST = 3.0


def explain_exposure(white: Pixels, black: Pixels, full_scale_adu: int, exposure_ms: float) -> str:
    """The problem of an exposure and its remedy, in one line; empty if there is none.

    Parameters
    ----------
    white, black : ndarray of int, shape (H, W)
        One frame of a white screen and one of a black screen, camera counts.
    full_scale_adu : int
        Largest count of a pixel, 255 for 8 bits.
    exposure_ms : float
        With which both were taken; a better one is proposed in proportion.
    """
    # Quantiles instead of extremes: dust and glints are single pixels.
    saturated = float(np.mean(white >= full_scale_adu))
    bright = float(np.quantile(white, 0.99))
    dark = float(np.quantile(black, 0.99))
    if saturated > _SATURATED_SHARE:
        return (
            f"{100 * saturated:.1f} % of the pixels are saturated on white; lower exposure_ms = "
            f"{exposure_ms:g} to about {_two_digits(exposure_ms / 2)}, or the gain"
        )
    if bright < _LEAST * full_scale_adu:
        wanted_ms = exposure_ms * _TARGET * full_scale_adu / max(bright, 1.0)
        return (
            f"white gives only {bright:.0f} of {full_scale_adu} counts; raise exposure_ms = "
            f"{exposure_ms:g} to about {_two_digits(wanted_ms)}, open the lens, or is the mirror "
            "covered?"
        )
    if bright < _LEAST_CONTRAST * dark:
        return (
            f"black gives {dark:.0f} counts where white gives {bright:.0f}: other light reaches "
            "the camera; darken the room"
        )
    return ""


def _two_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"
