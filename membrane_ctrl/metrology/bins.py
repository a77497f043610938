"""The sensor as a grid of bins: rays of their centres, and the effect of averaging a curved phase over a bin."""

import math

import numpy as np

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.metrology.optics.geometry import Geometry
from membrane_ctrl.metrology.optics.surface import Surface
from membrane_ctrl.metrology.reconstruct import NormalMatrix, Points, Tracer
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray


class BinGrid:
    """Bins of `bin_px` x `bin_px` pixels over a sensor, in row order.

    Attributes
    ----------
    column_px, row_px : (bins,) arrays
        Centres of the bins in pixels.
    rays : (3, bins) array
        Unit vectors in world.
    """

    def __init__(self, geometry: Geometry, camera: CameraConfig, bin_px: int) -> None:
        self._geometry = geometry
        self._bin_px = bin_px
        middle = (bin_px - 1) / 2
        columns = np.arange(camera.width_px // bin_px) * bin_px + middle
        rows = np.arange(camera.height_px // bin_px) * bin_px + middle
        grid_columns, grid_rows = np.meshgrid(columns, rows)
        self.column_px, self.row_px = grid_columns.ravel(), grid_rows.ravel()
        self.rays = geometry.rays(self.column_px, self.row_px)
        h = math.sqrt((bin_px**2 - 1) / 6)  # see `averaging_bias_mm`
        offsets = ((h, 0.0), (-h, 0.0), (0.0, h), (0.0, -h)) if bin_px > 1 else ()
        self._around = [geometry.rays(self.column_px + right, self.row_px + down) for right, down in offsets]

    def near_mirror(self, radius_mm: float) -> BoolArray:
        """Bins whose ray meets the plane z = 0 within a radius."""
        f = self._geometry.pinhole_mm
        t = -f[2] / self.rays[2]
        return np.asarray((f[0] + t * self.rays[0]) ** 2 + (f[1] + t * self.rays[1]) ** 2 <= radius_mm**2)

    def solid_angle(self, index: IntArray) -> FloatArray:
        """Solid angle of bins: (side / focal length)^2 cos^3 of the angle to the axis."""
        cosine = self._geometry.rotation[2] @ self.rays[:, index]
        return np.asarray((self._bin_px / self._geometry.focal_px) ** 2 * cosine**3)

    def averaging_bias_mm(self, tracer: Tracer, points: Points, surface: Surface, index: IntArray) -> FloatArray:
        """Mean of s over a bin's pixels minus s at its centre, (2, n).

        A bin's phase is the mean over its pixels: s + sigma^2 / 2 (s_uu + s_vv), sigma^2 = (m^2 - 1) / 12. That is
        the mean of the four values at a distance h with h^2 = 2 sigma^2, so four traces of the model give it.
        """
        centre = tracer.predict_screen(points, surface)
        if not self._around:  # a bin is a pixel
            return np.zeros_like(centre)
        total = np.zeros_like(centre)
        for around in self._around:
            moved = Points(np.ascontiguousarray(around[:, index]), centre, points.weights, points.t_mm.copy())
            tracer.intersect(moved, surface, newton=3)
            total += tracer.predict_screen(moved, surface)
        return total / len(self._around) - centre


# Linear uncertainty of one cycle from white noise of the phase.
#
# cov(parameters) = M^-1 (var_x M_x + var_y M_y) M^-1 with M = M_x + M_y = D^T W D.

QUANTISATION_VARIANCE_ADU2 = 1 / 12  # of a value rounded to an integer


def pixel_sigma_adu(noise_adu: float) -> float:
    """Noise of a pixel with the rounding of its converter."""
    return math.sqrt(noise_adu**2 + QUANTISATION_VARIANCE_ADU2)


def slope_per_screen(geometry: Geometry, radius_mm: float, sag_mm: float) -> FloatArray:
    """Mean over the mirror of (d g_i / d s_k)^2 in 1/mm^2, (2, 2): rows the slopes x and y, columns s_x and s_y.

    The normal is n = u - d with u the unit vector to the screen point, so d n = (e - u (u e)) / |q| d s and
    g = -n_xy / n_z gives d g = -(d n_xy + g d n_z) / n_z. Taken on a bowl of the given sag, each point towards the
    screen point that it really reflects (its normal is then the bowl's own).
    """
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.9, 0.9, 15) * radius_mm] * 2))
    inside = np.hypot(x, y) <= 0.95 * radius_mm
    x, y = x[inside], y[inside]
    point = np.stack([x, y, sag_mm * (x**2 + y**2) / radius_mm**2])
    d = point - geometry.pinhole_mm[:, None]
    d /= np.linalg.norm(d, axis=0)
    n = np.stack([-2 * sag_mm * x / radius_mm**2, -2 * sag_mm * y / radius_mm**2, np.ones_like(x)])
    u = d - 2 * np.sum(d * n, axis=0) / np.sum(n * n, axis=0) * n
    face = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    reach = (face @ (geometry.screen_origin_mm[:, None] - point)) / (face @ u)
    normal = u - d
    squares = np.empty((2, 2))
    for k, axis in enumerate((geometry.screen_s_x, geometry.screen_s_y)):
        turn = (axis[:, None] - u * (axis @ u)) / reach
        slopes = -(turn[:2] - normal[:2] / normal[2] * turn[2]) / normal[2]
        squares[:, k] = np.mean(slopes**2, axis=1)
    return squares


def parameter_covariance(normal: NormalMatrix, slope_variance: FloatArray) -> FloatArray:
    """Covariance (36, 36) in mm^2 of the fit's parameters, for the variance (2,) of an x and of a y slope."""
    variance_x, variance_y = slope_variance
    return np.asarray(normal.inverse @ (variance_x * normal.x + variance_y * normal.y) @ normal.inverse)
