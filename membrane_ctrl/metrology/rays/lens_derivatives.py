"""Derivatives of the camera's rays by the parameters of the lens."""

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.arrays import FloatArray


def lens_derivatives(
    geometry: Geometry, column_px: FloatArray, row_px: FloatArray, rays: FloatArray
) -> FloatArray:
    """d ray / d (relative focal length, principal point, k1, k2, p1, p2), (7, 3, m).

    A pixel fixes the distorted point q = ((c, r) - principal) / focal = f(p; k): dp = (df/dp)^-1
    (dq - df/dk dk), and the unit vector c of (p, 1) turns by (1 - c c^T) (dp, 0) / |(p, 1)|.
    Coefficients beyond the first four, if the stated lens has any, count as constants of df/dp only
    to first order: they are left out there.
    """
    # The undistorted points p = (x, y) of the rays.
    c = geometry.rotation @ rays
    x = c[0] / c[2]
    y = c[1] / c[2]
    k1, k2, p1, p2 = (*geometry.distortion, 0.0, 0.0, 0.0, 0.0)[:4]

    # df/dp, a symmetric matrix.
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    radial_slope = 2 * (k1 + 2 * k2 * r2)
    fxx = radial + radial_slope * x * x + 2 * p1 * y + 6 * p2 * x
    fxy = radial_slope * x * y + 2 * p1 * x + 2 * p2 * y
    fyy = radial + radial_slope * y * y + 6 * p1 * y + 2 * p2 * x

    # dq - df/dk dk for each of the seven parameters.
    qx = (column_px - geometry.principal_px[0]) / geometry.focal_px
    qy = (row_px - geometry.principal_px[1]) / geometry.focal_px
    zero = np.zeros_like(x)
    step = np.full_like(x, -1 / geometry.focal_px)
    of_x = np.stack([-qx, step, zero, -x * r2, -x * r2**2, -2 * x * y, -(r2 + 2 * x * x)])
    of_y = np.stack([-qy, zero, step, -y * r2, -y * r2**2, -(r2 + 2 * y * y), -2 * x * y])

    # dp, by the inverse of df/dp.
    determinant = fxx * fyy - fxy**2
    px = (fyy * of_x - fxy * of_y) / determinant
    py = (fxx * of_y - fxy * of_x) / determinant

    # The turn of the unit vectors, in world.
    moved = np.stack([px, py, np.zeros_like(px)], axis=1) * c[2]
    turned = moved - np.sum(moved * c, axis=1, keepdims=True) * c
    return np.asarray(np.einsum("ij,lim->ljm", geometry.rotation, turned))
