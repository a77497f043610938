"""Derivatives of the camera's rays by the parameters of the lens."""

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.arrays import FloatArray


def lens_derivatives(
    geometry: Geometry, column_px: FloatArray, row_px: FloatArray, rays: FloatArray
) -> FloatArray:
    """Change of the camera's rays by each parameter of the lens.

    A pixel fixes the distorted point q = ((c, r) - principal) / focal = f(p; k): dp = (df/dp)^-1
    (dq - df/dk dk), and the unit vector c of (p, 1) turns by (1 - c c^T) (dp, 0) / |(p, 1)|.
    Coefficients beyond the first four, if the stated lens has any, count as constants of df/dp only
    to first order: they are left out there.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    column_px, row_px : (m,) arrays
        Image points.
    rays : (3, m) array
        Their rays, unit vectors in world.

    Returns
    -------
    (7, 3, m) array
        d ray / d (relative focal length, principal column and row in pixels, k1, k2, p1, p2).
    """
    # The undistorted points p = (x, y) of the rays.
    c = geometry.rotation @ rays
    x = c[0] / c[2]
    y = c[1] / c[2]
    k1, k2, p1, p2 = (*geometry.distortion, 0.0, 0.0, 0.0, 0.0)[:4]

    # df/dp, a symmetric matrix.
    r2 = x * x + y * y
    r4 = r2**2
    radial = 1 + k1 * r2 + k2 * r4
    radial_slope = 2 * (k1 + 2 * k2 * r2)
    fxx = radial + radial_slope * x * x + 2 * p1 * y + 6 * p2 * x
    fxy = radial_slope * x * y + 2 * p1 * x + 2 * p2 * y
    fyy = radial + radial_slope * y * y + 6 * p1 * y + 2 * p2 * x

    # dq - df/dk dk, along x and along y, for each of the seven parameters: the focal length scales
    # q, the principal point shifts it, and the coefficients move f.
    qx = (column_px - geometry.principal_px[0]) / geometry.focal_px
    qy = (row_px - geometry.principal_px[1]) / geometry.focal_px
    zero = np.zeros_like(x)
    shift = np.full_like(x, -1 / geometry.focal_px)
    p1_x = -2 * x * y
    p1_y = -(r2 + 2 * y * y)
    p2_x = -(r2 + 2 * x * x)
    p2_y = -2 * x * y
    change_x = np.stack([-qx, shift, zero, -x * r2, -x * r4, p1_x, p2_x])
    change_y = np.stack([-qy, zero, shift, -y * r2, -y * r4, p1_y, p2_y])

    # dp, by the inverse of df/dp.
    determinant = fxx * fyy - fxy**2
    dpx = (fyy * change_x - fxy * change_y) / determinant
    dpy = (fxx * change_y - fxy * change_x) / determinant

    # The turn of the unit vectors in the camera, (1 - c c^T) (dp, 0) c_z, and then in world.
    moved = np.stack([dpx, dpy, np.zeros_like(dpx)], axis=1) * c[2]
    along = np.sum(moved * c, axis=1, keepdims=True)
    turned = moved - along * c
    return np.asarray(np.einsum("ij,lim->ljm", geometry.rotation, turned))
