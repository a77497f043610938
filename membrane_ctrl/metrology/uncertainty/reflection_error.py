"""What the fitted reflections of a front film leave: a row of the budget, and the zero of the map.

The fit of `figure.reflection_fit` subtracts the reflections with the shares of light and the errors
of form that it found. Their covariance, and the ripple that the fit leaves, remain in the slopes of
the middle of the mirror. The terms hardly notice it, but the height is 0 at the vertex by
definition: an error there moves the whole map.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.figure.reflection_fit import LeftReflections, ReflectionFit
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.zonal_map import ResidualGrid, integrate_residual
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.model.arrays import FloatArray

_POINTS_A_CELL = 4.0  # of the grid that is integrated: nearly no cell is empty
_REACH = 2.5  # half the side of that grid over the radius of the part: slopes are 0 around
_RING = 0.85  # of half the side: from there the height is that of the rest of the map
_VERTEX_MM = 30.0  # around the vertex: the ripple's height there varies by its sigma
# Error of the zero over that by the ripple that the fit leaves: its smooth change hides the slow
# part of an error of form, and pixels at an image's edge have no phase of their own. Films with
# random errors of mounting give 2.1, noise-free.
_HIDDEN = 2.0
_SHUFFLES = 4  # of the ripple, for what its noise alone gives


@dataclass(frozen=True)
class ZeroError:
    """1 sigma of the map's zero, against the map as a whole.

    Attributes
    ----------
    noise_um : float
        By the noise of the pixels around the vertex.
    reflections_um : float
        By what is left of a front film's reflections; 0 for a single film.
    """

    noise_um: float
    reflections_um: float = 0.0

    @property
    def sigma_um(self) -> float:
        """Both together."""
        return math.hypot(self.noise_um, self.reflections_um)


@dataclass(frozen=True)
class ReflectionError:
    """Errors by what the fit of the reflections leaves.

    Attributes
    ----------
    source : Source
        The row of the budget.
    by_fit_um, by_ripple_um : float
        1 sigma of the zero by the covariance of the fit, and by ripple that it does not explain.
    """

    source: Source
    by_fit_um: float
    by_ripple_um: float

    @property
    def zero_um(self) -> float:
        """1 sigma of the zero."""
        return math.hypot(self.by_fit_um, self.by_ripple_um)


def find_reflection_error(
    fit: ReflectionFit, tracer: Tracer, surface: Surface, inverse: FloatArray
) -> ReflectionError | None:
    """Propagate what the fit of the reflections leaves to the parameters and to the zero.

    Parameters
    ----------
    fit : ReflectionFit
    tracer : Tracer
        Of the bench.
    surface : Surface
        The fitted film.
    inverse : (parameters, parameters) array
        Inverse of the normal matrix of the pixels' fit.

    Returns
    -------
    ReflectionError or None
        None if no reflections were removed.
    """
    left = fit.left
    if left is None:
        return None

    # 1. Independent errors of the unknowns, of 1 sigma each, as slopes of the mirror.
    values, vectors = np.linalg.eigh(left.covariance)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))
    modes_mm = np.tensordot(roots.T, left.derivatives_mm, axes=1)
    slopes = _SlopesOfScreen(tracer, surface, left.position_mm)
    modes = [slopes.change(mode_mm) for mode_mm in modes_mm]

    # 2. Their effect on the fit of all pixels: inverse times the sum of basis slopes times slopes.
    radius_mm = surface.radius_mm
    _, of_x, of_y = surface_basis.evaluate_basis(*left.position_mm / radius_mm)
    effects = [
        inverse @ ((of_x @ mode[0] + of_y @ mode[1]) * left.pixels_a_point / radius_mm)
        for mode in modes
    ]
    source = Source(
        "front_film_shares",
        "reflections of the front film: shares of light and form, as fitted",
        float(np.max(left.share_sigmas)),
        np.stack(effects, axis=1),
        common=False,
        paired=False,
    )

    # 3. And on the zero: the height of the map around over that of the vertex.
    grid = _PartGrid(left)
    by_fit_mm = [grid.compute_zero_mm(mode) for mode in modes]
    return ReflectionError(
        source,
        1e3 * math.sqrt(float(np.sum(np.square(by_fit_mm)))),
        1e3 * _ripple_zero_mm(grid, slopes.change(left.ripple_mm)),
    )


def _ripple_zero_mm(grid: "_PartGrid", ripple: FloatArray) -> float:
    """1 sigma of the zero by slopes (2, n) that the fit leaves, beyond their noise.

    The same slopes in another order have the same noise and no coherent part.
    """
    random = np.random.default_rng(1)
    of_noise = [
        grid.compute_rms_mm(random.permutation(ripple, axis=1)) ** 2 for _ in range(_SHUFFLES)
    ]
    square_mm2 = grid.compute_rms_mm(ripple) ** 2 - float(np.mean(of_noise))
    return _HIDDEN * math.sqrt(max(square_mm2, 0.0))


class _SlopesOfScreen:
    """Changes of the mirror's slopes by changes of the screen points, at some places."""

    def __init__(self, tracer: Tracer, surface: Surface, position_mm: FloatArray) -> None:
        self._tracer = tracer
        self._surface = surface

        # Rays d = (P - F) / |P - F| to the points of the surface, and what they see of the screen.
        height_mm = tracer.vertex_z_mm + surface.height(position_mm[0], position_mm[1])
        way_mm = np.vstack([position_mm, height_mm]) - tracer.geometry.pinhole_mm[:, None]
        rays = way_mm / np.linalg.norm(way_mm, axis=0)
        self._points = Points.from_rays(rays, np.zeros_like(position_mm))
        self._points.t_mm[:] = np.linalg.norm(way_mm, axis=0)
        self._screen_mm = tracer.predict_screen(self._points, surface)
        self._unmoved = self._slopes(np.zeros_like(position_mm))

    def change(self, moved_mm: FloatArray) -> FloatArray:
        """Change of the slopes.

        Parameters
        ----------
        moved_mm : (2, n) array
            Change of the screen points.

        Returns
        -------
        (2, n) array
        """
        return self._slopes(moved_mm) - self._unmoved

    def _slopes(self, moved_mm: FloatArray) -> FloatArray:
        self._points.screen_mm[:] = self._screen_mm + moved_mm
        return self._tracer.slope_field(self._points, self._surface)[2:4]


class _PartGrid:
    """A grid about the vertex over the part with reflections and the mirror around it."""

    def __init__(self, left: LeftReflections) -> None:
        # A grid about the vertex, wider than the part with reflections: the mirror around it is
        # what the zero is counted from. Its cells have some points each, on the part's ellipse.
        position_mm = left.position_mm
        reach_mm = float(np.max(np.hypot(*position_mm)))
        area_mm2 = np.pi * (np.ptp(position_mm[0]) / 2) * (np.ptp(position_mm[1]) / 2)
        step_mm = math.sqrt(_POINTS_A_CELL * area_mm2 / position_mm.shape[1])
        half = math.ceil(_REACH * reach_mm / step_mm)
        self._axis_mm: FloatArray = step_mm * np.arange(-half, half + 1, dtype=float)

        # The cell of each point: the nearest middle, with the vertex in the middle of the grid.
        side = self._axis_mm.size
        column, row = np.rint(position_mm / step_mm).astype(int) + half
        self._cell = row * side + column
        self._count = np.bincount(self._cell, minlength=side**2)

        # The mirror around the part, and the cells near the vertex.
        x_mm, y_mm = np.meshgrid(self._axis_mm, self._axis_mm)
        from_vertex_mm = np.hypot(x_mm, y_mm)
        self._ring = from_vertex_mm > _RING * self._axis_mm[-1]
        self._middle = from_vertex_mm < _VERTEX_MM

    def compute_zero_mm(self, slopes: FloatArray) -> float:
        """Height at the vertex by slopes (2, n) of the part, against the mirror around."""
        height_mm = self._integrate(slopes)
        return -float(height_mm[self._ring].mean())

    def compute_rms_mm(self, slopes: FloatArray) -> float:
        """RMS of the height around the vertex by slopes (2, n), against the mirror around."""
        height_mm = self._integrate(slopes)
        around_mm = height_mm[self._ring].mean()
        return float(np.sqrt(np.mean(np.square(height_mm[self._middle] - around_mm))))

    def _integrate(self, slopes: FloatArray) -> FloatArray:
        """Height (m, m), 0 at the vertex; cells without a point have no slope."""
        # Means over the cells, then heights whose differences fit the slopes best.
        side = self._axis_mm.size
        count = np.maximum(self._count, 1)
        slope_x, slope_y = (
            (np.bincount(self._cell, slope, side**2) / count).reshape(side, side)
            for slope in slopes
        )
        everywhere = np.ones((side, side))
        return integrate_residual(ResidualGrid(self._axis_mm, slope_x, slope_y, everywhere))
