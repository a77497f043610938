"""The points that a full cycle passes on to the fringes-only cycles after it, with the data of
each.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase import bin_sums, screen_scale
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import (
    bin_grid,
    normal_matrix,
    smooth_fields,
    surface_fit,
)
from membrane_ctrl.metrology.reconstruction.film_motion import sensitivity_mm_per_um
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray

_START_SAG_MM = 40.0  # the paper's starting parabola; any other leads to the same result
_FIRST_POINTS = 8000  # of the first surface, which only starts the fit of all
_PLACING_STEPS = 3  # towards a parabola near it; Newton steps do the rest
_OUTLIER_SIGMAS = 8.0  # of the slopes' robust scatter: dust and glints, never noise
_RAYLEIGH_MEDIAN = 1.177  # median of a Rayleigh distribution, in sigmas
_LEAST_SLOPE = 1e-9  # floor of that scatter: the rounding of a noise-free set
_EVERY = 7  # residuals between those of which the median is taken
_MIN_POINTS = 1000  # far more than the unknowns, far fewer than any real view of the mirror


@dataclass
class TrackedPoints:
    """Points inside the analysis radius, with the last accepted phase of each.

    Attributes
    ----------
    index : (n,) int array
        Bin of each point.
    points : ray_tracing.Points
        Rays, screen points, weights.
    offset_mm : (2, n) array
        Subtracted from T phi / (2 pi): the phase at O', and what averaging over a bin adds.
    sensitivity_rad_per_um : (2, n) array
        Change of phase per µm of displacement.
    area_mm2 : (n,) array
        Area of the mirror that a bin sees.
    surface : Surface
        Last solution.
    normal : normal_matrix.NormalMatrix
    accepted : (2, FOLLOWED_ROWS, n) array
        Rows of `phase_change.update_phases` for x and y, of the last accepted cycle.
    fresh : (2, FOLLOWED_ROWS, n) array
        The same of the next cycle.
    """

    index: IntArray
    points: ray_tracing.Points
    offset_mm: FloatArray
    sensitivity_rad_per_um: FloatArray
    area_mm2: FloatArray
    surface: Surface
    normal: normal_matrix.NormalMatrix
    accepted: FloatArray
    fresh: FloatArray

    def accept(self, surface: Surface, usable: BoolArray) -> None:
        """Make the fresh phases the reference for the next cycle.

        Parameters
        ----------
        surface : Surface
            The surface of the cycle.
        usable : (n,) bool array
            Points that gave a phase; the others keep theirs.
        """
        not_usable = np.flatnonzero(~usable)
        self.fresh[:, :, not_usable] = self.accepted[:, :, not_usable]
        before = self.accepted
        self.accepted = self.fresh
        self.fresh = before
        self.surface = surface


def select_points(
    grid: bin_grid.BinGrid,
    tracer: ray_tracing.Tracer,
    candidates: IntArray,
    phase_rad: FloatArray,
    pattern: PatternConfig,
    analysis_radius_mm: float,
) -> TrackedPoints:
    """Choose the points of a full cycle, fit their surface and compute the data of each.

    Parameters
    ----------
    grid : BinGrid
        The bins.
    tracer : Tracer
        The bench.
    candidates : (n,) int array
        Bins that may see the mirror.
    phase_rad : (2, n) array
        Their absolute phases; NaN where a bin is not usable.
    pattern : PatternConfig
        The pattern on the screen.
    analysis_radius_mm : float
        Points beyond it are left out.

    Returns
    -------
    TrackedPoints

    Raises
    ------
    ValueError
        Too few bins see the pattern in the mirror to fit a surface.
    """
    # All usable bins, on a surface through some of them.
    finite = np.isfinite(phase_rad).all(axis=0)
    index = candidates[finite]
    phase_rad = np.compress(finite, phase_rad, axis=1)
    if index.size < _MIN_POINTS:
        raise ValueError(f"only {index.size} bins see the pattern in the mirror")
    points = ray_tracing.Points.from_rays(
        np.take(grid.rays, index, axis=1), screen_scale.screen_mm(phase_rad, pattern)
    )
    surface = _fit_some(tracer, points)
    near = ray_tracing.make_parabola(surface.sag_mm, tracer.radius_mm)
    tracer.place_on_shape(points, near, steps=_PLACING_STEPS)
    tracer.intersect(points, surface, newton=3)

    # Without bins outside the analysed radius, then without outliers of the surface through all:
    # one through some would be bent by wrinkles that it happens to meet. Mostly there are none.
    chosen = np.flatnonzero(_inside_radius(tracer, points, analysis_radius_mm))
    fit, points = _fit_chosen(tracer, points, chosen, surface)
    sound = np.flatnonzero(_without_outliers(tracer, points, fit.surface))
    if sound.size < chosen.size:
        chosen = chosen[sound]
        fit, points = _fit_chosen(tracer, points, sound, fit.surface)
    index = index[chosen]
    phase_rad = np.take(phase_rad, chosen, axis=1)
    tracer.intersect(points, fit.surface)

    # From phase to place on the screen; the effect of the film's displacement; the bins' areas.
    mm_per_rad = screen_scale.mm_per_rad(pattern)

    def trace_some(some: IntArray) -> FloatArray:
        """Fields (5, m) at some of the points."""
        there = points.subset(some)
        return np.vstack(
            [
                grid.averaging_bias_mm(tracer, there, fit.surface, index[some]),
                sensitivity_mm_per_um(tracer, there, fit.surface) / mm_per_rad,
                _seen_area_mm2(grid, tracer, there, fit.surface, index[some])[None],
            ]
        )

    fields = smooth_fields.interpolate_fields(trace_some, index, grid.columns)
    offset_mm = fields[:2] + screen_scale.centre_phase_rad(pattern) * mm_per_rad

    # The phases that fringes-only cycles continue from, with their cosines and sines.
    accepted = np.zeros((2, bin_sums.FOLLOWED_ROWS, index.size))
    accepted[:, 0] = phase_rad
    # Within a period, single precision holds an angle to 1e-7 rad, in a tenth of the time.
    wrapped_rad = phase_rad - 2 * np.pi * np.rint(phase_rad / (2 * np.pi))
    accepted[:, 1] = np.cos(wrapped_rad.astype(np.float32))
    accepted[:, 2] = np.sin(wrapped_rad.astype(np.float32))
    return TrackedPoints(
        index=index,
        points=points,
        offset_mm=offset_mm,
        sensitivity_rad_per_um=fields[2:4],
        area_mm2=fields[4],
        surface=fit.surface,
        normal=fit.normal,
        accepted=accepted,
        fresh=np.zeros_like(accepted),
    )


def _fit_some(tracer: ray_tracing.Tracer, points: ray_tracing.Points) -> Surface:
    """Surface through some of the points."""
    count = min(_FIRST_POINTS, points.t_mm.size)
    some = points.subset(np.linspace(0, points.t_mm.size - 1, count).astype(int))
    start = ray_tracing.make_parabola(_START_SAG_MM, tracer.radius_mm)
    return surface_fit.fit_surface(tracer, some, start).surface


def _fit_chosen(
    tracer: ray_tracing.Tracer, points: ray_tracing.Points, chosen: IntArray, start: Surface
) -> tuple[surface_fit.Fit, ray_tracing.Points]:
    """Fit the chosen points, which are returned. Raises ValueError if there are too few."""
    if chosen.size < _MIN_POINTS:
        raise ValueError(f"only {chosen.size} bins see the pattern inside the analysis radius")
    points = points.subset(chosen)
    return surface_fit.fit_surface(tracer, points, start), points


def _inside_radius(
    tracer: ray_tracing.Tracer, points: ray_tracing.Points, radius_mm: float
) -> BoolArray:
    """Points within a radius."""
    x, y = tracer.position_mm(points)
    return np.asarray(x**2 + y**2 <= radius_mm**2)


def _without_outliers(
    tracer: ray_tracing.Tracer, points: ray_tracing.Points, surface: Surface
) -> BoolArray:
    """Slopes within some robust sigmas of the fit, in both directions."""
    field = tracer.slope_field(points, surface)
    square = np.square(field[2] - field[4]) + np.square(field[3] - field[5])
    sigma = max(math.sqrt(np.median(square[::_EVERY])) / _RAYLEIGH_MEDIAN, _LEAST_SLOPE)
    return np.asarray(square <= (_OUTLIER_SIGMAS * sigma) ** 2)


def _seen_area_mm2(
    grid: bin_grid.BinGrid,
    tracer: ray_tracing.Tracer,
    points: ray_tracing.Points,
    surface: Surface,
    index: IntArray,
) -> FloatArray:
    """Area of the mirror, seen from above, in the bundle of rays of each bin (n,).

    Solid angle t^2 / |d (-h_x, -h_y, 1)|.
    """
    field = tracer.slope_field(points, surface)
    facing = np.abs(points.rays[2] - field[4] * points.rays[0] - field[5] * points.rays[1])
    return np.asarray(grid.solid_angle(index) * points.t_mm**2 / facing)
