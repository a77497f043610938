"""Draws the residuals of a calibration over the camera's picture."""

from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from membrane_ctrl.measure.result_files import write_picture
from membrane_ctrl.metrology.calibration import solver
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import DIVERGING_MAP
from membrane_ctrl.model.files import resolve_user_path

_INCHES = 2.6  # a panel
_DPI = 110
_CELLS = 24  # across the picture: each averages enough points to show a pattern below the noise
_SCALE_PERCENTILE = 98


def draw_residuals(path: Path, solution: solver.Solution) -> None:
    """Draw the mean residuals of all sets over the camera's picture, on a common scale.

    Parameters
    ----------
    path : Path
        The picture to write.
    solution : Solution
        The solved bench.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    count = len(solution.states)
    edges = _cell_edges(solution)
    maps = [[_cell_means(solution, k, axis, edges) for k in range(count)] for axis in range(2)]

    # A common scale about 0; single cells at the edge must not set it.
    reach = float(np.nanpercentile(np.abs(maps), _SCALE_PERCENTILE)) or 1.0
    colours = ScalarMappable(Normalize(-reach, reach), DIVERGING_MAP)
    figure = Figure(figsize=(_INCHES * count, 2 * _INCHES), layout="constrained")
    panels = figure.subplots(2, count, squeeze=False, sharex=True, sharey=True)
    for axis, name in enumerate(("s_x", "s_y")):
        for k, phases in enumerate(solution.problem.sets):
            panel = panels[axis][k]
            panel.pcolormesh(*edges, maps[axis][k], cmap=colours.cmap, norm=colours.norm)
            panel.set_aspect("equal")
            panel.set_title(f"{phases.name}: {name}", fontsize=8, parse_math=False)
            panel.tick_params(labelsize=6)
    panels[0][0].invert_yaxis()  # rows count downwards; the axes are shared
    figure.colorbar(colours, ax=panels, label="seen minus predicted, µm on the screen")
    write_picture(resolve_user_path(path), figure, _DPI)


def _cell_edges(solution: solver.Solution) -> tuple[FloatArray, FloatArray]:
    """Columns and rows of the boundaries of square cells."""
    column = np.concatenate([phases.column_px for phases in solution.problem.sets])
    row = np.concatenate([phases.row_px for phases in solution.problem.sets])
    side = max(float(np.ptp(column)), float(np.ptp(row)), 1.0) / _CELLS
    across = np.arange(column.min(), column.max() + side, side)
    down = np.arange(row.min(), row.max() + side, side)
    return across, down


def _cell_means(
    solution: solver.Solution, index: int, axis: int, edges: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Weighted means over cells, (rows, columns); NaN in cells without points."""
    phases = solution.problem.sets[index]
    linear = solution.equations[index]
    weights = linear.robust.weights / phases.sigma_mm**2
    weighted_mm = weights * linear.residual_mm[axis]
    bins = (edges[1], edges[0])
    total = np.histogram2d(phases.row_px, phases.column_px, bins, weights=weights)[0]
    sum_mm = np.histogram2d(phases.row_px, phases.column_px, bins, weights=weighted_mm)[0]
    return np.divide(1e3 * sum_mm, total, out=np.full_like(total, np.nan), where=total > 0)
