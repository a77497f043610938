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

# Where the planes of phi_x, phi_y and of the three maps of light begin in `Cells.arrange_blocks`.
_FIRST_PLANE = (0, PARAMETERS, 2 * PARAMETERS, 2 * PARAMETERS, 2 * PARAMETERS)
# Share of the reach within which weights are 1. If they fall from 0 on, as Tukey's do, they differ
# between bright and dark fringes as soon as the light changes slowly, and bend the figure: 20 nm of
# sag at 0.5 %.
_FULL_WEIGHT = np.float32(0.6)
_RESPONSE_TERMS = 4  # of the response of panel and camera


@compile_kernel
def _compute_light(rows, base, light, response, begin):  # type: ignore[no-untyped-def]
    """Light of a block's bins and its derivatives, as in `light_waves`, from changes of phases and
    maps.

    `rows` holds 5 rows of BLOCK_BINS: the changes of phi_x and phi_y, and the factors of A, B_x and
    B_y. They are replaced by 6 rows of derivatives.
    """
    # Literals of double precision would make every operation double.
    one = np.float32(1)
    two = np.float32(2)
    half = np.float32(0.5)
    for k in range(BLOCK_BINS):
        p = begin + k

        # Fringes of x and y, with the light of this frame: level and swings.
        cx, sx = cos_sin(base[0, p] + rows[k])
        cy, sy = cos_sin(base[1, p] + rows[BLOCK_BINS + k])
        level = light[0, p] * rows[2 * BLOCK_BINS + k]
        swing_x = light[1, p] * rows[3 * BLOCK_BINS + k]
        swing_y = light[2, p] * rows[4 * BLOCK_BINS + k]

        # What the response adds to the shade u, from 0 to 1, and the slope of that by u: the sum
        # of r_j (u^(j + 2) - u), j from 0, which is 0 at black and at white. The shade of crossed
        # fringes is 1/2 + (cos x + cos y) / 4.
        shade = half + half * half * (cx + cy)
        power = shade
        slope = np.float32(0)
        bent = np.float32(0)
        for j in range(_RESPONSE_TERMS):
            slope += response[j] * (np.float32(j + 2) * power - one)
            power *= shade
            bent += response[j] * (power - shade)

        # Both axes share it equally, so that each phase also changes the other axis' fringes, by
        # the slope.
        cx = cx + two * bent
        cy = cy + two * bent
        steeper = half * (swing_x + swing_y) * slope

        # Derivatives by both phases, level and swings; and the light A + B_x cos x + B_y cos y.
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
    zero = np.float32(0)
    one = np.float32(1)
    for k in range(BLOCK_BINS):
        # The residual: what the frame shows, less the light with the gain of its row.
        p = begin + k
        shown = rows[5 * BLOCK_BINS + k]
        r = seen[p] - gain[p] * shown

        # The weight: 1 up to a share of the reach, then falling to 0 at the reach.
        beyond = max(abs(r) / reach[p] - _FULL_WEIGHT, zero)
        far = beyond / (one - _FULL_WEIGHT)
        far = far if reach[p] > zero else one
        w = (one - min(far, one) ** 2) ** 2

        # The weighted residual times each derivative, and what the light's own unknowns need.
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
    # phi_x and phi_y share the surface's parameters, changes[0]; then follow the maps of A, B_x and
    # B_y, whose factors begin at 1.
    for k in range(5):
        first = _FIRST_PLANE[k]
        factors = changes[max(k - 1, 0)]
        level = shifts[k] if k < 2 else np.float32(1)
        combine_planes(slow[b, first : first + factors.size], factors, level, planes)
        spread_planes(planes, offset[b], squares[k])
    _compute_light(rows, base, light, response, b * BLOCK_BINS)


@compile_kernel
def light_waves(base, light, slow, offset, response, changes, shifts, out):  # type: ignore[no-untyped-def]
    """Derivatives of the light of n bins.

    Parameters
    ----------
    base, light, slow, offset, response, changes, shifts
        As in `light_left`.
    out : (6, n) array
        Gets the derivatives by phi_x and phi_y, by relative changes of A, B_x and B_y, and by one
        of all light.
    """
    rows = np.empty(6 * BLOCK_BINS, np.float32)
    planes = np.empty(3 * BLOCK_CELLS, np.float32)
    for b in range(offset.shape[0]):
        _compute_block(b, base, light, slow, offset, response, changes, shifts, planes, rows)
        begin = b * BLOCK_BINS
        out[:, begin : begin + BLOCK_BINS] = rows.reshape(6, BLOCK_BINS)


@compile_kernel
def light_left(  # type: ignore[no-untyped-def]
    base, light, slow, offset, response, changes, shifts, edge, gain, seen, reach, right, out
):
    """Residual and weight of n bins, and the right-hand side of the least squares.

    All arrays but `right` are of single precision and without gaps, or no vector units are used.

    Parameters
    ----------
    base : (2, n) array
        Phases of x and y.
    light : (3, n) array
        A, B_x and B_y.
    slow, offset : arrays
        As in `Cells.arrange_blocks` and `Cells`: changes of phases and light, a plane over each
        cell.
    response : (4,) array
        Response of panel and camera.
    changes : (4, parameters) array
        Of the surface's parameters, and of the maps of A, B_x and B_y; factors of `slow`.
    shifts : (2,) array
        Change of all phases of x and of y.
    edge : (n,) array
        Factor e of a bin's weight.
    gain : (n,) array
        Factor of all light.
    seen : (n,) array
        Light of the frame.
    reach : (n,) array
        Residual at which the weight w ends; 0 leaves the bin out.
    right : (4, parameters) array
        Gets the sums of e w r times the derivatives by `changes`.
    out : (4, n) array
        Gets r, w, e w r times the derivative by a relative change of all light, and e w times the
        square of that derivative.
    """
    rows = np.empty(9 * BLOCK_BINS, np.float32)
    planes = np.empty(3 * BLOCK_CELLS, np.float32)
    squares = rows.reshape(-1, CELL_BINS, BLOCK_CELLS)
    right[:] = 0

    # A block of bins at a time: its light, its residual, and the sums for the right-hand side.
    for b in range(offset.shape[0]):
        begin = b * BLOCK_BINS
        _compute_block(b, base, light, slow, offset, response, changes, shifts, planes, rows)
        _weigh_derivatives(rows, edge, gain, seen, reach, begin)
        out[:, begin : begin + BLOCK_BINS] = rows.reshape(9, BLOCK_BINS)[5:]

        # J^T W r: the moments of each row over the cells, times the planes of its parameters.
        for k in range(5):
            first = _FIRST_PLANE[k]
            sums = right[max(k - 1, 0)]
            compute_moments(squares[k], offset[b], planes)
            project_planes(slow[b, first : first + sums.size], planes, sums)
