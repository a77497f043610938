"""Turns traced nodes into a picture of crossed fringes, in single precision.

Between nodes, `step` pixels apart, all quantities are interpolated by a cubic, as in `shade`. The
order lets the processor compute many pixels at a time: first all pixels that are k beyond their
node, then those at k + 1. A hold that tracks takes twenty such pictures a second.
"""

import numpy as np

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.node_interpolation import interpolate_row
from membrane_ctrl.sim.optics.pixel_noise import GOLDEN, MIX_1, random_64_bits

_FLOAT = np.float32


@compile_loop(fastmath=True)
def _cosine_of_turns(turns: float) -> float:
    """Cosine of an angle in turns, to 2e-6: a polynomial about the nearest whole turn."""
    t = turns - np.floor(turns + _FLOAT(0.5))
    u = t * t
    high = _FLOAT(60.1762543) + u * (_FLOAT(-26.0006905) + u * _FLOAT(6.57564783))
    middle = _FLOAT(64.9391632) + u * (_FLOAT(-85.4493332) + u * high)
    return _FLOAT(1.0) + u * (_FLOAT(-19.7392063) + u * middle)  # type: ignore[no-any-return]


@compile_loop(fastmath=True)
def _interpolate(lines, k, c, weights):  # type: ignore[no-untyped-def]
    """The cubic of quantity k through four neighbouring nodes of a row, from node c on."""
    w0, w1, w2, w3 = weights
    return w0 * lines[k, c] + w1 * lines[k, c + 1] + w2 * lines[k, c + 2] + w3 * lines[k, c + 3]


@compile_loop(fastmath=True)
def _crossed_pixels(  # type: ignore[no-untyped-def]
    lines, weights, loss, noise, pattern, scale, levels, rooms, counts
):
    """Counts of the pixels (cells,) at one place between their nodes, of a row.

    `lines` (3 or 5, nodes) are the quantities of `shade` at the row's nodes, `weights` (4) those of
    the place. `levels` and `rooms` (cells,) are memory for the screen's level and the room's light.
    """
    # Ternaries and `&` instead of branches: they keep the loops on vector units.
    rate, first_x, first_y, half_mm, radius2_mm2 = pattern
    dark, white, leak, gamma, sigma, full, row_loss = scale
    one = _FLOAT(1.0)
    none = _FLOAT(0.0)

    # The screen's level where the ray meets it, 0 beside the pattern; white on the film, else 0.
    for c in range(counts.size):
        x = _interpolate(lines, 0, c, weights)
        y = _interpolate(lines, 1, c, weights)
        r2 = _interpolate(lines, 2, c, weights)
        fringes = _cosine_of_turns(x * rate + first_x) + _cosine_of_turns(y * rate + first_y)
        level = _FLOAT(0.5) + _FLOAT(0.25) * fringes
        inside = (abs(x - half_mm) < half_mm) & (abs(y - half_mm) < half_mm)
        levels[c] = level if inside else none
        counts[c] = white if r2 <= radius2_mm2 else none

    # A disturbed bench: factor of the screen's light, and the room's light on the film.
    if lines.shape[0] > 3:
        for c in range(counts.size):
            factor = _interpolate(lines, 3, c, weights)
            room = _interpolate(lines, 4, c, weights)
            rooms[c] = room if counts[c] > none else none
            counts[c] *= factor

    # The screen's gamma: a power costs ten times the rest, and uses no vector units.
    if gamma != one:
        for c in range(counts.size):
            levels[c] = max(levels[c], none) ** gamma

    # Light, noise and the converter's range.
    for c in range(counts.size):
        light = (leak + (one - leak) * levels[c]) * (one - loss[c] - row_loss)
        seen = dark + rooms[c] + counts[c] * light + sigma * noise[c] + _FLOAT(0.5)
        seen = seen if seen > none else none
        counts[c] = seen if seen < full else full


@compile_loop(nogil=True)
def shade_crossed_rows(
    nodes: FloatArray,
    weights: Singles,
    pattern: tuple[float, ...],
    scale: tuple[float, ...],
    loss: tuple[Singles, Singles],
    noise: tuple[Singles, int],
    added: tuple[Singles, int, int],
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows of a picture of crossed fringes.

    Parameters
    ----------
    nodes : (3 or 5, rows, columns) array
        As in `shade.shade_rows`.
    weights : (4, step) array
        Of `node_interpolation.cubic_weights`, transposed.
    pattern : tuple of single floats
        Periods per mm, phases of x and y at the low edge in turns, half a side of the region in mm,
        square of the rim's radius.
    scale : tuple of single floats
        Counts without light, counts of white above that, leak, gamma, standard deviation of the
        noise in counts, full scale.
    loss : (step, cells) and (H,) arrays
        Vignetting of the columns k + step * cell, and of the rows.
    noise : array, int
        `pixel_noise.noise_bank()`, and the seed of this picture.
    added : array, int, int
        The fields of a `film_images.AddedLight`.
    out : (H, W) array
        The picture.
    start, stop : int
        Rows to fill.
    """
    step = weights.shape[1]
    width = out.shape[1]
    column_loss, row_loss = loss
    cells = column_loss.shape[1]
    bank, seed = noise
    more, first_row, first_column = added
    full = scale[-1]
    lines = np.empty((nodes.shape[0], nodes.shape[2]), np.float32)
    levels = np.empty(cells, np.float32)
    rooms = np.zeros(cells, np.float32)
    counts = np.empty(cells, np.float32)
    for row in range(start, stop):
        # The quantities at the row's nodes.
        for k in range(nodes.shape[0]):
            interpolate_row(nodes, k, row // step, weights[:, row % step], lines[k])
        # Noise from a random place of the bank.
        bits = random_64_bits(np.uint64(seed) * MIX_1 + np.uint64(row) * GOLDEN)
        first = int(bits % np.uint64(bank.size - step * cells))
        # All pixels that are k beyond their node.
        for k in range(step):
            own_weights = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
            own_noise = bank[first + k * cells : first + (k + 1) * cells]
            _crossed_pixels(
                lines,
                own_weights,
                column_loss[k],
                own_noise,
                pattern,
                (*scale, row_loss[row]),
                levels,
                rooms,
                counts,
            )
            for cell in range((width - k + step - 1) // step):
                out[row, cell * step + k] = np.int32(counts[cell])

        # Light of further images of the screen.
        i = row - first_row
        if 0 <= i < more.shape[0]:
            for j in range(more.shape[1]):
                seen = out[row, first_column + j] + more[i, j] + _FLOAT(0.5)
                out[row, first_column + j] = np.int32(min(seen, full))
