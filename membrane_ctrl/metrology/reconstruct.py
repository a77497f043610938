"""From rays and screen points to the surface: ray-traced slopes, least squares, iterated (the paper's section 2.4).

Slope and height need each other: the slope at a pixel is the bisector at the point where its ray meets the film,
and where that is depends on the height. The iteration starts from any shape and contracts by about 300 a step.

Each step solves (D^T W D) delta = D^T W (g - D a) and adds delta to a. Where delta vanishes, a is the least-squares
solution on its own surface, whatever matrix stands on the left: so a matrix of an earlier step, or cycle, may be
kept without moving the end point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology import hencky, kernels
from membrane_ctrl.metrology.fit import NormalMatrix, residual_rms, right_side
from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.metrology.surface import PARAMETERS, Surface, height_probe
from membrane_ctrl.metrology.threads import split

FloatArray = NDArray[np.float64]
HeightFunction = Callable[[FloatArray, FloatArray], FloatArray]  # x_mm, y_mm -> h_mm

TOLERANCE_MM = 1e-6  # the paper's threshold on the largest change of height
CONTRACTION = 1 / 100  # of one step; 1/300 was seen, the rest is margin
MAX_ITERATIONS = 20
_EXCESS = hencky.excess() / hencky.excess_rms()


@dataclass
class Points:
    """What was measured, on any set of points: binned or every pixel.

    Attributes
    ----------
    rays : (3, n) array
        Unit vectors in world, from the pinhole.
    screen_mm : (2, n) array
        s_x, s_y seen there, from O'.
    weights : (n,) array
        Of both slopes of a point; 0 leaves it out.
    t_mm : (n,) array
        Length of each ray to the surface; kept between solutions as the start of the next.
    """

    rays: FloatArray
    screen_mm: FloatArray
    weights: FloatArray
    t_mm: FloatArray

    @classmethod
    def of(cls, rays: FloatArray, screen_mm: FloatArray, weights: FloatArray | None = None) -> Points:
        """Points with unit weights unless given."""
        count = rays.shape[1]
        weights = np.ones(count) if weights is None else weights
        return cls(np.ascontiguousarray(rays), np.ascontiguousarray(screen_mm), weights, np.zeros(count))

    def subset(self, keep: NDArray[np.bool_]) -> Points:
        """Those points where `keep` is set."""
        return Points(
            np.ascontiguousarray(self.rays[:, keep]),
            np.ascontiguousarray(self.screen_mm[:, keep]),
            self.weights[keep],
            self.t_mm[keep],
        )


@dataclass(frozen=True)
class Fit:
    """Solution and how it was reached.

    Attributes
    ----------
    changes_mm : tuple of float
        Largest change of height of each step over the disc.
    residual_x, residual_y : float
        Weighted RMS of measured minus fitted slope (a slope, without unit).
    weight_sum : float
        Sum of the weights.
    """

    surface: Surface
    normal: NormalMatrix
    changes_mm: tuple[float, ...]
    converged: bool
    residual_x: float
    residual_y: float
    weight_sum: float


class Tracer:
    """A geometry with the vertex at a height, over a disc: runs the kernels on points."""

    def __init__(self, geometry: Geometry, radius_mm: float, vertex_z_mm: float = 0.0) -> None:
        self.geometry = geometry
        self.radius_mm = radius_mm
        self.vertex_z_mm = vertex_z_mm
        self._pinhole = geometry.pinhole_mm
        self._plane = np.vstack([geometry.screen_origin_mm, geometry.screen_axes])
        self._face = geometry.face

    def start(self, points: Points, height: HeightFunction) -> None:
        """Put the points on a starting shape, by t <- (vertex_z + h - F_z) / d_z.

        Contracts by slope times inclination of the ray (below 0.1), so that kinks of a cone do no harm.
        """
        f, d = self._pinhole, points.rays
        points.t_mm[:] = (self.vertex_z_mm - f[2]) / d[2]
        for _ in range(12):
            h = height(f[0] + points.t_mm * d[0], f[1] + points.t_mm * d[1])
            points.t_mm[:] = (self.vertex_z_mm + h - f[2]) / d[2]

    def intersect(self, points: Points, surface: Surface, newton: int = 1) -> None:
        """Put the points on a surface, from where they are, by Newton steps."""
        shape = self._shape(surface)

        def run(start: int, stop: int) -> None:
            kernels.intersect(points.rays, points.t_mm, self._pinhole, *shape, self.vertex_z_mm, newton, start, stop)

        split(run, points.t_mm.size)

    def residual_sums(self, points: Points, surface: Surface, newton: int = 0) -> FloatArray:
        """Moments of the slope residual (see `kernels.residual_sums`), after Newton steps towards the surface."""
        shape = self._shape(surface)

        def run(start: int, stop: int) -> FloatArray:
            rays, t = points.rays, points.t_mm
            kernels.intersect(rays, t, self._pinhole, *shape, self.vertex_z_mm, newton, start, stop)
            fixed = (rays, t, points.screen_mm, points.weights, self._pinhole, self._plane, self._face)
            return np.asarray(kernels.residual_sums(*fixed, *shape, start, stop))

        return np.asarray(np.sum(split(run, points.t_mm.size), axis=0))

    def normal_matrix(self, points: Points) -> NormalMatrix:
        """D^T W D where the points stand."""

        def run(start: int, stop: int) -> FloatArray:
            fixed = (points.rays, points.t_mm, points.weights, self._pinhole, _EXCESS, self.radius_mm)
            return np.asarray(kernels.product_sums(*fixed, start, stop))

        return NormalMatrix.from_products(np.sum(split(run, points.t_mm.size), axis=0), self.radius_mm)

    def slope_field(self, points: Points, surface: Surface) -> FloatArray:
        """(6, n): x, y in mm, measured dh/dx, dh/dy, fitted dh/dx, dh/dy where the points stand."""
        shape = self._shape(surface)
        out = np.empty((6, points.t_mm.size))

        def run(start: int, stop: int) -> None:
            fixed = (points.rays, points.t_mm, points.screen_mm, self._pinhole, self._plane, self._face)
            kernels.slope_field(*fixed, *shape, out, start, stop)

        split(run, points.t_mm.size)
        return out

    def predict_screen(self, points: Points, surface: Surface) -> FloatArray:
        """Screen points (2, n) in mm that the surface would send the rays to; the points must stand on it."""
        shape = self._shape(surface)
        out = np.empty((2, points.t_mm.size))

        def run(start: int, stop: int) -> None:
            fixed = (points.rays, points.t_mm, self._pinhole, self._plane, self._face)
            kernels.predict_screen(*fixed, *shape, out, start, stop)

        split(run, points.t_mm.size)
        return out

    def position_mm(self, points: Points) -> FloatArray:
        """x and y (2, n) where the points stand."""
        return np.asarray(self._pinhole[:2, None] + points.t_mm * points.rays[:2])

    def _shape(self, surface: Surface) -> tuple[FloatArray, FloatArray, float, float]:
        return surface.polynomial, _EXCESS, surface.hencky_mm * hencky.excess_rms(), self.radius_mm


def parabola(sag_mm: float, radius_mm: float) -> HeightFunction:
    """The paper's starting shape."""
    return lambda x, y: sag_mm * (x * x + y * y) / radius_mm**2


def cone(sag_mm: float, radius_mm: float) -> HeightFunction:
    """The paper's conical starting shape."""
    return lambda x, y: sag_mm * np.hypot(x, y) / radius_mm


def v_fold(sag_mm: float, radius_mm: float) -> HeightFunction:
    """The paper's V-fold: two planes that meet in the y axis."""
    return lambda x, y: sag_mm * np.abs(x) / radius_mm + 0 * y


def solve(
    tracer: Tracer,
    points: Points,
    start: HeightFunction | Surface,
    *,
    normal: NormalMatrix | None = None,
    tolerance_mm: float = TOLERANCE_MM,
    max_iterations: int = MAX_ITERATIONS,
) -> Fit:
    """Fit the surface to the points.

    Parameters
    ----------
    start : height function or Surface
        A height function places the points once. A Surface is the last solution: `points.t_mm` must then stand on
        it, and one or two steps are enough.
    normal : NormalMatrix, optional
        A matrix to keep instead of renewing it each step (the end point is the same).
    tolerance_mm : float
        Stop when the largest change of height, after the contraction still to come, is below this.

    Returns
    -------
    Fit
        `converged` is False if `max_iterations` did not do, or if a number was not finite.
    """
    placed = not isinstance(start, Surface)
    if isinstance(start, Surface):
        surface = start
    else:
        tracer.start(points, start)
        surface = Surface.from_parameters(np.zeros(PARAMETERS), tracer.radius_mm)
    changes: list[float] = []
    step = None
    while len(changes) < max_iterations:
        step = _step(tracer, points, surface, normal, newton=0 if placed else 1)
        placed = False
        surface = Surface.from_parameters(surface.parameters + step.delta, tracer.radius_mm)
        changes.append(float(np.max(np.abs(height_probe() @ step.delta))))
        if not changes[-1] * CONTRACTION > tolerance_mm:  # also ends on NaN
            break
    if step is None:
        raise ValueError("max_iterations must be at least 1")
    residual_x, residual_y = residual_rms(step.sums, step.right, step.normal, step.delta)
    converged = changes[-1] * CONTRACTION <= tolerance_mm
    return Fit(surface, step.normal, tuple(changes), converged, residual_x, residual_y, float(step.sums[-1]))


@dataclass(frozen=True)
class _Step:
    sums: FloatArray
    right: FloatArray
    normal: NormalMatrix
    delta: FloatArray


def _step(tracer: Tracer, points: Points, surface: Surface, normal: NormalMatrix | None, newton: int) -> _Step:
    """One Gauss-Newton step, after moving the points onto the surface by Newton steps (0: where they stand)."""
    sums = tracer.residual_sums(points, surface, newton)
    matrix = normal or tracer.normal_matrix(points)
    right = right_side(sums, tracer.radius_mm)
    return _Step(sums, right, matrix, matrix.solve(right.sum(axis=0)))
