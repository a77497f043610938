"""The points that a full cycle hands on to the fringes-only cycles after it, and all that is known of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config import PatternConfig
from membrane_ctrl.metrology.bins import BinGrid
from membrane_ctrl.metrology.fit import NormalMatrix
from membrane_ctrl.metrology.motion import sensitivity_mm_per_um
from membrane_ctrl.metrology.phasor import FOLLOWED_ROWS
from membrane_ctrl.metrology.reconstruct import Points, Tracer, parabola, solve
from membrane_ctrl.metrology.surface import Surface
from membrane_ctrl.metrology.unwrap import centre_phase_rad, mm_per_rad, screen_mm

FloatArray = NDArray[np.float64]

_START_SAG_MM = 40.0  # the paper's starting parabola; any other leads to the same end
_OUTLIER_SIGMAS = 8.0  # of the slopes' robust scatter: dust and glints, never noise
_MIN_POINTS = 1000  # far more than 36 unknowns, far fewer than any real view of the mirror


@dataclass
class TrackedPoints:
    """Points inside the analysis radius, with the last accepted phase of each.

    Attributes
    ----------
    index : (n,) int array
        Bin of each point.
    points : Points
        Rays, screen points, weights.
    offset_mm : (2, n) array
        To be taken from T phi / (2 pi): the phase at O', and what averaging over a bin adds.
    sensitivity_rad_per_um : (2, n) array
        Change of phase per um of displacement.
    area_mm2 : (n,) array
        Area of the mirror that a bin sees.
    surface, normal
        Last solution, and the normal matrix of the full cycle.
    accepted, fresh : (2, FOLLOWED_ROWS, n) arrays
        Rows of `phasor.track` for x and y: of the last accepted cycle, and memory for the next.
    """

    index: NDArray[np.int64]
    points: Points
    offset_mm: FloatArray
    sensitivity_rad_per_um: FloatArray
    area_mm2: FloatArray
    surface: Surface
    normal: NormalMatrix
    accepted: FloatArray
    fresh: FloatArray

    def accept(self, surface: Surface, usable: NDArray[np.bool_]) -> None:
        """Make the fresh phases the reference; points that gave none keep theirs."""
        blind = np.flatnonzero(~usable)
        self.fresh[:, :, blind] = self.accepted[:, :, blind]
        self.accepted, self.fresh = self.fresh, self.accepted
        self.surface = surface


def establish(
    grid: BinGrid,
    tracer: Tracer,
    candidates: NDArray[np.int64],
    phase_rad: FloatArray,
    pattern: PatternConfig,
    analysis_radius_mm: float,
) -> TrackedPoints:
    """Choose the points of a full cycle, fit their surface and work out what must be known of each.

    Parameters
    ----------
    candidates : (n,) int array
        Bins that may see the mirror.
    phase_rad : (2, n) array
        Their absolute phases; NaN where a bin is not usable.

    Raises
    ------
    ValueError
        If too few bins see the pattern in the mirror to fit a surface.
    """
    finite = np.isfinite(phase_rad).all(axis=0)
    index, phase_rad = candidates[finite], phase_rad[:, finite]
    if index.size < _MIN_POINTS:
        raise ValueError(f"only {index.size} bins see the pattern in the mirror")
    points = Points.of(grid.rays[:, index], screen_mm(phase_rad, pattern))
    fit = solve(tracer, points, parabola(_START_SAG_MM, tracer.radius_mm))
    for wanted in (_inside_radius, _without_outliers):
        keep = wanted(tracer, points, fit.surface, analysis_radius_mm)
        points, index, phase_rad = points.subset(keep), index[keep], phase_rad[:, keep]
        if index.size < _MIN_POINTS:
            raise ValueError(f"only {index.size} bins see the pattern inside the analysis radius")
        fit = solve(tracer, points, fit.surface)
    tracer.intersect(points, fit.surface)
    field = tracer.slope_field(points, fit.surface)
    # area of the mirror, seen from above, in a bundle of rays: solid angle t^2 / |d . (-h_x, -h_y, 1)|
    facing = np.abs(points.rays[2] - field[4] * points.rays[0] - field[5] * points.rays[1])
    scale = mm_per_rad(pattern)
    accepted = np.zeros((2, FOLLOWED_ROWS, index.size))
    accepted[:, 0] = phase_rad
    accepted[:, 1], accepted[:, 2] = np.cos(accepted[:, 0]), np.sin(accepted[:, 0])
    return TrackedPoints(
        index=index,
        points=points,
        offset_mm=grid.averaging_bias_mm(tracer, points, fit.surface, index) + centre_phase_rad(pattern) * scale,
        sensitivity_rad_per_um=sensitivity_mm_per_um(tracer, points, fit.surface) / scale,
        area_mm2=grid.solid_angle(index) * points.t_mm**2 / facing,
        surface=fit.surface,
        normal=fit.normal,
        accepted=accepted,
        fresh=np.zeros_like(accepted),
    )


def _inside_radius(tracer: Tracer, points: Points, _surface: Surface, radius_mm: float) -> NDArray[np.bool_]:
    x, y = tracer.position_mm(points)
    return np.asarray(x**2 + y**2 <= radius_mm**2)


def _without_outliers(tracer: Tracer, points: Points, surface: Surface, _radius_mm: float) -> NDArray[np.bool_]:
    """Slopes within some robust sigmas of the fit, in both directions."""
    field = tracer.slope_field(points, surface)
    residual = np.hypot(field[2] - field[4], field[3] - field[5])
    # median of a Rayleigh distribution: 1.177 sigma; the floor is the rounding of a noise-free set
    sigma = max(float(np.median(residual)) / 1.177, 1e-9)
    return np.asarray(residual <= _OUTLIER_SIGMAS * sigma)
