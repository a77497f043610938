"""Error of the figure by a blurred picture; `frame_checks.picture_blur` finds the blur."""

import math
from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, predicted_mm


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
