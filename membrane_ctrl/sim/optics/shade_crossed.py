"""Turns traced nodes into a picture of crossed fringes, in single precision.

The order lets the processor compute many pixels at a time: first all pixels that are k beyond their
node, then those at k + 1. A hold that tracks takes twenty such pictures a second.
"""

import numpy as np

from firmware_iface.roles import Pixels
from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.node_interpolation import interpolate_row
from membrane_ctrl.sim.optics.pixel_noise import GOLDEN, MIX_1, random_64_bits

_FLOAT = np.float32


@compile_loop(fastmath=True)
def _cosine_of_turns(turns: float) -> float:
    """Cosine of an angle in turns, to 2e-6."""
    t = turns - np.floor(turns + _FLOAT(0.5))
    u = t * t
    high = _FLOAT(60.1762543) + u * (_FLOAT(-26.0006905) + u * _FLOAT(6.57564783))
    middle = _FLOAT(64.9391632) + u * (_FLOAT(-85.4493332) + u * high)
    return _FLOAT(1.0) + u * (_FLOAT(-19.7392063) + u * middle)  # type: ignore[no-any-return]


@compile_loop(fastmath=True)
def _crossed_pixels(  # type: ignore[no-untyped-def]
    lines, weights, loss, noise, pattern, scale, levels, rooms, counts
):
    """Levels, room light and counts of the pixels (cells,) at one place between their nodes,
    `lines`, of a row.
    """
    w0, w1, w2, w3 = weights
    rate, first_x, first_y, half_mm, radius2_mm2 = pattern
    dark, white, leak, gamma, sigma, full, row_loss = scale
    one, none = _FLOAT(1.0), _FLOAT(0.0)
    for c in range(counts.size):
        x = w0 * lines[0, c] + w1 * lines[0, c + 1] + w2 * lines[0, c + 2] + w3 * lines[0, c + 3]
        y = w0 * lines[1, c] + w1 * lines[1, c + 1] + w2 * lines[1, c + 2] + w3 * lines[1, c + 3]
        r2 = w0 * lines[2, c] + w1 * lines[2, c + 1] + w2 * lines[2, c + 2] + w3 * lines[2, c + 3]
        level = _FLOAT(0.5) + _FLOAT(0.25) * (
            _cosine_of_turns(x * rate + first_x) + _cosine_of_turns(y * rate + first_y)
        )
        inside = (abs(x - half_mm) < half_mm) & (abs(y - half_mm) < half_mm)
        levels[c] = level if inside else none
        counts[c] = white if r2 <= radius2_mm2 else none
    if lines.shape[0] > 3:
        for c in range(counts.size):
            factor = (
                w0 * lines[3, c]
                + w1 * lines[3, c + 1]
                + w2 * lines[3, c + 2]
                + w3 * lines[3, c + 3]
            )
            room = (
                w0 * lines[4, c]
                + w1 * lines[4, c + 1]
                + w2 * lines[4, c + 2]
                + w3 * lines[4, c + 3]
            )
            rooms[c] = room if counts[c] > none else none
            counts[c] *= factor
    if gamma != one:  # a power costs ten times the rest, and does not go many at a time
        for c in range(counts.size):
            levels[c] = max(levels[c], none) ** gamma
    for c in range(counts.size):
        light = (leak + (one - leak) * levels[c]) * (one - loss[c] - row_loss)
        seen = dark + rooms[c] + counts[c] * light + sigma * noise[c] + _FLOAT(0.5)
        seen = seen if seen > none else none
        counts[c] = seen if seen < full else full


@compile_loop(nogil=True)
def shade_crossed_rows(
    nodes: FloatArray,  # as in `shade`
    weights: Singles,  # (4, step): of `cubic_weights`, transposed
    # periods per mm, phases of x and y at the low edge in turns, half a side of the region (mm),
    # the rim's radius^2
    pattern: tuple[float, ...],
    # counts without light, of white above that, leak, gamma, sigma of the noise, full scale
    scale: tuple[float, ...],
    loss: tuple[
        Singles, Singles
    ],  # vignetting (step, cells) of columns k + step * cell, and (H,) of rows
    noise: tuple[Singles, int],  # `noise_bank()`, seed of this picture
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows start to stop of `out` (H, W) with the picture of crossed fringes; its tuples hold
    single floats.
    """
    step, width = weights.shape[1], out.shape[1]
    column_loss, row_loss = loss
    cells = column_loss.shape[1]
    bank, seed = noise
    lines = np.empty((nodes.shape[0], nodes.shape[2]), np.float32)
    levels, rooms, counts = (
        np.empty(cells, np.float32),
        np.zeros(cells, np.float32),
        np.empty(cells, np.float32),
    )
    for row in range(start, stop):
        for k in range(nodes.shape[0]):
            interpolate_row(nodes, k, row // step, weights[:, row % step], lines[k])
        bits = random_64_bits(np.uint64(seed) * MIX_1 + np.uint64(row) * GOLDEN)
        first = int(bits % np.uint64(bank.size - step * cells))
        for k in range(step):
            own = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
            some = bank[first + k * cells : first + (k + 1) * cells]
            _crossed_pixels(
                lines,
                own,
                column_loss[k],
                some,
                pattern,
                (*scale, row_loss[row]),
                levels,
                rooms,
                counts,
            )
            for cell in range((width - k + step - 1) // step):
                out[row, cell * step + k] = np.int32(counts[cell])
