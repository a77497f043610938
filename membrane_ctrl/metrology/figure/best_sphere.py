"""The best sphere: least squares of the deviations along its normal.

The sphere passes (0, 0, z0) with unit normal n and has the curvature c. With q = P - (0, 0, z0)
its distance from a point is d = (1 - s) / c = (2 q n - c q^2) / (1 + s), s^2 = 1 - 2 c q n + c^2
q^2, which also holds for a flat.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_SPHERE_POINTS = 20_000  # enough to come close; the last step takes all


@dataclass(frozen=True)
class Sphere:
    """Sphere through (0, 0, `vertex_mm`).

    Attributes
    ----------
    vertex_mm : float
    tilt_x, tilt_y : float
        Slopes there.
    curvature_per_mm : float
        Positive: concave, the centre on the side of +z.
    """

    vertex_mm: float
    tilt_x: float
    tilt_y: float
    curvature_per_mm: float

    @property
    def normal(self) -> FloatArray:
        """Unit normal (3,) at the vertex, towards +z."""
        normal = np.array([-self.tilt_x, -self.tilt_y, 1.0])
        return np.asarray(normal / np.linalg.norm(normal))

    def deviation(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deviation (n,) in mm of points (3, n), and the unit normals (3,
        n) of the sphere there.
        """
        q = points_mm - np.array([[0.0], [0.0], [self.vertex_mm]])
        c, along, square = self.curvature_per_mm, self.normal @ q, np.einsum("in,in->n", q, q)
        s = np.sqrt(1 - 2 * c * along + c * c * square)
        return (2 * along - c * square) / (1 + s), (self.normal[:, None] - c * q) / s

    def sag_mm(self, radius_mm: float) -> float:
        """Depth over a disc around the vertex; NaN for a disc larger than the sphere."""
        c = self.curvature_per_mm
        left = 1 - (c * radius_mm) ** 2
        return c * radius_mm**2 / (1 + math.sqrt(left)) if left >= 0 else math.nan


def best_sphere(points_mm: FloatArray) -> Sphere:
    """Sphere with the least squares of the deviations along its normal, for points (3, n)."""
    some = points_mm[:, :: max(1, points_mm.shape[1] // _SPHERE_POINTS)]
    scale = float(np.sqrt(np.mean(some[0] ** 2 + some[1] ** 2)))
    x, y, z = some
    bowl = np.stack([np.ones_like(x), x, y, (x * x + y * y) / 2], axis=1)
    columns = np.array([1.0, 1 / scale, 1 / scale, 2 / scale**2])
    found = columns * np.linalg.lstsq(bowl * columns, z, rcond=None)[0]
    for cloud in (some, some, points_mm):
        found = found + _sphere_step(Sphere(*found), cloud, columns)
    return Sphere(*(float(value) for value in found))


def _sphere_step(sphere: Sphere, points_mm: FloatArray, columns: FloatArray) -> FloatArray:
    """Gauss-Newton step (4,); from (1 - c d)^2 = s^2, the derivatives
    of d need no division by c.
    """
    deviation, normals = sphere.deviation(points_mm)
    q = points_mm - np.array([[0.0], [0.0], [sphere.vertex_mm]])
    s, n = 1 - sphere.curvature_per_mm * deviation, sphere.normal
    length = 1 / n[2]
    turn_x = (np.array([-1.0, 0, 0]) + n * n[0]) / length  # d normal / d tilt_x
    turn_y = (np.array([0.0, -1, 0]) + n * n[1]) / length
    square = np.einsum("in,in->n", q, q)
    rows = np.stack(
        [-normals[2], turn_x @ q / s, turn_y @ q / s, (deviation**2 - square) / (2 * s)]
    )
    rows *= columns[:, None]
    return np.asarray(columns * np.linalg.lstsq(rows @ rows.T, -rows @ deviation, rcond=1e-13)[0])
