"""Blur of the picture, by the contrast of its fringes."""

import math

import numpy as np

from membrane_ctrl.model.arrays import FloatArray, IntArray

_TINY = 1e-300  # instead of a division by zero


def phase_gradients(
    predicted_rad: FloatArray, index: IntArray, shape: tuple[int, int], bin_px: int
) -> FloatArray:
    """Compute the gradients of phases in the picture.

    Parameters
    ----------
    predicted_rad : (2, n) array
        Phases of x and y of some bins by the fitted surface. Measured ones have the waves of the
        responses' harmonics, which the swings have, too.
    index : (n,) int array
        Those bins.
    shape : two int
        Rows and columns of the bins.
    bin_px : int
        Side of a bin.

    Returns
    -------
    (2, n) array
        |grad phase| of x and of y, rad per pixel; NaN beside a bin without a phase.
    """
    gradients = []
    for phase in predicted_rad:
        grid = np.full(shape, np.nan)
        grid.reshape(-1)[index] = phase
        of_grid = np.hypot(*np.gradient(grid))
        gradients.append(of_grid.reshape(-1)[index] / bin_px)
    return np.stack(gradients)


def estimate_blur_px(gradients: FloatArray, swings: FloatArray, bin_px: int) -> float:
    """Estimate the blur from the contrast, which falls with the fringes' frequency.

    A blur divides the swing of fringes by exp(sigma^2 |grad phase|^2 / 2), so that

        log(swing_x / swing_y) = const - sigma^2 (|grad phase_x|^2 - |grad phase_y|^2) / 2.

    Whatever acts on the light of a place in the same way for x and y cancels: a panel that is
    darker or has less contrast at an angle, vignetting, stray light, the responses of panel and
    camera. A bin of m pixels is itself a blur of (m^2 - 1) / 12.

    Parameters
    ----------
    gradients : (2, n) array
        |grad phase| of x and of y, rad per pixel (`phase_gradients`).
    swings : (2, n) array
        Swings of the fringes.
    bin_px : int
        Side of a bin.

    Returns
    -------
    float
        Sigma of the Gaussian, pixels.
    """
    # What the contrast of x over that of y depends on.
    difference = gradients[0] ** 2 - gradients[1] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        contrast = np.log(swings[0]) - np.log(swings[1])
    known = np.isfinite(difference) & np.isfinite(contrast)
    if not known.any():
        return 0.0

    # Regression of the contrast on the difference; its slope is -sigma^2 / 2.
    difference = difference[known] - difference[known].mean()
    contrast = contrast[known] - contrast[known].mean()
    slope = float(difference @ contrast) / max(float(difference @ difference), _TINY)
    of_bin = (bin_px**2 - 1) / 12
    return math.sqrt(max(-2 * slope - of_bin, 0.0))
