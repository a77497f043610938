"""What a calibration leaves of the seen screen points, set by set: noise if the model is right, a pattern if not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from membrane_ctrl.metrology.calibrate.solve import Solution
from membrane_ctrl.recording.atomic import users
from membrane_ctrl.sets.result_files import write_figure

FloatArray = NDArray[np.float64]

_INCHES = 2.6  # a panel
_DPI = 110
_CELLS = 24  # across the picture: enough points in each for a pattern below the noise to be seen


def draw_residuals(path: Path, solution: Solution) -> None:
    """Draw means of the s_x and s_y residuals of all sets over the camera's picture, one scale for all.

    Raises OSError if the file cannot be written.
    """
    count = len(solution.states)
    edges = _edges(solution)
    maps = [[_means(solution, k, axis, edges) for k in range(count)] for axis in range(2)]
    reach = float(np.nanpercentile(np.abs(maps), 98)) or 1.0  # single cells at the edge must not set the scale
    colours = ScalarMappable(Normalize(-reach, reach), "RdBu_r")
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
    figure.colorbar(colours, ax=panels, label="seen minus predicted, um on the screen")
    write_figure(users(path), figure, _DPI)


def _edges(solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Columns and rows at which square cells begin and end."""
    column = np.concatenate([phases.column_px for phases in solution.problem.sets])
    row = np.concatenate([phases.row_px for phases in solution.problem.sets])
    side = max(float(np.ptp(column)), float(np.ptp(row)), 1.0) / _CELLS
    across, down = (np.arange(part.min(), part.max() + side, side) for part in (column, row))
    return across, down


def _means(solution: Solution, index: int, axis: int, edges: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Weighted means over cells, (rows, columns); NaN where a set has no point."""
    phases, linear = solution.problem.sets[index], solution.equations[index]
    weights = linear.trust.weights / phases.sigma_mm**2
    bins = (edges[1], edges[0])
    total = np.histogram2d(phases.row_px, phases.column_px, bins, weights=weights)[0]
    summed = np.histogram2d(phases.row_px, phases.column_px, bins, weights=weights * linear.residual_mm[axis])[0]
    return np.divide(1e3 * summed, total, out=np.full_like(total, np.nan), where=total > 0)
