"""Turns the screen's light in one row of pixels into counts: the bench, the lens, further images,
noise, and the camera's converter.

The same for a pattern (`shade`) and for the pixels of a panel (`shade_panel`), which differ in
where a pixel's light comes from.
"""

import numpy as np

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.node_interpolation import interpolate_cubic, interpolate_row
from membrane_ctrl.sim.optics.pixel_noise import GOLDEN, LOW_16, MIX_1, random_64_bits

BESIDE_FILM = -1.0  # instead of a light: the pixel does not see the film


@compile_loop()
def expose_row(
    nodes: FloatArray,
    weights: FloatArray,
    row: int,
    light: FloatArray,
    scale: FloatArray,
    loss: tuple[FloatArray, FloatArray],
    noise: tuple[Singles, float, int],
    added: tuple[Singles, int, int],
    out: Pixels,
) -> None:
    """Fill one row of a picture.

    Parameters
    ----------
    nodes, weights, scale, loss, noise, added
        As in `shade.shade_rows`.
    row : int
        The row.
    light : (W,) array
        Light of the screen in each pixel, as a share of a white screen's; `BESIDE_FILM` beside the
        film.
    out : (H, W) array
        The picture.
    """
    step = weights.shape[0]
    width = out.shape[1]
    dark = scale[0]
    white = scale[1]
    full = scale[3]
    column_loss, row_loss = loss
    quantiles, sigma, seed = noise
    more, first_row, first_column = added

    # A disturbed bench: factor of the screen's light, and counts of the room's, at the nodes.
    disturbed = nodes.shape[0] > 3
    line_factor = np.empty(nodes.shape[2])
    line_room = np.empty(nodes.shape[2])
    if disturbed:
        interpolate_row(nodes, 3, row // step, weights[row % step], line_factor)
        interpolate_row(nodes, 4, row // step, weights[row % step], line_room)

    # The random numbers do not depend on how rows are shared between threads.
    state = np.uint64(seed) * MIX_1 + np.uint64(row) * np.uint64((width + 3) // 4) * GOLDEN
    bits = np.uint64(0)
    for cell in range((width + step - 1) // step):
        for k in range(min(step, width - cell * step)):
            column = cell * step + k
            counts = dark

            # On the film: what the bench does to the light, and the lens' vignetting.
            if light[column] >= 0.0:
                lit = light[column]
                if disturbed:
                    lit *= interpolate_cubic(line_factor, cell, weights, k)
                    counts += interpolate_cubic(line_room, cell, weights, k)
                counts += white * lit * (1.0 - column_loss[column] - row_loss[row])

            # Light of further images of the screen.
            i = row - first_row
            j = column - first_column
            if 0 <= i < more.shape[0] and 0 <= j < more.shape[1]:
                counts += more[i, j]

            # Noise: four 16-bit numbers from each 64-bit one.
            if sigma > 0.0:
                if column & 3 == 0:
                    state += GOLDEN
                    bits = random_64_bits(state)
                counts += sigma * quantiles[bits & LOW_16]
                bits >>= np.uint64(16)

            # The converter rounds, and clips at both ends.
            out[row, column] = min(max(counts + 0.5, 0.0), full)
