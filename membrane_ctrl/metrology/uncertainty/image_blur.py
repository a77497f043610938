"""Blur of the image: its width by the contrast of the fringes, and the error that it makes."""

import math
from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, predicted_mm
from membrane_ctrl.model.arrays import FloatArray, IntArray


def blur_source(bench: TrialBench, sigma_px: float) -> Source:
    """A picture blurred by a Gauss of this width: the phase is its mean over the blur.

    The mean of the four values at a distance of sqrt(2) sigma, less the value at the centre
    (`bins.BinGrid`).
    """
    nominal, far = bench.geometry(), math.sqrt(2) * sigma_px
    mean = np.zeros_like(bench.screen_mm)
    for right, down in ((far, 0.0), (-far, 0.0), (0.0, far), (0.0, -far)):
        beside = replace(bench, column_px=bench.column_px + right, row_px=bench.row_px + down)
        mean += predicted_mm(beside, nominal, bench.surface) / 4
    effect = (
        bench.solve(bench.geometry(), mean - bench.screen_mm, linear=True)
        - bench.surface.parameters
    )
    return Source("blur_px", "blur of the picture", sigma_px, effect[:, None])


def estimate_blur_px(
    phase_rad: FloatArray, contrasts: FloatArray, index: IntArray, bin_px: int
) -> float:
    """Width of the blur, a Gauss's sigma in pixels: the contrast falls with the fringes' frequency.

    log(swing / light) = const - sigma^2 |grad phase|^2 / 2, for x and y each with its own constant.
    A bin of m pixels is itself a blur of (m^2 - 1) / 12.

    Parameters
    ----------
    phase_rad : (2, rows, columns) array
        Phases of x and y of the bins; NaN where unknown.
    contrasts : (2, n) array
        Swing over light of some bins.
    index : (n,) int array
        Those bins.
    bin_px : int
        Side of a bin.
    """
    slopes, contrasts_left = [], []
    for axis in range(2):
        steep = (
            np.sum(np.square(np.gradient(phase_rad[axis])), axis=0).reshape(-1)[index] / bin_px**2
        )
        contrast = np.log(contrasts[axis])
        known = np.isfinite(steep) & np.isfinite(contrast)
        slopes.append(steep[known] - steep[known].mean())
        contrasts_left.append(contrast[known] - contrast[known].mean())
    steep, contrast = np.concatenate(slopes), np.concatenate(contrasts_left)
    square = -2 * float(steep @ contrast) / max(float(steep @ steep), 1e-300) - (bin_px**2 - 1) / 12
    return math.sqrt(max(square, 0.0))
