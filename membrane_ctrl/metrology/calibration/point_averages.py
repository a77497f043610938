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


def average_points(
    bench: bench_poses.BenchGeometry,
    phases: set_phases.SetPhases,
    state: SetState,
    about: int,
) -> set_phases.SetPhases:
    """The set reduced to about that many points; robust, each with the noise of its mean."""
    shape = state.surface, state.vertex_z_mm, state.elsewhere
    left = forward_model.residual_mm(bench, phases, *shape)
    weights = RobustWeights.seen(phases, left).weights / phases.sigma_mm**2
    width, height = np.ptp(phases.column_px), np.ptp(phases.row_px)
    cell_px = max(
        float(np.sqrt(width * height * np.pi / 4 / about)), 1.0
    )  # the mirror is seen as an ellipse
    column, row = (
        np.floor(place / cell_px).astype(int) for place in (phases.column_px, phases.row_px)
    )
    screen = np.zeros(row.size, int) if phases.screen is None else phases.screen
    place = column + (row.max() + 1 - row + (row.max() + 2) * screen) * (column.max() + 1)
    _, first, cell = np.unique(place, return_index=True, return_inverse=True)
    total = np.bincount(cell, weights)
    column_px, row_px, *rest = (
        np.bincount(cell, weights * value) / total
        for value in (phases.column_px, phases.row_px, *left)
    )
    sigma_mm = 1 / np.sqrt(total)
    dark = np.zeros((2, total.size))
    bare = replace(
        phases,
        column_px=column_px,
        row_px=row_px,
        screen_mm=dark,
        sigma_mm=sigma_mm,
        screen=screen[first],
    )
    model = -forward_model.residual_mm(bench, bare, *shape)
    return replace(bare, screen_mm=model + np.stack(rest))
