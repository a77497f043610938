"""Hundreds of thousands of bins as a few thousand points that say the same.

About a bench and a surface that are nearly right, what is left of the seen screen points is smooth but for noise: its
mean over a cell of the picture keeps all that it says. The cell's point is the model's at its middle plus that mean.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.metrology.calibrate.parameters import Bench
from membrane_ctrl.metrology.calibrate.residuals import SetPhases, residual_mm
from membrane_ctrl.metrology.calibrate.separable import SetState, Trust


def averaged(bench: Bench, phases: SetPhases, state: SetState, about: int) -> SetPhases:
    """The set with about so many points; robust, each with the noise of its mean."""
    left = residual_mm(bench, phases, state.surface, state.vertex_z_mm)
    weights = Trust.seen(phases, left).weights / phases.sigma_mm**2
    width, height = np.ptp(phases.column_px), np.ptp(phases.row_px)
    cell_px = max(float(np.sqrt(width * height * np.pi / 4 / about)), 1.0)  # the mirror is seen as an ellipse
    column, row = (np.floor(place / cell_px).astype(int) for place in (phases.column_px, phases.row_px))
    _, cell = np.unique(column + (row.max() + 1 - row) * (column.max() + 1), return_inverse=True)
    total = np.bincount(cell, weights)
    column_px, row_px, *rest = (
        np.bincount(cell, weights * value) / total for value in (phases.column_px, phases.row_px, *left)
    )
    sigma_mm = 1 / np.sqrt(total)
    bare = SetPhases(phases.name, column_px, row_px, np.zeros((2, total.size)), sigma_mm, phases.displacement_um)
    model = -residual_mm(bench, bare, state.surface, state.vertex_z_mm)
    return SetPhases(phases.name, column_px, row_px, model + np.stack(rest), sigma_mm, phases.displacement_um)
