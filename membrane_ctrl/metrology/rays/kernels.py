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

FACE_STEPS = 6  # see `_move_to_face`
_BLOCK = 256  # points whose intermediate values stay in the first-level cache

# Rows of `plane`.
_ORIGIN = 0
_S_X = 1
_S_Y = 2
_NORMAL = 3

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
    """Height and slopes of the surface at a point.

    Horner's rule gives value and derivative in one pass.

    Parameters
    ----------
    poly, excess, amplitude
        See the module.
    x, y : float
        In radii.

    Returns
    -------
    h, hx, hy, ev : float
        Height, dh/dx and dh/dy per radius, and the excess' own de/dv, v = x^2 + y^2.
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
    fx = pinhole[0]
    fy = pinhole[1]
    fz = pinhole[2]
    for p in range(count):
        # The surface where the ray is, above the same x and y.
        dx = block[0, p]
        dy = block[1, p]
        dz = block[2, p]
        t = block[3, p]
        x = (fx + t * dx) / radius
        y = (fy + t * dy) / radius
        h, hx, hy, _ev = evaluate_surface(poly, excess, amplitude, x, y)

        # t <- t - f / f', with f the height of the ray over the surface.
        above = fz + t * dz - vertex_z - h
        approach = dz - (hx * dx + hy * dy) / radius
        block[3, p] = t - above / approach


@compile_kernel
def intersect_surface(  # type: ignore[no-untyped-def]
    rays, t, pinhole, poly, excess, amplitude, radius, vertex_z, newton, start, stop
):
    """Newton steps towards the surface, in place in `t`.

    Parameters
    ----------
    rays, t, pinhole, poly, excess, amplitude, radius, vertex_z, start, stop
        See the module.
    newton : int
        Number of steps.
    """
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

    Its normal n ~ q / |q| - d halves the angle between -d and q; dh/dx = -n_x / n_z (section 3
    of docs/explanation/metrology.md).

    Parameters
    ----------
    dx, dy, dz : float
        Unit vector d of the ray.
    qx, qy, qz : float
        From the point to the screen, of any length.

    Returns
    -------
    gx, gy : float
    """
    scale = 1 / math.sqrt(qx * qx + qy * qy + qz * qz)
    nx = qx * scale - dx
    ny = qy * scale - dy
    nz = qz * scale - dz
    return -nx / nz, -ny / nz


@compile_step
def component_along(vx, vy, vz, axes, row):  # type: ignore[no-untyped-def]
    """Scalar product of a vector with a row of `axes`.

    Parameters
    ----------
    vx, vy, vz : float
    axes : (k, 3) array
    row : int
    """
    return vx * axes[row, 0] + vy * axes[row, 1] + vz * axes[row, 2]


@compile_step
def _film_point(rays, t, pinhole, p):  # type: ignore[no-untyped-def]
    """P = F + t d of ray p."""
    x = pinhole[0] + t[p] * rays[0, p]
    y = pinhole[1] + t[p] * rays[1, p]
    z = pinhole[2] + t[p] * rays[2, p]
    return x, y, z


@compile_step
def _screen_coordinate(plane, axis, a, b, w):  # type: ignore[no-untyped-def]
    """World coordinate `axis` of the screen point S = O' + a s_x + b s_y + w n."""
    in_plane = plane[_ORIGIN, axis] + a * plane[_S_X, axis] + b * plane[_S_Y, axis]
    return in_plane + w * plane[_NORMAL, axis]


@compile_step
def measured_slope(rays, t, screen, w, pinhole, plane, p):  # type: ignore[no-untyped-def]
    """Slopes that the mirror must have at point p, so that the camera sees there what it saw.

    Parameters
    ----------
    rays, t, screen, pinhole, plane
        See the module.
    w : float
        Deviation of the screen's face from its plane at that screen point.
    p : int
        Number of the point.

    Returns
    -------
    x, y, gx, gy : float
        Place on the mirror, and both slopes.
    """
    # From P on the film to S on the screen.
    x, y, z = _film_point(rays, t, pinhole, p)
    a = screen[0, p]
    b = screen[1, p]
    qx = _screen_coordinate(plane, 0, a, b, w) - x
    qy = _screen_coordinate(plane, 1, a, b, w) - y
    qz = _screen_coordinate(plane, 2, a, b, w) - z

    # The mirror there turns the ray d into that direction.
    gx, gy = bisector_slopes(rays[0, p], rays[1, p], rays[2, p], qx, qy, qz)
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

    Section 4 of docs/explanation/metrology.md.

    Parameters
    ----------
    rays, t, screen, pinhole, plane, face, poly, excess, amplitude, radius, start, stop
        See the module.
    weights : (n,) array
        w.

    Returns
    -------
    (SUMS,) array
        sum w r_x x^p y^q (SLOPE_MONOMIALS), as many of r_y, sum w r_x x e'(v) and sum w r_y y
        e'(v) for the excess, sum w r_x^2, sum w r_y^2, sum w.
    """
    sums = np.zeros(SUMS)
    # Memory of a block: x, y, weighted residuals of both slopes, deviation of the face.
    block = np.empty((5, _BLOCK))
    xs = block[0]
    ys = block[1]
    rx = block[2]
    ry = block[3]
    off = block[4]
    powers_y = np.empty((ZERNIKE_DEGREE, _BLOCK))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        x_excess = 0.0
        y_excess = 0.0
        x_square = 0.0
        y_square = 0.0
        w_sum = 0.0
        # The residual of each point, measured less fitted slope, times its weight; and the sums
        # over the block that are no moments.
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
    """Moments from which the normal matrix D^T W D is made.

    Parameters
    ----------
    rays, t, pinhole, excess, radius, start, stop
        See the module.
    weights : (n,) array
        w.

    Returns
    -------
    (PRODUCTS,) array
        sum w x^p y^q of PRODUCT_MONOMIALS, sum w e' x x^p y^q and sum w e' y x^p y^q with
        SLOPE_MONOMIALS each, sum w (e' x)^2, sum w (e' y)^2.
    """
    sums = np.zeros(PRODUCTS)
    first_of_x = PRODUCT_MONOMIALS
    first_of_y = PRODUCT_MONOMIALS + SLOPE_MONOMIALS
    # Memory of a block: x, y, weight, and weight times the excess' slopes e' x and e' y.
    block = np.empty((5, _BLOCK))
    xs = block[0]
    ys = block[1]
    ws = block[2]
    ex = block[3]
    ey = block[4]
    powers_y = np.empty((PRODUCT_DEGREE + 1, _BLOCK))
    # e'(v) depends on the excess alone: the Zernike part is 0.
    flat = np.zeros((ZERNIKE_DEGREE + 1, ZERNIKE_DEGREE + 1))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        # Values of each point, and the sums of the excess' squares.
        for k in range(count):
            p = first + k
            x, y, _z = _film_point(rays, t, pinhole, p)
            xs[k] = x / radius
            ys[k] = y / radius
            _h, _hx, _hy, ev = evaluate_surface(flat, excess, 0.0, xs[k], ys[k])
            ws[k] = weights[p]
            ex[k] = weights[p] * ev * xs[k]
            ey[k] = weights[p] * ev * ys[k]
            sums[PRODUCTS - 2] += ex[k] * ev * xs[k]
            sums[PRODUCTS - 1] += ey[k] * ev * ys[k]

        # Moments of the weights, and of the excess' slopes with the terms' slopes.
        _compute_powers(ys, powers_y, count)
        slope_powers = powers_y[:ZERNIKE_DEGREE]
        _add_moments(ws, xs, powers_y, count, sums, 0)
        _add_moments(ex, xs, slope_powers, count, sums, first_of_x)
        _add_moments(ey, xs, slope_powers, count, sums, first_of_y)
    return sums


@compile_kernel
def slope_field(  # type: ignore[no-untyped-def]
    rays, t, screen, pinhole, plane, face, poly, excess, amplitude, radius, out, start, stop
):
    """Measured and fitted slopes of each point.

    Parameters
    ----------
    rays, t, screen, pinhole, plane, face, poly, excess, amplitude, radius, start, stop
        See the module.
    out : (6, n) array
        Gets x, y, measured g_x, g_y and fitted h_x, h_y.
    """
    off = np.empty(_BLOCK)
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        _look_up_face(screen, face, first, count, off)
        for k in range(count):
            p = first + k
            # The bisector of the rays, and the slope of the surface at the same place.
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
    """Where the surface sends each ray on the screen.

    Parameters
    ----------
    rays, t, pinhole, plane, face, poly, excess, amplitude, radius, start, stop
        See the module; the points must be on the surface.
    out : (2, n) array
        Gets s_x and s_y.
    """
    tangents = np.empty((2, _BLOCK))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        for k in range(count):
            # P = F + t d on the film, and the film's normal n = (n_x, n_y, 1) there.
            p = first + k
            x, y, z = _film_point(rays, t, pinhole, p)
            _h, hx, hy, _ev = evaluate_surface(poly, excess, amplitude, x / radius, y / radius)
            nx = -hx / radius
            ny = -hy / radius

            # The reflected ray u = d - 2 (d n) / (n n) n.
            dx = rays[0, p]
            dy = rays[1, p]
            dz = rays[2, p]
            d_n = dx * nx + dy * ny + dz
            n_n = nx * nx + ny * ny + 1
            turn = 2 * d_n / n_n
            ux = dx - turn * nx
            uy = dy - turn * ny
            uz = dz - turn

            # It meets the plane at S = P + k u, k = N (O' - P) / (N u), with N the plane's normal.
            ox = plane[_ORIGIN, 0] - x
            oy = plane[_ORIGIN, 1] - y
            oz = plane[_ORIGIN, 2] - z
            across = 1 / component_along(ux, uy, uz, plane, _NORMAL)
            reach = component_along(ox, oy, oz, plane, _NORMAL) * across

            # Its coordinates: S - O' along s_x and s_y.
            sx = reach * ux - ox
            sy = reach * uy - oy
            sz = reach * uz - oz
            out[0, p] = component_along(sx, sy, sz, plane, _S_X)
            out[1, p] = component_along(sx, sy, sz, plane, _S_Y)

            # Tangents of the angles between u and N along s_x and s_y.
            tangents[0, k] = component_along(ux, uy, uz, plane, _S_X) * across
            tangents[1, k] = component_along(ux, uy, uz, plane, _S_Y) * across
        _move_to_face(out, tangents, face, first, count)


@compile_kernel
def _move_to_face(out, tangents, face, first, count):  # type: ignore[no-untyped-def]
    """Move points from where rays cross the plane to where they meet the face.

    Newton's steps on w = face(s + w tangent): w <- w - (w - face) / (1 - tangent grad face). A step
    leaves the square of the error times the face's curvature: the error is rounding after three
    steps for 1 mm of bow 200 mm wide, and after four or five for a map of a few millimetres.
    """
    if screen_face.is_plane(face):
        return
    for k in range(count):
        # Where the ray crosses the plane, and how far it moves along it per mm of w.
        a = out[0, first + k]
        b = out[1, first + k]
        tangent_a = tangents[0, k]
        tangent_b = tangents[1, k]
        w = 0.0
        for _ in range(FACE_STEPS):
            height, wa, wb = screen_face.face_height(face, a + w * tangent_a, b + w * tangent_b)
            w -= (w - height) / (1 - wa * tangent_a - wb * tangent_b)
        out[0, first + k] = a + w * tangent_a
        out[1, first + k] = b + w * tangent_b
