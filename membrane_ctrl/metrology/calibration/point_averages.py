"""Hundreds of thousands of bins as a few thousand points with the same information.

About a bench and a surface that are nearly right, the residual of the observed screen points is
smooth but for noise: its mean over a cell of the picture keeps all information. The cell's point
is the model's at its middle plus that mean.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.calibration.robust_weights import RobustWeights
from membrane_ctrl.metrology.calibration.set_state import SetState
from membrane_ctrl.metrology.rays import bench_poses, forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray


def average_points(
    bench: bench_poses.BenchGeometry,
    phases: set_phases.SetPhases,
    state: SetState,
    about: int,
) -> set_phases.SetPhases:
    """Reduce a set to fewer points; robust, each with the noise of its mean.

    Parameters
    ----------
    bench : BenchGeometry
        A bench that is nearly right.
    phases : SetPhases
        The set, with n points.
    state : SetState
        Its unknowns, nearly right.
    about : int
        Number of points that are wanted; the picture decides how many there are.

    Returns
    -------
    SetPhases
    """
    # Residuals of the points, and their weights.
    shape = state.surface, state.vertex_z_mm, state.moved_screens
    residual_mm = forward_model.residual_mm(bench, phases, *shape)
    weights = RobustWeights.from_residual(phases, residual_mm).weights / phases.sigma_mm**2

    # The side of a cell. The mirror is seen as an ellipse: pi / 4 of the rectangle around it.
    width = np.ptp(phases.column_px)
    height = np.ptp(phases.row_px)
    cell_px = max(float(np.sqrt(width * height * np.pi / 4 / about)), 1.0)

    # The cell of each point, as one number: from the last row to the first, apart for each place of
    # the screen.
    column = np.floor(phases.column_px / cell_px).astype(int)
    row = np.floor(phases.row_px / cell_px).astype(int)
    screen = np.zeros(row.size, int)
    if phases.screen is not None:
        screen = phases.screen
    row_number = row.max() + 1 - row + (row.max() + 2) * screen
    number = column + row_number * (column.max() + 1)
    _, first, cell = np.unique(number, return_index=True, return_inverse=True)

    # Weighted means over the cells.
    total = np.bincount(cell, weights)

    def average(values: FloatArray) -> FloatArray:
        """Weighted mean (cells,) of values (n,)."""
        return np.asarray(np.bincount(cell, weights * values) / total)

    means = replace(
        phases,
        column_px=average(phases.column_px),
        row_px=average(phases.row_px),
        screen_mm=np.zeros((2, total.size)),
        sigma_mm=1 / np.sqrt(total),
        screen=screen[first],
    )

    # The screen point: the model's at the middle of the cell (the residual of 0 is minus that) plus
    # the mean residual.
    model_mm = -forward_model.residual_mm(bench, means, *shape)
    mean_mm = np.stack([average(residual_mm[0]), average(residual_mm[1])])
    return replace(means, screen_mm=model_mm + mean_mm)
