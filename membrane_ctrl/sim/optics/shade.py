"""Turns traced nodes into a picture of a pattern along one axis: about ten nanoseconds a pixel."""

import numpy as np

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.node_interpolation import interpolate_cubic, interpolate_row
from membrane_ctrl.sim.optics.row_exposure import BESIDE_FILM, expose_row


def vignetting_loss(
    width_px: int, height_px: int, corner_loss: float
) -> tuple[FloatArray, FloatArray]:
    """Return the loss of light towards the corners as a sum of one by column and one by row:
    corner_loss (distance from the middle / distance of the corner)^2.

    Parameters
    ----------
    width_px, height_px : int
        Of the picture.
    corner_loss : float
        Share that a corner loses.

    Returns
    -------
    by_column : (W,) array
    by_row : (H,) array
    """
    columns = np.arange(width_px) - (width_px - 1) / 2.0
    rows = np.arange(height_px) - (height_px - 1) / 2.0
    per_px2 = corner_loss / (columns[0] ** 2 + rows[0] ** 2)
    return per_px2 * columns**2, per_px2 * rows**2


@compile_loop()
def _look_up_level(s_mm: float, values: FloatArray, cell_mm: float, smooth: bool) -> float:
    """Value of the table at s from the region's low edge; the caller ensures 0 <= s < side."""
    place = s_mm / cell_mm
    cell = int(place)
    if not smooth:
        return float(values[min(cell, values.size - 1)])
    fraction = place - cell
    cell %= values.size - 1
    return float(values[cell] + fraction * (values[cell + 1] - values[cell]))


@compile_loop(nogil=True)
def shade_rows(
    nodes: FloatArray,
    weights: FloatArray,
    axis: int,
    radius_mm: float,
    side_mm: float,
    table: tuple[FloatArray, float, bool],
    scale: FloatArray,
    loss: tuple[FloatArray, FloatArray],
    noise: tuple[Singles, float, int],
    added: tuple[Singles, int, int],
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows of the picture of one pattern.

    Parameters
    ----------
    nodes : (3 or 5, rows, columns) array
        At nodes, `step` pixels apart: s_x and s_y from the low edges of the region in mm, squared
        distance from the vertex in mm^2. A disturbed bench has two more: factor of the screen's
        light, and counts of the room's light.
    weights : (step, 4) array
        Of `node_interpolation.cubic_weights`.
    axis : int
        0: the pattern runs along s_x, 1: along s_y.
    radius_mm : float
        Radius of the film's rim.
    side_mm : float
        Side of the pattern region.
    table : array, float, bool
        The fields of a `LevelTable`.
    scale : (4,) array
        Counts without light, counts of white above that, leak, full scale.
    loss : (W,) and (H,) arrays
        Vignetting: a column's part and a row's.
    noise : array, float, int
        `pixel_noise.normal_quantiles()`, standard deviation in counts, seed of this picture.
    added : array, int, int
        The fields of a `film_images.AddedLight`.
    out : (H, W) array
        The picture.
    start, stop : int
        Rows to fill.
    """
    step = weights.shape[0]
    width = out.shape[1]
    values, cell_mm, smooth = table
    leak = scale[2]
    radius2_mm2 = radius_mm * radius_mm
    # An array for each quantity, not rows of one: a view taken per pixel costs more than the pixel.
    line_x = np.empty(nodes.shape[2])
    line_y = np.empty(nodes.shape[2])
    line_r2 = np.empty(nodes.shape[2])
    light = np.empty(width)
    for row in range(start, stop):
        # Where the rays meet screen and film, in the columns of the nodes.
        interpolate_row(nodes, 0, row // step, weights[row % step], line_x)
        interpolate_row(nodes, 1, row // step, weights[row % step], line_y)
        interpolate_row(nodes, 2, row // step, weights[row % step], line_r2)
        for cell in range((width + step - 1) // step):
            for k in range(min(step, width - cell * step)):
                column = cell * step + k
                light[column] = BESIDE_FILM
                if interpolate_cubic(line_r2, cell, weights, k) <= radius2_mm2:
                    # The level of the pattern inside its region, the panel's leak beside it.
                    s_x_mm = interpolate_cubic(line_x, cell, weights, k)
                    s_y_mm = interpolate_cubic(line_y, cell, weights, k)
                    light[column] = leak
                    if 0.0 <= s_x_mm < side_mm and 0.0 <= s_y_mm < side_mm:
                        s_mm = s_x_mm
                        if axis == 1:
                            s_mm = s_y_mm
                        light[column] = _look_up_level(s_mm, values, cell_mm, smooth)
        expose_row(nodes, weights, row, light, scale, loss, noise, added, out)
