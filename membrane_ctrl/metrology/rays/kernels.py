"""Compiled loops over points: ray to surface, surface to screen, sums for the least squares.

Lengths are in mm; x and y in the polynomials are divided by the radius. A point is a ray from the
pinhole, P = F + t d, and what the camera saw there, a screen point S. All loops are linear in the
number of points and work on a range of them, [start, stop), so that threads can share them.
Derivation: sections 3 to 5 of docs/explanation/metrology.md.

Arguments shared by the loops:

- `rays` (3, n): unit vectors d,
- `t` (n,): their lengths to the surface, which Newton steps update in place,
- `screen` (2, n): s_x and s_y of the screen points,
- `pinhole` (3,): F,
- `plane` (4, 3): O', s_x, s_y and the normal of the screen,
- `face`: the `Face` that deviates from that plane,
- `poly` (degree + 1, degree + 1): the Zernike part as a polynomial,
- `excess` (15,) and `amplitude`: the Hencky excess of unit RMS, and its size,
- `radius`, `vertex_z`: of the Zernike disc; height of the vertex.
"""

import math

import numpy as np

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.numerics.compiled import compile_kernel, compile_step
from membrane_ctrl.metrology.rays import screen_face
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE

FACE_STEPS = 6  # see `_onto_face`
_BLOCK = 256  # points whose intermediate values stay in the first-level cache

# Numbers that `residual_sums` returns: moments x^p y^q, p + q < degree, of r_x and of r_y, then two
# for the excess, sum w r_x^2, sum w r_y^2 and sum w.
SLOPE_MONOMIALS = ZERNIKE_DEGREE * (ZERNIKE_DEGREE + 1) // 2
SUMS = 2 * SLOPE_MONOMIALS + 5
_EXCESS_SUMS = 2 * SLOPE_MONOMIALS  # where the last five begin

# Numbers that `product_sums` returns: moments x^p y^q, p + q <= PRODUCT_DEGREE, then those of the
# excess' slopes along x and y, and their two squares.
PRODUCT_DEGREE = 2 * (ZERNIKE_DEGREE - 1)
PRODUCT_MONOMIALS = (PRODUCT_DEGREE + 1) * (PRODUCT_DEGREE + 2) // 2
PRODUCTS = PRODUCT_MONOMIALS + 2 * SLOPE_MONOMIALS + 2


@compile_step
def evaluate_surface(poly, excess, amplitude, x, y):  # type: ignore[no-untyped-def]
    """Height, dh/dx, dh/dy and the excess' own de/dv, v = x^2 + y^2, at a point in radii.

    Slopes are per radius. Horner's rule gives value and derivative in one pass.
    """
    # The Zernike part: each row is a polynomial in y, and their sum one in x.
    h = 0.0
    hx = 0.0
    hy = 0.0
    for i in range(ZERNIKE_DEGREE, -1, -1):
        row = 0.0
        slope = 0.0
        for j in range(ZERNIKE_DEGREE - i, -1, -1):
            slope = slope * y + row
            row = row * y + poly[i, j]
        hx = hx * x + h
        h = h * x + row
        hy = hy * x + slope

    # The excess, a power series in v: its slopes are 2 x e'(v) and 2 y e'(v).
    v = x * x + y * y
    e = 0.0
    ev = 0.0
    for k in range(hencky_bowl.EXCESS_TERMS - 1, -1, -1):
        ev = ev * v + e
        e = e * v + excess[k]
    h += amplitude * e
    hx += 2 * amplitude * ev * x
    hy += 2 * amplitude * ev * y
    return h, hx, hy, ev


@compile_kernel
def _load_block(rays, t, first, count, block):  # type: ignore[no-untyped-def]
    """Copy some rays into `block`: rows d_x, d_y, d_z, t."""
    for p in range(count):
        block[0, p] = rays[0, first + p]
        block[1, p] = rays[1, first + p]
        block[2, p] = rays[2, first + p]
        block[3, p] = t[first + p]


@compile_kernel
def _newton_step(block, count, pinhole, poly, excess, amplitude, radius, vertex_z):  # type: ignore[no-untyped-def]
    """One Newton step on F_z + t d_z = vertex_z + h(x, y); rows of `block` are d_x, d_y, d_z, t.

    The derivative along the ray is d_z - h_x d_x - h_y d_y: never 0 for a ray that is steeper than
    the film.
    """
    fx, fy, fz = pinhole[0], pinhole[1], pinhole[2]
    for p in range(count):
        dx, dy, dz, t = block[0, p], block[1, p], block[2, p], block[3, p]
        x = (fx + t * dx) / radius
        y = (fy + t * dy) / radius
        h, hx, hy, _ev = evaluate_surface(poly, excess, amplitude, x, y)
        above = fz + t * dz - vertex_z - h
        approach = dz - (hx * dx + hy * dy) / radius
        block[3, p] = t - above / approach


@compile_kernel
def intersect_surface(  # type: ignore[no-untyped-def]
    rays, t, pinhole, poly, excess, amplitude, radius, vertex_z, newton, start, stop
):
    """Newton steps towards the surface, in place in `t`."""
    block = np.empty((4, _BLOCK))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _load_block(rays, t, first, count, block)
        for _ in range(newton):
            _newton_step(block, count, pinhole, poly, excess, amplitude, radius, vertex_z)
        t[first : first + count] = block[3, :count]


@compile_step
def bisector_slopes(dx, dy, dz, qx, qy, qz):  # type: ignore[no-untyped-def]
    """Slopes of the mirror that turns the ray d towards q.

    Its normal n ~ q / |q| - d halves the angle between -d and q; dh/dx = -n_x / n_z.
    """
    scale = 1 / math.sqrt(qx * qx + qy * qy + qz * qz)
    nx = qx * scale - dx
    ny = qy * scale - dy
    nz = qz * scale - dz
    return -nx / nz, -ny / nz


@compile_step
def measured_slope(rays, t, screen, w, pinhole, plane, p):  # type: ignore[no-untyped-def]
    """x, y and both measured slopes at point p; the screen point is w off the plane."""
    # P = F + t d on the film
    dx, dy, dz = rays[0, p], rays[1, p], rays[2, p]
    x = pinhole[0] + t[p] * dx
    y = pinhole[1] + t[p] * dy
    z = pinhole[2] + t[p] * dz

    # S - P with S = O' + a s_x + b s_y + w n on the screen
    a, b = screen[0, p], screen[1, p]
    qx = plane[0, 0] + a * plane[1, 0] + b * plane[2, 0] + w * plane[3, 0] - x
    qy = plane[0, 1] + a * plane[1, 1] + b * plane[2, 1] + w * plane[3, 1] - y
    qz = plane[0, 2] + a * plane[1, 2] + b * plane[2, 2] + w * plane[3, 2] - z
    gx, gy = bisector_slopes(dx, dy, dz, qx, qy, qz)
    return x, y, gx, gy


@compile_kernel
def _look_up_face(screen, face, first, count, out):  # type: ignore[no-untyped-def]
    """Deviation of the face at some points, in a separate loop: a look-up prevents vector
    instructions.
    """
    if screen_face.is_plane(face):
        out[:count] = 0.0
        return
    for k in range(count):
        out[k], _wa, _wb = screen_face.face_height(face, screen[0, first + k], screen[1, first + k])


@compile_kernel
def _add_moments(values, x, powers_y, count, sums, first):  # type: ignore[no-untyped-def]
    """Add the sums over points of values x^p y^q, p + q < rows of `powers_y`, from sums[first] on.

    p is the outer power. `values` does not survive: it is multiplied by x from power to power.
    """
    k = first
    size = powers_y.shape[0]
    for i in range(size):
        for j in range(size - i):
            total = 0.0
            for p in range(count):
                total += values[p] * powers_y[j, p]
            sums[k] += total
            k += 1
        for p in range(count):
            values[p] *= x[p]


@compile_kernel
def _compute_powers(y, powers_y, count):  # type: ignore[no-untyped-def]
    """Powers 1, y, y^2, ... of each point, a row each."""
    for p in range(count):
        powers_y[0, p] = 1.0
    for j in range(1, powers_y.shape[0]):
        for p in range(count):
            powers_y[j, p] = powers_y[j - 1, p] * y[p]


@compile_kernel
def residual_sums(  # type: ignore[no-untyped-def]
    rays, t, screen, weights, pinhole, plane, face, poly, excess, amplitude, radius, start, stop
):
    """Moments of the weighted slope residual r = g - D a: all that the right-hand side of the least
    squares needs.

    Returns (SUMS,): sum w r_x x^p y^q (SLOPE_MONOMIALS), as many of r_y, sum w r_x x e'(v) and sum
    w r_y y e'(v) for the excess, sum w r_x^2, sum w r_y^2, sum w.
    """
    sums = np.zeros(SUMS)
    block = np.empty((5, _BLOCK))
    xs, ys, rx, ry, off = block[0], block[1], block[2], block[3], block[4]
    powers_y = np.empty((ZERNIKE_DEGREE, _BLOCK))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        x_excess = 0.0
        y_excess = 0.0
        x_square = 0.0
        y_square = 0.0
        w_sum = 0.0
        # The residual of each point, measured less fitted slope, times its weight.
        _look_up_face(screen, face, first, count, off)
        for k in range(count):
            x, y, gx, gy = measured_slope(rays, t, screen, off[k], pinhole, plane, first + k)
            xs[k] = x / radius
            ys[k] = y / radius
            _h, hx, hy, ev = evaluate_surface(poly, excess, amplitude, xs[k], ys[k])
            w = weights[first + k]
            ax = gx - hx / radius
            ay = gy - hy / radius
            rx[k] = w * ax
            ry[k] = w * ay
            x_excess += rx[k] * xs[k] * ev
            y_excess += ry[k] * ys[k] * ev
            x_square += rx[k] * ax
            y_square += ry[k] * ay
            w_sum += w
        sums[_EXCESS_SUMS] += x_excess
        sums[_EXCESS_SUMS + 1] += y_excess
        sums[_EXCESS_SUMS + 2] += x_square
        sums[_EXCESS_SUMS + 3] += y_square
        sums[_EXCESS_SUMS + 4] += w_sum

        # Its moments.
        _compute_powers(ys, powers_y, count)
        _add_moments(rx, xs, powers_y, count, sums, 0)
        _add_moments(ry, xs, powers_y, count, sums, SLOPE_MONOMIALS)
    return sums


@compile_kernel
def product_sums(rays, t, weights, pinhole, excess, radius, start, stop):  # type: ignore[no-untyped-def]
    """Moments from which the normal matrix is made.

    Returns (PRODUCTS,): sum w x^p y^q of PRODUCT_MONOMIALS, sum w e' x x^p y^q and sum w e' y x^p
    y^q with SLOPE_MONOMIALS each, sum w (e' x)^2, sum w (e' y)^2.
    """
    sums = np.zeros(PRODUCTS)
    block = np.empty((5, _BLOCK))
    xs, ys, ws, ex, ey = block[0], block[1], block[2], block[3], block[4]
    powers_y = np.empty((PRODUCT_DEGREE + 1, _BLOCK))
    flat = np.zeros((ZERNIKE_DEGREE + 1, ZERNIKE_DEGREE + 1))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        for k in range(count):
            p = first + k
            xs[k] = (pinhole[0] + t[p] * rays[0, p]) / radius
            ys[k] = (pinhole[1] + t[p] * rays[1, p]) / radius
            _h, _hx, _hy, ev = evaluate_surface(flat, excess, 0.0, xs[k], ys[k])
            ws[k] = weights[p]
            ex[k] = weights[p] * ev * xs[k]
            ey[k] = weights[p] * ev * ys[k]
            sums[PRODUCTS - 2] += ex[k] * ev * xs[k]
            sums[PRODUCTS - 1] += ey[k] * ev * ys[k]
        _compute_powers(ys, powers_y, count)
        _add_moments(ws, xs, powers_y, count, sums, 0)
        _add_moments(ex, xs, powers_y[:ZERNIKE_DEGREE], count, sums, PRODUCT_MONOMIALS)
        _add_moments(
            ey, xs, powers_y[:ZERNIKE_DEGREE], count, sums, PRODUCT_MONOMIALS + SLOPE_MONOMIALS
        )
    return sums


@compile_kernel
def slope_field(  # type: ignore[no-untyped-def]
    rays, t, screen, pinhole, plane, face, poly, excess, amplitude, radius, out, start, stop
):
    """x, y, measured g_x, g_y and fitted h_x, h_y of each point into `out` (6, n)."""
    off = np.empty(_BLOCK)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _look_up_face(screen, face, first, count, off)
        for k in range(count):
            p = first + k
            x, y, gx, gy = measured_slope(rays, t, screen, off[k], pinhole, plane, p)
            _h, hx, hy, _ev = evaluate_surface(poly, excess, amplitude, x / radius, y / radius)
            out[0, p] = x
            out[1, p] = y
            out[2, p] = gx
            out[3, p] = gy
            out[4, p] = hx / radius
            out[5, p] = hy / radius


@compile_kernel
def predict_screen(  # type: ignore[no-untyped-def]
    rays, t, pinhole, plane, face, poly, excess, amplitude, radius, out, start, stop
):
    """Where the surface sends each ray on the screen: s_x and s_y into `out` (2, n).

    The points must be on the surface.
    """
    tangents = np.empty((2, _BLOCK))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        for k in range(count):
            p = first + k
            # P = F + t d on the film, and the film's normal n = (n_x, n_y, 1) there
            dx, dy, dz = rays[0, p], rays[1, p], rays[2, p]
            x = pinhole[0] + t[p] * dx
            y = pinhole[1] + t[p] * dy
            z = pinhole[2] + t[p] * dz
            _h, hx, hy, _ev = evaluate_surface(poly, excess, amplitude, x / radius, y / radius)
            nx, ny = -hx / radius, -hy / radius

            # u = d - 2 (d n) / (n n) n
            turn = 2 * (dx * nx + dy * ny + dz) / (nx * nx + ny * ny + 1)
            ux, uy, uz = dx - turn * nx, dy - turn * ny, dz - turn

            # S = P + k u on the screen's plane, with N its normal: k = N (O' - P) / (N u)
            across = 1 / (ux * plane[3, 0] + uy * plane[3, 1] + uz * plane[3, 2])
            ox, oy, oz = plane[0, 0] - x, plane[0, 1] - y, plane[0, 2] - z
            reach = (ox * plane[3, 0] + oy * plane[3, 1] + oz * plane[3, 2]) * across

            # S - O' along s_x and s_y
            fx, fy, fz = reach * ux - ox, reach * uy - oy, reach * uz - oz
            out[0, p] = fx * plane[1, 0] + fy * plane[1, 1] + fz * plane[1, 2]
            out[1, p] = fx * plane[2, 0] + fy * plane[2, 1] + fz * plane[2, 2]

            # Tangents of the angles between u and N along s_x and s_y
            tangents[0, k] = (ux * plane[1, 0] + uy * plane[1, 1] + uz * plane[1, 2]) * across
            tangents[1, k] = (ux * plane[2, 0] + uy * plane[2, 1] + uz * plane[2, 2]) * across
        _onto_face(out, tangents, face, first, count)


@compile_kernel
def _onto_face(out, tangents, face, first, count):  # type: ignore[no-untyped-def]
    """Move points from where rays cross the plane to where they meet the face.

    Newton's steps on w = face(s + w tangent): w <- w - (w - face) / (1 - tangent grad face). A step
    leaves the square of the error times the face's curvature: the error is rounding after three
    steps for 1 mm of bow 200 mm wide, and after four or five for a map of a few millimetres.
    """
    if screen_face.is_plane(face):
        return
    for k in range(count):
        a, b, ta, tb = out[0, first + k], out[1, first + k], tangents[0, k], tangents[1, k]
        w = 0.0
        for _ in range(FACE_STEPS):
            height, wa, wb = screen_face.face_height(face, a + w * ta, b + w * tb)
            w -= (w - height) / (1 - wa * ta - wb * tb)
        out[0, first + k] = a + w * ta
        out[1, first + k] = b + w * tb
