"""The best sphere: least squares of the deviations along its normal.

The sphere passes (0, 0, z0) with unit normal n and has the curvature c. With q = P - (0, 0, z0)
its distance from a point is d = (1 - s) / c = (2 q n - c q^2) / (1 + s), s^2 = 1 - 2 c q n + c^2
q^2, which also holds for a flat.
"""

import math
from dataclasses import astuple, dataclass

import numpy as np

from membrane_ctrl.metrology.numerics.vectors import column_blocks
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
        deviation_mm = np.empty(points_mm.shape[1])
        normals = np.empty_like(points_mm)
        c = self.curvature_per_mm
        for block in column_blocks(points_mm.shape[1]):
            # q, q n and q^2 of each point; then s, the share of the radius at which the point is.
            # The deviation is (1 - s) / c, written so that a plane, c = 0, needs no limit.
            q = points_mm[:, block] - np.array([[0.0], [0.0], [self.vertex_mm]])
            along = self.normal @ q
            square = np.einsum("in,in->n", q, q)
            s = np.sqrt(1 - 2 * c * along + c * c * square)
            deviation_mm[block] = (2 * along - c * square) / (1 + s)
            normals[:, block] = (self.normal[:, None] - c * q) / s
        return deviation_mm, normals

    def sag_mm(self, radius_mm: float) -> float:
        """Depth over a disc around the vertex; NaN for a disc larger than the sphere."""
        c = self.curvature_per_mm
        # Square of the cosine of the angle between the normals at rim and vertex.
        cosine_square = 1 - (c * radius_mm) ** 2
        if cosine_square < 0:
            return math.nan
        return c * radius_mm**2 / (1 + math.sqrt(cosine_square))


def best_sphere(points_mm: FloatArray, near: Sphere | None = None) -> Sphere:
    """Sphere with the least squares of the deviations along its normal.

    Parameters
    ----------
    points_mm : (3, n) array
    near : Sphere, optional
        The best sphere of nearly the same points, from which two steps are enough.

    Returns
    -------
    Sphere
    """
    stride = max(1, points_mm.shape[1] // _SPHERE_POINTS)
    some = points_mm[:, ::stride]
    scale = float(np.sqrt(np.mean(some[0] ** 2 + some[1] ** 2)))
    # Vertex, tilts and curvature are scaled to one size.
    columns = np.array([1.0, 1 / scale, 1 / scale, 2 / scale**2])

    # Gauss-Newton steps, the last one with all points.
    if near is None:
        sphere = _fit_paraboloid(some, columns)
        clouds = [some, some, points_mm]
    else:
        sphere = near
        clouds = [some, points_mm]
    for cloud in clouds:
        sphere = Sphere(
            *(np.array(astuple(sphere)) + _sphere_step(sphere, cloud, columns)).tolist()
        )
    return sphere


def _fit_paraboloid(points_mm: FloatArray, columns: FloatArray) -> Sphere:
    """Sphere of the paraboloid z = z0 + t_x x + t_y y + c (x^2 + y^2) / 2 through the points."""
    x, y, z = points_mm
    bent = (x * x + y * y) / 2
    paraboloid = np.stack([np.ones_like(x), x, y, bent], axis=1)
    found = columns * np.linalg.lstsq(paraboloid * columns, z, rcond=None)[0]
    return Sphere(*found.tolist())


def _sphere_step(sphere: Sphere, points_mm: FloatArray, columns: FloatArray) -> FloatArray:
    """Gauss-Newton step (4,) of vertex, tilts and curvature."""
    normal = np.zeros((4, 4))
    right = np.zeros(4)
    for block in column_blocks(points_mm.shape[1]):
        deviation, rows = _sphere_derivatives(sphere, points_mm[:, block])
        rows *= columns[:, None]
        normal += rows @ rows.T
        right -= rows @ deviation
    step = np.linalg.lstsq(normal, right, rcond=1e-13)[0]
    return np.asarray(columns * step)


def _sphere_derivatives(sphere: Sphere, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Deviation (n,) of points, and its derivatives (4, n) by vertex, tilts and curvature.

    From (1 - c d)^2 = s^2, the derivatives of d need no division by c.
    """
    # q, q n, q^2, s and d of each point.
    x, y, z = points_mm
    z = z - sphere.vertex_mm
    n = sphere.normal
    c = sphere.curvature_per_mm
    along = n[0] * x + n[1] * y + n[2] * z
    square = x * x + y * y + z * z
    s = np.sqrt(1 - 2 * c * along + c * c * square)
    deviation = (2 * along - c * square) / (1 + s)

    # Derivatives of the unit normal by the tilts.
    length = 1 / n[2]
    normal_by_x = (np.array([-1.0, 0, 0]) + n * n[0]) / length
    normal_by_y = (np.array([0.0, -1, 0]) + n * n[1]) / length

    # Derivatives of the deviation by vertex, tilts and curvature, all times s.
    by_vertex = c * z - n[2]
    by_tilt_x = normal_by_x[0] * x + normal_by_x[1] * y + normal_by_x[2] * z
    by_tilt_y = normal_by_y[0] * x + normal_by_y[1] * y + normal_by_y[2] * z
    by_curvature = (deviation * deviation - square) / 2
    rows = np.stack([by_vertex, by_tilt_x, by_tilt_y, by_curvature])
    rows /= s
    return deviation, rows
