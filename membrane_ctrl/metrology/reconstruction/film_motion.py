"""Correction of the phase for the film's known motion between the frames.

A point's phase at displacement d is phi + q (d - d0), with q = d phi / d d known from the model (a
Hencky bowl whose sag grows by one micrometre while the ring stays). Frame k then shows A + Re(z
exp(i d_k) exp(i q e_k)) with e_k = d(t_k) - d0, where z = B exp(i phi) and d_k is the phase step.
With the complex weights w_k = cosine_k + i sine_k of the phase steps (sum w = 0, sum w cos d_k = 1,
sum w sin d_k = -i) the estimate is

    z' = T z + M conj z,   T = 1 + i q turn - q^2 turn_2 / 2,   M = -i q mirror - q^2 mirror_2 / 2,
    turn_n = 1/2 sum w_k e_k^n exp(i d_k),   mirror_n = 1/2 sum w_k e_k^n exp(-i d_k),

to second order, so z = (conj T z' - M conj z') / (|T|^2 - |M|^2). A constant e gives turn = e and
mirror = 0: a plain shift of phase. Counting e from one d0 for both axes therefore also brings x and
y, taken at different times, to one moment.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase import bin_phasors, phase_steps
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import bin_grid, surface_fit
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray


def combine_steps(
    weights: FloatArray, shifts_rad: FloatArray, bin_px: int, motion_um: FloatArray | None = None
) -> bin_phasors.StepCombination:
    """How the frames of one axis combine, for bin sums.

    Parameters
    ----------
    weights : (3, N) array
        `phase.step_weights(shifts_rad)`.
    motion_um : (N,) array, optional
        Displacement of each frame relative to one d0 for both axes.
    """
    _, cosine, sine = weights / bin_px**2
    if motion_um is None:
        return bin_phasors.StepCombination(cosine, sine)
    # of a phasor per pixel: the bin's area cancels
    moved = (weights[1] + 1j * weights[2]) / 2 * motion_um ** np.array([[1], [2]])
    return bin_phasors.StepCombination(
        cosine, sine, *(moved @ np.exp(sign * 1j * shifts_rad) for sign in (1, -1))
    )


def worth_correcting(displacement_um: FloatArray, noise_um: float) -> bool:
    """Whether the readings show motion beyond the laser's noise.

    A swing of 1 µm standard deviation left in the frames costs 0.3 µm RMS of figure; correcting
    with 1 µm of pure noise costs 0.12 µm (both measured on the twin). Above 1.5 times the noise
    nearly all of it is motion.
    """
    return bool(np.all(np.isfinite(displacement_um)) and np.std(displacement_um) > 1.5 * noise_um)


def sensitivity_mm_per_um(
    tracer: surface_fit.Tracer, points: surface_fit.Points, surface: Surface, step_um: float = 10.0
) -> FloatArray:
    """Change (2, n) of the screen points per µm of displacement, by a central difference of the
    traced model.

    The bowl's sag grows by the displacement and its vertex moves towards -z, so that the ring stays
    where it is.
    """
    traced = []
    for sign in (1.0, -1.0):
        deeper_mm = sign * step_um * 1e-3
        bowl = Surface.hencky_bowl(deeper_mm, surface.radius_mm)
        moved = Surface.from_parameters(surface.parameters + bowl.parameters, surface.radius_mm)
        bench = surface_fit.Tracer(
            tracer.geometry, tracer.radius_mm, tracer.vertex_z_mm - deeper_mm
        )
        there = surface_fit.Points(
            points.rays, points.screen_mm, points.weights, points.t_mm.copy()
        )
        bench.intersect(there, moved, newton=3)
        traced.append(bench.predict_screen(there, moved))
    return (traced[0] - traced[1]) / (2 * step_um)


# The points that a full cycle passes on to the fringes-only cycles after it, with the data of each.

_START_SAG_MM = 40.0  # the paper's starting parabola; any other leads to the same result
_OUTLIER_SIGMAS = 8.0  # of the slopes' robust scatter: dust and glints, never noise
_MIN_POINTS = 1000  # far more than the unknowns, far fewer than any real view of the mirror


@dataclass
class TrackedPoints:
    """Points inside the analysis radius, with the last accepted phase of each."""

    index: IntArray  # (n,): bin of each point
    points: surface_fit.Points  # rays, screen points, weights
    # (2, n): subtracted from T phi / (2 pi): the phase at O', and what averaging over a bin adds
    offset_mm: FloatArray
    sensitivity_rad_per_um: FloatArray  # (2, n): change of phase per µm of displacement
    area_mm2: FloatArray  # (n,): area of the mirror that a bin sees
    surface: Surface  # last solution
    normal: surface_fit.NormalMatrix
    # (2, FOLLOWED_ROWS, n): rows of `phasor.track` for x and y of the last accepted cycle
    accepted: FloatArray
    fresh: FloatArray  # memory for the next

    def accept(self, surface: Surface, usable: BoolArray) -> None:
        """Make the fresh phases the reference; points that gave none keep theirs."""
        blind = np.flatnonzero(~usable)
        self.fresh[:, :, blind] = self.accepted[:, :, blind]
        self.accepted, self.fresh = self.fresh, self.accepted
        self.surface = surface


def establish(
    grid: bin_grid.BinGrid,
    tracer: surface_fit.Tracer,
    candidates: IntArray,
    phase_rad: FloatArray,
    pattern: PatternConfig,
    analysis_radius_mm: float,
) -> TrackedPoints:
    """Choose the points of a full cycle, fit their surface and compute the data of each.

    Raises ValueError if too few bins see the pattern in the mirror to fit a surface.

    Parameters
    ----------
    candidates : (n,) int array
        Bins that may see the mirror.
    phase_rad : (2, n) array
        Their absolute phases; NaN where a bin is not usable.
    """
    finite = np.isfinite(phase_rad).all(axis=0)
    index, phase_rad = candidates[finite], phase_rad[:, finite]
    if index.size < _MIN_POINTS:
        raise ValueError(f"only {index.size} bins see the pattern in the mirror")
    points = surface_fit.Points.of(grid.rays[:, index], phase_steps.screen_mm(phase_rad, pattern))
    fit = surface_fit.solve(tracer, points, surface_fit.parabola(_START_SAG_MM, tracer.radius_mm))
    for wanted in (_inside_radius, _without_outliers):
        keep = wanted(tracer, points, fit.surface, analysis_radius_mm)
        points, index, phase_rad = points.subset(keep), index[keep], phase_rad[:, keep]
        if index.size < _MIN_POINTS:
            raise ValueError(f"only {index.size} bins see the pattern inside the analysis radius")
        fit = surface_fit.solve(tracer, points, fit.surface)
    tracer.intersect(points, fit.surface)
    field = tracer.slope_field(points, fit.surface)
    # area of the mirror, seen from above, in a bundle of rays: solid angle t^2 / |d . (-h_x, -h_y,
    # 1)|
    facing = np.abs(points.rays[2] - field[4] * points.rays[0] - field[5] * points.rays[1])
    scale = phase_steps.mm_per_rad(pattern)
    accepted = np.zeros((2, bin_phasors.FOLLOWED_ROWS, index.size))
    accepted[:, 0] = phase_rad
    accepted[:, 1], accepted[:, 2] = np.cos(accepted[:, 0]), np.sin(accepted[:, 0])
    return TrackedPoints(
        index=index,
        points=points,
        offset_mm=grid.averaging_bias_mm(tracer, points, fit.surface, index)
        + phase_steps.centre_phase_rad(pattern) * scale,
        sensitivity_rad_per_um=sensitivity_mm_per_um(tracer, points, fit.surface) / scale,
        area_mm2=grid.solid_angle(index) * points.t_mm**2 / facing,
        surface=fit.surface,
        normal=fit.normal,
        accepted=accepted,
        fresh=np.zeros_like(accepted),
    )


def _inside_radius(
    tracer: surface_fit.Tracer, points: surface_fit.Points, _surface: Surface, radius_mm: float
) -> BoolArray:
    x, y = tracer.position_mm(points)
    return np.asarray(x**2 + y**2 <= radius_mm**2)


def _without_outliers(
    tracer: surface_fit.Tracer, points: surface_fit.Points, surface: Surface, _radius_mm: float
) -> BoolArray:
    """Slopes within some robust sigmas of the fit, in both directions."""
    field = tracer.slope_field(points, surface)
    residual = np.hypot(field[2] - field[4], field[3] - field[5])
    # median of a Rayleigh distribution: 1.177 sigma; the floor is the rounding of a noise-free set
    sigma = max(float(np.median(residual)) / 1.177, 1e-9)
    return np.asarray(residual <= _OUTLIER_SIGMAS * sigma)
