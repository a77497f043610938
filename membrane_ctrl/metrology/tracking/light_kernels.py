"""Compiled loops over the bins of a crossed frame: light, its derivatives, and the residual."""

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.metrology.numerics.fast_cosine import cos_sin
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.tracking.bin_cells import (
    BLOCK_BINS,
    BLOCK_CELLS,
    CELL_BINS,
    combine_planes,
    compute_moments,
    project_planes,
    spread_planes,
)

_AT = (
    0,
    PARAMETERS,
    2 * PARAMETERS,
    2 * PARAMETERS,
    2 * PARAMETERS,
)  # in `Cells.blocks`: x, y, then the maps' terms
# Share of the reach within which weights are 1. Where they fall from the start, as Tukey's do, they
# differ between bright and dark fringes as soon as light wanders, and bend the figure: 20 nm of sag
# at 0.5 %.
_TRUSTED = np.float32(0.6)


@compile_kernel
def _compute_light(rows, base, light, response, begin):  # type: ignore[no-untyped-def]
    """Derivatives of the light of a block's bins, as in `light_waves`, in place of the changes of
    phases and maps.
    """
    one, two, half = np.float32(1), np.float32(2), np.float32(0.5)
    for k in range(BLOCK_BINS):
        p = begin + k
        cx, sx = cos_sin(base[0, p] + rows[k])
        cy, sy = cos_sin(base[1, p] + rows[BLOCK_BINS + k])
        level = light[0, p] * rows[2 * BLOCK_BINS + k]
        swing_x, swing_y = (
            light[1, p] * rows[3 * BLOCK_BINS + k],
            light[2, p] * rows[4 * BLOCK_BINS + k],
        )
        shade = half + half * half * (cx + cy)
        power, slope, bent = shade, np.float32(0), np.float32(0)
        for j in range(4):
            slope += response[j] * (np.float32(j + 2) * power - one)
            power *= shade
            bent += response[j] * (power - shade)
        cx, cy, steeper = cx + two * bent, cy + two * bent, half * (swing_x + swing_y) * slope
        rows[k] = -(swing_x + steeper) * sx
        rows[BLOCK_BINS + k] = -(swing_y + steeper) * sy
        rows[2 * BLOCK_BINS + k] = light[0, p]
        rows[3 * BLOCK_BINS + k] = light[1, p] * cx
        rows[4 * BLOCK_BINS + k] = light[2, p] * cy
        rows[5 * BLOCK_BINS + k] = level + swing_x * cx + swing_y * cy


@compile_kernel
def _weigh_derivatives(rows, edge, gain, seen, reach, begin):  # type: ignore[no-untyped-def]
    """Turn what `_compute_light` leaves into e w r times the derivatives (5 rows), then `out` of
    `light_left` (4 rows).
    """
    zero, one = np.float32(0), np.float32(1)
    for k in range(BLOCK_BINS):
        p = begin + k
        shown = rows[5 * BLOCK_BINS + k]
        r = seen[p] - gain[p] * shown
        far = max(abs(r) / reach[p] - _TRUSTED, zero) / (one - _TRUSTED) if reach[p] > zero else one
        w = (one - min(far, one) ** 2) ** 2
        left = w * r * edge[p] * gain[p]
        for j in range(5):
            rows[j * BLOCK_BINS + k] *= left
        rows[5 * BLOCK_BINS + k] = r
        rows[6 * BLOCK_BINS + k] = w
        rows[7 * BLOCK_BINS + k] = left * shown
        rows[8 * BLOCK_BINS + k] = w * edge[p] * shown * shown


@compile_kernel
def _compute_block(b, base, light, slow, offset, response, changes, shifts, planes, rows):  # type: ignore[no-untyped-def]
    """`_compute_light` of block b."""
    squares = rows.reshape(-1, CELL_BINS, BLOCK_CELLS)
    for k in range(5):
        at, factors = _AT[k], changes[max(k - 1, 0)]
        combine_planes(
            slow[b, at : at + factors.size], factors, shifts[k] if k < 2 else np.float32(1), planes
        )
        spread_planes(planes, offset[b], squares[k])
    _compute_light(rows, base, light, response, b * BLOCK_BINS)


@compile_kernel
def light_waves(base, light, slow, offset, response, changes, shifts, out):  # type: ignore[no-untyped-def]
    """Derivatives (6, n) of the light of n bins by phi_x, phi_y and relative changes of A, B_x, B_y
    and of all.

    Arguments as in `light_left`.
    """
    rows, planes = np.empty(6 * BLOCK_BINS, np.float32), np.empty(3 * BLOCK_CELLS, np.float32)
    for b in range(offset.shape[0]):
        _compute_block(b, base, light, slow, offset, response, changes, shifts, planes, rows)
        out[:, b * BLOCK_BINS : (b + 1) * BLOCK_BINS] = rows.reshape(6, BLOCK_BINS)


@compile_kernel
def light_left(  # type: ignore[no-untyped-def]
    base, light, slow, offset, response, changes, shifts, edge, gain, seen, reach, right, out
):
    """Residual r and weight w of n bins in `out` (4, n), with e w r times the derivative by a
    relative change of all light and e w times its square; and in `right` (4, parameters) the sums
    of e w r times the derivatives by `changes`.

    `base` (2, n) are phases and `light` (3, n) A, B_x, B_y. They change by `shifts` (2,) and by
    `changes` (4, parameters), of the surface's parameters and of the maps of A, B_x, B_y, times
    `slow`, as in `Cells.blocks`; `offset` as in `Cells`. `edge` (n,) is e, `gain` (n,) multiplies
    all light, `reach` (n,) is where w ends; 0 leaves out. All but `right` are of single precision
    and without gaps, or no vector units are used.
    """
    rows, planes = np.empty(9 * BLOCK_BINS, np.float32), np.empty(3 * BLOCK_CELLS, np.float32)
    squares = rows.reshape(-1, CELL_BINS, BLOCK_CELLS)
    right[:] = 0
    for b in range(offset.shape[0]):
        _compute_block(b, base, light, slow, offset, response, changes, shifts, planes, rows)
        _weigh_derivatives(rows, edge, gain, seen, reach, b * BLOCK_BINS)
        out[:, b * BLOCK_BINS : (b + 1) * BLOCK_BINS] = rows.reshape(9, BLOCK_BINS)[5:]
        for k in range(5):
            at, sums = _AT[k], right[max(k - 1, 0)]
            compute_moments(squares[k], offset[b], planes)
            project_planes(slow[b, at : at + sums.size], planes, sums)
