"""The sensor as a grid of bins: their rays, the effect of averaging a curved phase over a bin, and
cells of bins over which what changes slowly over the mirror is a plane."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from membrane_ctrl.config.schema import CameraConfig
from membrane_ctrl.metrology.numerics.compiled import kernel
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.surface_fit import NormalMatrix, Points, Tracer
from membrane_ctrl.model.arrays import AnyArray, BoolArray, FloatArray, IntArray, Singles

_SIDE = 4  # bins along a cell's side: planes are 1 % off for the highest terms at the rim
CELL_BINS, BLOCK_CELLS = (
    _SIDE**2,
    64,
)  # a block of cells has 1024 bins: nine rows of them fit the first cache
BLOCK_BINS = CELL_BINS * BLOCK_CELLS


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
        self._around = [
            geometry.rays(self.column_px + right, self.row_px + down) for right, down in offsets
        ]

    def near_mirror(self, radius_mm: float) -> BoolArray:
        """Bins whose ray meets the plane z = 0 within a radius."""
        f = self._geometry.pinhole_mm
        t = -f[2] / self.rays[2]
        return np.asarray(
            (f[0] + t * self.rays[0]) ** 2 + (f[1] + t * self.rays[1]) ** 2 <= radius_mm**2
        )

    def solid_angle(self, index: IntArray) -> FloatArray:
        """Solid angle of bins: (side / focal length)^2 cos^3 of the angle to the axis."""
        cosine = self._geometry.rotation[2] @ self.rays[:, index]
        return np.asarray((self._bin_px / self._geometry.focal_px) ** 2 * cosine**3)

    def averaging_bias_mm(
        self, tracer: Tracer, points: Points, surface: Surface, index: IntArray
    ) -> FloatArray:
        """Mean of s over a bin's pixels minus s at its centre, (2, n).

        A bin's phase is the mean over its pixels: s + sigma^2 / 2 (s_uu + s_vv), sigma^2 = (m^2 -
        1) / 12. That is the mean of the four values at a distance h with h^2 = 2 sigma^2, so four
        traces of the model give it.
        """
        centre = tracer.predict_screen(points, surface)
        if not self._around:  # a bin is a pixel
            return np.zeros_like(centre)
        total = np.zeros_like(centre)
        for around in self._around:
            moved = Points(
                np.ascontiguousarray(around[:, index]), centre, points.weights, points.t_mm.copy()
            )
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
    """Mean over the mirror of (d g_i / d s_k)^2 in 1/mm^2, (2, 2): rows the slopes x and y, columns
    s_x and s_y.

    The normal is n = u - d with u the unit vector to the screen point, so d n = (e - u (u e)) / |q|
    d s and g = -n_xy / n_z gives d g = -(d n_xy + g d n_z) / n_z. Taken on a bowl of the given sag,
    each point towards the screen point that it really reflects (its normal is then the bowl's own).
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
    """Covariance (parameters, parameters) in mm^2 of the fit, for the variance (2,) of an x and of
    a y slope.
    """
    variance_x, variance_y = slope_variance
    return np.asarray(
        normal.inverse @ (variance_x * normal.x + variance_y * normal.y) @ normal.inverse
    )


@dataclass(frozen=True)
class Cells:
    """Squares of bins, N of them, over each of which what changes slowly is a plane.

    64 cells are a block: their first bins, then their second ones, and so on, so that loops over a
    block use vector units. A cell with fewer bins repeats one, as the last block repeats a cell;
    what is repeated counts once, because its weight is 0 (`of`).
    """

    offset: Singles  # (N / 64, 2, 16, 64): of the bins, from the mean of their cell's

    @staticmethod
    def of(index: IntArray, columns: int) -> "tuple[IntArray, BoolArray, Cells]":
        """Bins (n,) in the order of the cells, whether each counts, and the cells."""
        square = index // columns // _SIDE * columns + index % columns // _SIDE
        order = np.argsort(square, kind="stable")
        _, starts, counts = np.unique(square[order], return_index=True, return_counts=True)
        counted = counts[:, None] > np.arange(CELL_BINS)
        first = starts[:, None] + np.arange(CELL_BINS) * counted
        more = (0, -len(starts) % BLOCK_CELLS), (0, 0)
        padded = np.pad(first, more, "edge"), np.pad(counted, more)
        blocks, counted = (
            each.reshape(-1, BLOCK_CELLS, CELL_BINS).swapaxes(1, 2) for each in padded
        )
        index = index[order][blocks]
        at = np.stack([index % columns, index // columns], axis=1)
        offset = (at - at.mean(axis=2, keepdims=True)).astype(np.float32, order="C")
        return index.ravel(), counted.ravel(), Cells(offset)

    @cached_property
    def _offsets(self) -> Singles:
        """(2, n)."""
        return self.offset.swapaxes(0, 1).reshape(2, -1)

    def sums(self, values: AnyArray) -> AnyArray:
        """Of the cells (..., N) of bins (..., n)."""
        lead, blocks = values.shape[:-1], len(self.offset)
        return np.asarray(
            values.reshape(*lead, blocks, CELL_BINS, BLOCK_CELLS)
            .sum(axis=-2)
            .reshape(*lead, blocks * BLOCK_CELLS)
        )

    def moments(self, values: AnyArray) -> AnyArray:
        """Sums (..., 3, N) of values of bins (..., n) times 1 and their offsets."""
        return np.stack(
            [self.sums(values), *(self.sums(values * one) for one in self._offsets)], axis=-2
        )

    def each(self, values: AnyArray) -> AnyArray:
        """Of the bins (..., n) those of their cells (..., N)."""
        lead, blocks = values.shape[:-1], len(self.offset)
        repeated = np.repeat(values.reshape(*lead, blocks, 1, BLOCK_CELLS), CELL_BINS, axis=-2)
        return repeated.reshape(*lead, blocks * BLOCK_BINS)

    def spread(self, planes: AnyArray) -> AnyArray:
        """Values (..., n) of the bins on planes (..., 3, N) of the cells."""
        mean, along_u, along_v = self.each(np.moveaxis(planes, -2, 0))
        u, v = self._offsets
        return np.asarray(mean + along_u * u + along_v * v)

    def planes(self, values: AnyArray) -> Singles:
        """The planes (..., 3, N) that fit values of bins (..., n) best."""
        weights = self.moments(np.stack([np.ones_like(self._offsets[0]), *self._offsets]))
        weights[[1, 2], [1, 2]] += np.float32(1e-3)  # bins in a row
        inverse = np.linalg.inv(weights.transpose(2, 0, 1))
        return np.asarray(
            np.einsum("qij,...jq->...iq", inverse, self.moments(values)), np.float32, order="C"
        )

    def blocks(self, *planes: Singles) -> Singles:
        """Planes, each (k, 3, N), block by block (N / 64, sum of k, 3 x 64)."""
        every = np.concatenate(planes).reshape(-1, 3, len(self.offset), BLOCK_CELLS)
        return np.ascontiguousarray(every.transpose(2, 0, 1, 3)).reshape(
            len(self.offset), -1, 3 * BLOCK_CELLS
        )


# The same for one block, compiled. One small loop a function, and a block's rows in one array: so
# the compiler can tell that nothing overlaps, and finds vector instructions on any processor. A
# block's planes fit
# the second cache.


@kernel
def combine(slow, factors, start, planes):  # type: ignore[no-untyped-def]
    """Planes (3 x 64) of a block's cells: of level `start`, plus (k, 3 x 64) times their factors
    (k,).
    """
    planes[:BLOCK_CELLS], planes[BLOCK_CELLS:] = start, 0
    for k in range(factors.size):
        for q in range(planes.size):
            planes[q] += factors[k] * slow[k, q]


@kernel
def project(slow, planes, out):  # type: ignore[no-untyped-def]
    """Add the products (k,) of planes (3 x 64) with others (k, 3 x 64)."""
    for k in range(out.size):
        total = np.float32(0)
        for q in range(planes.size):
            total += slow[k, q] * planes[q]
        out[k] += total


@kernel
def spread(planes, offset, out):  # type: ignore[no-untyped-def]
    """Values (16, 64) of a block's bins on the planes of its cells."""
    for j in range(CELL_BINS):
        for q in range(BLOCK_CELLS):
            out[j, q] = (
                planes[q]
                + planes[BLOCK_CELLS + q] * offset[0, j, q]
                + planes[2 * BLOCK_CELLS + q] * offset[1, j, q]
            )


@kernel
def moments(values, offset, planes):  # type: ignore[no-untyped-def]
    """Moments of values (16, 64) over a block's cells."""
    planes[:] = 0
    for j in range(CELL_BINS):
        for q in range(BLOCK_CELLS):
            planes[q] += values[j, q]
            planes[BLOCK_CELLS + q] += values[j, q] * offset[0, j, q]
            planes[2 * BLOCK_CELLS + q] += values[j, q] * offset[1, j, q]
