"""The sensor as a grid of bins: their rays, and the effect of averaging a curved phase over one."""

import math

import numpy as np

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray


class BinGrid:
    """Bins of `bin_px` x `bin_px` pixels over a sensor, in row order.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    camera : CameraConfig
        Size of the sensor.
    bin_px : int
        Side of a bin.

    Attributes
    ----------
    columns : int
        Number of bins in a row.
    column_px, row_px : (bins,) arrays
        Centres of the bins in pixels.
    rays : (3, bins) array
        Unit vectors in world.
    """

    def __init__(self, geometry: Geometry, camera: CameraConfig, bin_px: int) -> None:
        self._geometry = geometry
        self._bin_px = bin_px
        # Centres of the bins: pixel centres are integers. Pixels that fill no bin are left out.
        middle = (bin_px - 1) / 2
        columns = np.arange(camera.width_px // bin_px) * bin_px + middle
        rows = np.arange(camera.height_px // bin_px) * bin_px + middle
        self.columns = columns.size
        grid_columns, grid_rows = np.meshgrid(columns, rows)
        self.column_px = grid_columns.ravel()
        self.row_px = grid_rows.ravel()
        self.rays = geometry.rays(self.column_px, self.row_px)
        # Rays around the centres, for `averaging_bias_mm`; a bin of one pixel needs none.
        self._around: list[FloatArray] = []
        if bin_px > 1:
            h = math.sqrt((bin_px**2 - 1) / 6)
            self._around = [
                geometry.rays(self.column_px + right, self.row_px + down)
                for right, down in ((h, 0.0), (-h, 0.0), (0.0, h), (0.0, -h))
            ]

    def near_mirror(self, radius_mm: float) -> BoolArray:
        """Bins whose ray meets the plane z = 0 within a radius."""
        pinhole_mm = self._geometry.pinhole_mm
        t = -pinhole_mm[2] / self.rays[2]
        x_mm = pinhole_mm[0] + t * self.rays[0]
        y_mm = pinhole_mm[1] + t * self.rays[1]
        return np.asarray(x_mm**2 + y_mm**2 <= radius_mm**2)

    def solid_angle(self, index: IntArray) -> FloatArray:
        """Solid angle of bins: (side / focal length)^2 cos^3 of the angle to the axis."""
        cosine = self._geometry.rotation[2] @ np.take(self.rays, index, axis=1)
        return np.asarray((self._bin_px / self._geometry.focal_px) ** 2 * cosine**3)

    def averaging_bias_mm(
        self, tracer: Tracer, points: Points, surface: Surface, index: IntArray
    ) -> FloatArray:
        """Mean of s over a bin's pixels minus s at its centre.

        A bin's phase is the mean over its pixels: s + sigma^2 / 2 (s_uu + s_vv), sigma^2 = (m^2 -
        1) / 12. That is the mean of the four values at a distance h with h^2 = 2 sigma^2, so four
        traces of the model give it (section 1 of docs/explanation/metrology.md).

        Parameters
        ----------
        tracer : Tracer
            The bench.
        points : Points
            n bins, on the surface.
        surface : Surface
        index : (n,) int array
            Numbers of the bins.

        Returns
        -------
        (2, n) array
        """
        centre = tracer.predict_screen(points, surface)
        if not self._around:  # a bin is a pixel
            return np.zeros_like(centre)
        total = np.zeros_like(centre)
        for around in self._around:
            moved = Points(
                np.take(around, index, axis=1), centre, points.weights, points.t_mm.copy()
            )
            tracer.intersect(moved, surface, newton=3)
            total += tracer.predict_screen(moved, surface)
        return total / len(self._around) - centre
