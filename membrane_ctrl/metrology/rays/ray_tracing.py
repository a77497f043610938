"""Measured points, and a bench that traces their rays to the surface and on to the screen."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.numerics import threads
from membrane_ctrl.metrology.rays import kernels
from membrane_ctrl.metrology.rays.gas_lens import GasLens
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

HeightFunction = Callable[[FloatArray, FloatArray], FloatArray]  # x_mm, y_mm -> h_mm
# Arguments `poly`, `excess`, `amplitude` and `radius` of the kernels.
_Shape = tuple[FloatArray, FloatArray, float, float]
_EXCESS = hencky_bowl.excess_series() / hencky_bowl.excess_rms()  # of unit RMS
_START_STEPS = 12  # towards a starting shape


@dataclass
class Points:
    """Measured points, of bins or of all pixels.

    Attributes
    ----------
    rays : (3, n) array
        Unit vectors in world, from the pinhole.
    screen_mm : (2, n) array
        s_x and s_y seen there, from O'.
    weights : (n,) array
        Weight of both slopes of a point; 0 leaves it out.
    t_mm : (n,) array
        Length of each ray to the surface; kept between solutions as the start of the next.
    """

    rays: FloatArray
    screen_mm: FloatArray
    weights: FloatArray
    t_mm: FloatArray

    @classmethod
    def from_rays(
        cls, rays: FloatArray, screen_mm: FloatArray, weights: FloatArray | None = None
    ) -> "Points":
        """Return points at the pinhole; their shapes are those of the attributes.

        Parameters
        ----------
        rays : (3, n) array
            Unit vectors.
        screen_mm : (2, n) array
            Screen points.
        weights : (n,) array, optional
            1 if not given.
        """
        count = rays.shape[1]
        if weights is None:
            weights = np.ones(count)
        rays = np.ascontiguousarray(rays)
        screen_mm = np.ascontiguousarray(screen_mm)
        return cls(rays, screen_mm, weights, np.zeros(count))

    def subset(self, keep: BoolArray | IntArray) -> "Points":
        """Those points where `keep` (n,) is True, or those at these places (k,)."""
        place = np.flatnonzero(keep) if keep.dtype == bool else keep
        return Points(
            np.take(self.rays, place, axis=1),  # a twentieth of the time of rays[:, place]
            np.take(self.screen_mm, place, axis=1),
            np.take(self.weights, place),
            np.take(self.t_mm, place),
        )

    def keep(self, place: IntArray) -> None:
        """Drop all points but those at these places (k,), one array after the other: a copy of all
        would be the largest memory of a measurement.
        """
        self.rays = np.take(self.rays, place, axis=1)
        self.screen_mm = np.take(self.screen_mm, place, axis=1)
        self.weights = np.take(self.weights, place)
        self.t_mm = np.take(self.t_mm, place)

    def parts(self, size: int) -> Iterator[tuple[slice, "Points"]]:
        """Copies of so many consecutive points each, with their range."""
        for start in range(0, self.t_mm.size, size):
            part = slice(start, start + size)
            yield (
                part,
                Points(
                    np.ascontiguousarray(self.rays[:, part]),
                    np.ascontiguousarray(self.screen_mm[:, part]),
                    self.weights[part],
                    self.t_mm[part],
                ),
            )


class Tracer:
    """Traces rays on a bench: runs the kernels on points, in threads.

    Parameters
    ----------
    geometry : Geometry
        Camera and screen.
    radius_mm : float
        Radius of the Zernike disc.
    vertex_z_mm : float
        Height of the vertex in world.
    """

    def __init__(self, geometry: Geometry, radius_mm: float, vertex_z_mm: float = 0.0) -> None:
        self.geometry = geometry
        self.radius_mm = radius_mm
        self.vertex_z_mm = vertex_z_mm
        self._pinhole = geometry.pinhole_mm
        self._plane = np.vstack([geometry.screen_origin_mm, geometry.screen_axes])
        self._face = geometry.face

    def place_on_shape(
        self, points: Points, height: HeightFunction, steps: int = _START_STEPS
    ) -> None:
        """Put the points on a starting shape, by t <- (vertex_z + h - F_z) / d_z.

        Each step contracts by slope times inclination of the ray (below 0.1), also at the kink of a
        cone.

        Parameters
        ----------
        points : Points
            Their lengths `t_mm` are replaced.
        height : callable
            h(x, y) in mm, at places in mm.
        steps : int
            Number of steps.
        """
        f = self._pinhole
        d = points.rays
        points.t_mm[:] = (self.vertex_z_mm - f[2]) / d[2]
        for _ in range(steps):
            h = height(f[0] + points.t_mm * d[0], f[1] + points.t_mm * d[1])
            points.t_mm[:] = (self.vertex_z_mm + h - f[2]) / d[2]

    def intersect(self, points: Points, surface: Surface, newton: int = 1) -> None:
        """Put the points on a surface, from where they are, by Newton steps.

        Parameters
        ----------
        points : Points
            Their lengths `t_mm` are updated in place.
        surface : Surface
        newton : int
            Number of steps; each squares the error, so that one from a micrometre off is enough.
        """
        shape = surface.polynomial, surface.excess, 1.0, self.radius_mm

        def run(start: int, stop: int) -> None:
            """Move a range of the points."""
            self._move_range(points, shape, newton, start, stop)

        threads.split_over_threads(run, points.t_mm.size, threads.FEW)

    def residual_sums(self, points: Points, surface: Surface, newton: int = 0) -> FloatArray:
        """Sum up the slope residual of the points.

        Parameters
        ----------
        points : Points
        surface : Surface
            The fitted surface, from which the measured slopes are subtracted.
        newton : int
            Newton steps towards the surface before that.

        Returns
        -------
        (SUMS,) array
            Moments of `kernels.residual_sums`, from which the right-hand side of the least squares
            is made.
        """
        shape = self._shape(surface)
        screen_mm = self._screen_without_gas(points, surface)

        def run(start: int, stop: int) -> FloatArray:
            """Sums over a range of the points."""
            self._move_range(points, shape, newton, start, stop)
            fixed = (
                points.rays,
                points.t_mm,
                screen_mm,
                points.weights,
                self._pinhole,
                self._plane,
                self._face,
            )
            return np.asarray(kernels.residual_sums(*fixed, *shape, start, stop))

        parts = threads.split_over_threads(run, points.t_mm.size, threads.FEW)
        return np.asarray(np.sum(parts, axis=0))

    def product_sums(self, points: Points) -> FloatArray:
        """Moments (PRODUCTS,) of the slope basis at the points (see `kernels.product_sums`)."""

        def run(start: int, stop: int) -> FloatArray:
            """Sums over a range of the points."""
            fixed = (
                points.rays,
                points.t_mm,
                points.weights,
                self._pinhole,
                _EXCESS,
                self.radius_mm,
            )
            return np.asarray(kernels.product_sums(*fixed, start, stop))

        parts = threads.split_over_threads(run, points.t_mm.size, threads.FEW)
        return np.asarray(np.sum(parts, axis=0))

    def slope_field(self, points: Points, surface: Surface) -> FloatArray:
        """Return measured and fitted slopes at points of the surface.

        Parameters
        ----------
        points : Points
            n points on the surface.
        surface : Surface

        Returns
        -------
        (6, n) array
            x and y in mm, measured dh/dx and dh/dy, fitted dh/dx and dh/dy.
        """
        shape = self._shape(surface)
        screen_mm = self._screen_without_gas(points, surface)
        out = np.empty((6, points.t_mm.size))

        def run(start: int, stop: int) -> None:
            """Slopes of a range of the points."""
            fixed = (
                points.rays,
                points.t_mm,
                screen_mm,
                self._pinhole,
                self._plane,
                self._face,
            )
            kernels.slope_field(*fixed, *shape, out, start, stop)

        threads.split_over_threads(run, points.t_mm.size, threads.FEW)
        return out

    def predict_screen(self, points: Points, surface: Surface) -> FloatArray:
        """Predict the screen points that a surface sends the rays to.

        Parameters
        ----------
        points : Points
            n points, which must be on the surface.
        surface : Surface

        Returns
        -------
        (2, n) array
            s_x and s_y in mm.
        """
        shape = self._shape(surface)
        out = np.empty((2, points.t_mm.size))

        def run(start: int, stop: int) -> None:
            """Screen points of a range of the points."""
            fixed = (points.rays, points.t_mm, self._pinhole, self._plane, self._face)
            kernels.predict_screen(*fixed, *shape, out, start, stop)

        threads.split_over_threads(run, points.t_mm.size, threads.FEW)
        if self.geometry.gas_lens is not None:
            out += self._gas_shift_mm(self.geometry.gas_lens, points, surface)
        return out

    def position_mm(self, points: Points) -> FloatArray:
        """x and y (2, n) of the points."""
        return np.asarray(self._pinhole[:2, None] + points.t_mm * points.rays[:2])

    def _screen_without_gas(self, points: Points, surface: Surface) -> FloatArray:
        """Screen points (2, n) that the rays would meet without a front film."""
        if self.geometry.gas_lens is None:
            return points.screen_mm
        return points.screen_mm - self._gas_shift_mm(self.geometry.gas_lens, points, surface)

    def _gas_shift_mm(self, lens: GasLens, points: Points, surface: Surface) -> FloatArray:
        """Shift (2, n) of the screen points by a front film."""
        x_mm, y_mm = self.position_mm(points)
        return lens.find_shift_mm(x_mm, y_mm, surface.sag_mm)

    def _move_range(
        self, points: Points, shape: _Shape, newton: int, start: int, stop: int
    ) -> None:
        """Newton steps of a range of the points towards a surface."""
        kernels.intersect_surface(
            points.rays,
            points.t_mm,
            self._pinhole,
            *shape,
            self.vertex_z_mm,
            newton,
            start,
            stop,
        )

    def _shape(self, surface: Surface) -> _Shape:
        """Arguments of the kernels for a surface."""
        amplitude_mm = surface.hencky_mm * hencky_bowl.excess_rms()
        return surface.polynomial, _EXCESS, amplitude_mm, self.radius_mm


def make_parabola(sag_mm: float, radius_mm: float) -> HeightFunction:
    """Return the paper's starting shape, h = sag (x^2 + y^2) / R^2 (paper, eq. 20).

    Parameters
    ----------
    sag_mm, radius_mm : float

    Returns
    -------
    callable
        h(x, y) in mm.
    """
    return lambda x, y: sag_mm * (x * x + y * y) / radius_mm**2
