"""Blur of the image: its width by the contrast of the fringes, and the error that it makes."""

import math
from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, predicted_mm
from membrane_ctrl.model.arrays import FloatArray, IntArray

_TINY = 1e-300  # instead of a division by zero


def blur_source(bench: TrialBench, sigma_px: float) -> Source:
    """Return the row for a picture that is blurred by a Gaussian.

    A phase is its mean over the blur.

    The mean over the Gaussian is that of the four values at a distance of sqrt(2) sigma (as in
    `bin_grid.BinGrid.averaging_bias_mm`).

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    sigma_px : float
        Standard deviation of the Gaussian.

    Returns
    -------
    Source
    """
    nominal = bench.geometry()
    distance_px = math.sqrt(2) * sigma_px
    offsets_px = (
        (distance_px, 0.0),
        (-distance_px, 0.0),
        (0.0, distance_px),
        (0.0, -distance_px),
    )
    mean_mm = np.zeros_like(bench.screen_mm)
    for right, down in offsets_px:
        moved = replace(bench, column_px=bench.column_px + right, row_px=bench.row_px + down)
        mean_mm += predicted_mm(moved, nominal, bench.surface) / 4
    solved = bench.solve(nominal, mean_mm - bench.screen_mm, linear=True)
    effect = solved - bench.surface.parameters
    return Source("blur_px", "blur of the picture", sigma_px, effect[:, None])


def estimate_blur_px(
    predicted_rad: FloatArray,
    swings: FloatArray,
    index: IntArray,
    shape: tuple[int, int],
    bin_px: int,
) -> float:
    """Estimate the blur from the contrast, which falls with the fringes' frequency.

    A blur divides the swing of fringes by exp(sigma^2 |grad phase|^2 / 2), so that

        log(swing_x / swing_y) = const - sigma^2 (|grad phase_x|^2 - |grad phase_y|^2) / 2.

    Whatever acts on the light of a place in the same way for x and y cancels: a panel that is
    darker or has less contrast at an angle, vignetting, stray light, the responses of panel and
    camera. A bin of m pixels is itself a blur of (m^2 - 1) / 12.

    Parameters
    ----------
    predicted_rad : (2, n) array
        Phases of x and y of some bins by the fitted surface. Measured ones have the waves of the
        responses' harmonics, which the swings have, too.
    swings : (2, n) array
        Swings of their fringes.
    index : (n,) int array
        Those bins.
    shape : two int
        Rows and columns of the bins.
    bin_px : int
        Side of a bin.

    Returns
    -------
    float
        Sigma of the Gaussian, pixels.
    """
    # |grad phase|^2 of x and of y, per pixel.
    squares = []
    for phase in predicted_rad:
        grid = np.full(shape, np.nan)
        grid.reshape(-1)[index] = phase
        square = np.sum(np.square(np.gradient(grid)), axis=0)
        squares.append(square.reshape(-1)[index] / bin_px**2)
    # What the contrast of x over that of y depends on.
    difference = squares[0] - squares[1]
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
