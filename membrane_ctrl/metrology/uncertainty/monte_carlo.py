"""Monte Carlo over geometry and pixel noise (the paper's section 3.1), on a few thousand bins.

A trial of the paper disturbs the frames of every pixel and reconstructs them anew. The disturbance
of a bin's phase by white noise of the pixels is known: sigma sqrt(2 / N) / (B m) for bins of m x m
pixels. A few thousand of the bins determine the terms: one in k, each with a k-th of the variance,
gives the fit the same covariance as all of them. A trial therefore draws a geometry, disturbs the
screen points that the fitted surface predicts, and takes the two or three Gauss-Newton steps from
the fitted surface to the disturbed one.

Seeds: the geometry of trial t comes from (seed, 0, t), the noise of set s in it from (seed, 1 + s,
t): independent of the order, of the number of workers and of what else is in the run, and the
geometry is common to all sets.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure import pixel_figure
from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface, parameter_to_coeffs
from membrane_ctrl.metrology.reconstruction import normal_matrix, slope_noise, surface_fit
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread, moved_bench
from membrane_ctrl.model.arrays import ArrayLike, BoolArray, FloatArray

# 170 a parameter: errors of a geometry are smooth and need fewer; a trial then takes about a
# millisecond
TRIAL_POINTS = 6000


@dataclass(frozen=True)
class TrialBench:
    """All that the trials of one set need; half a megabyte, so that it can be sent to where they
    run.
    """

    optics: OpticsConfig  # with the nominal geometry
    vertex_z_mm: float  # position of the vertex
    column_px: FloatArray  # (n,): the points in the picture
    row_px: FloatArray  # (n,)
    screen_mm: FloatArray  # (2, n): where the fitted surface sends them
    residual_mm: FloatArray  # (2, n): where they were seen, less that
    sigma_mm: FloatArray  # (2, n): 1 sigma of noise there
    t_mm: FloatArray  # (n,): lengths of their rays
    surface: Surface
    normal: normal_matrix.NormalMatrix

    @classmethod
    def of(
        cls,
        optics: OpticsConfig,
        checked: Checked,
        figure: pixel_figure.BinFigure,
        count: int = TRIAL_POINTS,
    ) -> "TrialBench":
        """Of a set's figure, its points thinned to about `count`."""
        places_px = checked.places_px(figure.index)
        return cls.of_points(
            optics,
            checked.tracer,
            figure.fit.surface,
            figure.points,
            places_px,
            figure.sigma_mm,
            count,
        )

    @classmethod
    def of_points(
        cls,
        optics: OpticsConfig,
        tracer: ray_tracing.Tracer,
        surface: Surface,
        points: ray_tracing.Points,
        place_px: FloatArray,
        sigma_mm: FloatArray,
        count: int,
    ) -> "TrialBench":
        """Of points that stand on a surface, seen at `place_px` (2, n),
        thinned to about `count`.
        """
        chosen = spread_evenly(place_px, optics.camera.width_px, count)
        thinning = points.t_mm.size / np.count_nonzero(chosen)
        points = points.subset(chosen)
        column_px, row_px = place_px[:, chosen]
        predicted_mm = tracer.predict_screen(points, surface)
        return cls(
            optics=optics,
            vertex_z_mm=tracer.vertex_z_mm,
            column_px=column_px,
            row_px=row_px,
            screen_mm=predicted_mm,
            residual_mm=points.screen_mm - predicted_mm,
            sigma_mm=sigma_mm[:, chosen] / np.sqrt(thinning),
            t_mm=points.t_mm,
            surface=surface,
            normal=NormalMatrix.from_points(tracer, points),
        )

    def solve(
        self, there: BenchGeometry, disturbance_mm: FloatArray | float = 0.0, linear: bool = False
    ) -> FloatArray:
        """Parameters (parameters,) in mm of the surface on another bench, the screen points (2, n)
        off by a disturbance.

        One step suffices for a `linear` answer: the next would change it by 1/300.

        Raises ArithmeticError if the fit does not converge: the geometry is not near the nominal
        one.
        """
        geometry, screen_mm = there.geometry, there.pitch * (self.screen_mm + disturbance_mm)
        tracer = ray_tracing.Tracer(geometry, self.surface.radius_mm, self.vertex_z_mm)
        points = ray_tracing.Points.of(geometry.rays(self.column_px, self.row_px), screen_mm)
        points.t_mm[:] = self.t_mm
        tracer.intersect(points, self.surface, newton=3)
        steps = 1 if linear else surface_fit.MAX_ITERATIONS
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # of a fit that diverges, which is reported below
            # the nominal points' matrix would not do: a turn of the camera moves them by
            # centimetres
            try:
                normal = NormalMatrix.from_points(tracer, points)
                fit = surface_fit.solve(
                    tracer, points, self.surface, normal=normal, max_iterations=steps
                )
            except ValueError:
                fit = None
        if fit is None or not (fit.converged or (linear and np.isfinite(fit.changes_mm[-1]))):
            raise ArithmeticError("a trial did not converge: the geometry's spread is too wide")
        return fit.surface.parameters

    def geometry(self, names: tuple[str, ...] = (), change: ArrayLike = ()) -> BenchGeometry:
        """The nominal bench, or changed."""
        return moved_bench(self.optics, names, change)

    def slope_variance(self) -> FloatArray:
        """(2,) variance of an x and of a y slope from the noise."""
        gain = slope_noise.slope_per_screen(
            Geometry.from_config(self.optics), self.surface.radius_mm, self.surface.sag_mm
        )
        return np.asarray(gain @ np.mean(np.square(self.sigma_mm), axis=1))


def spread_evenly(place_px: FloatArray, width_px: int, count: int) -> BoolArray:
    """About `count` of the points at `place_px` (2, n) by a golden-ratio sequence: even along rows
    and columns alike.

    A place is chosen in every set or in none, so that sets of one bench can be compared.
    """
    size = place_px.shape[1]
    if size <= count:
        return np.ones(size, bool)
    turn = ((np.rint(place_px[1]) * width_px + np.rint(place_px[0])) * ((np.sqrt(5) - 1) / 2)) % 1
    return np.asarray(turn < count / size)


def run_trials(
    benches: Sequence[TrialBench],
    spread: GeometrySpread,
    seed: int,
    trials: Sequence[int],
    first_set: int = 0,
) -> FloatArray:
    """Parameters (trials, sets, parameters) in mm of the trials with these numbers; all sets share
    the geometry of a trial.

    The benches, one a set, have the same nominal geometry. `first_set` is the number of the first
    set in its run: noise differs from set to set.
    """
    out = np.empty((len(trials), len(benches), PARAMETERS))
    for row, trial in enumerate(trials):
        change = spread.draw(np.random.default_rng((seed, 0, trial)))
        for k, bench in enumerate(benches):
            noise = np.random.default_rng((seed, 1 + first_set + k, trial)).standard_normal(
                bench.sigma_mm.shape
            )
            out[row, k] = bench.solve(bench.geometry(spread.names, change), noise * bench.sigma_mm)
    return out


# From the spread of the parameters to the spread of the height, and the linear covariance beside
# the Monte Carlo.
#
# The fitted height is linear in the parameters, h = P a, so its standard deviation at every point
# follows from their covariance C alone: sigma^2 = diag(P C P^T). With C the sample covariance of
# the trials that is, to the last bit of rounding, the standard deviation over the trials' heights:
# the paper's RMSE map.
#
# Linear: C = J S J^T + C_noise with S the covariance of the geometry and J the change of the
# parameters with it, from two solutions a number (some ms each); J hardly changes while the film
# moves by micrometres, so the live cycle computes it once a full cycle.

MAP_SIDE = 101  # points across a map: 10 mm a cell, far below what the terms can change over


@dataclass(frozen=True)
class HeightMap:
    """Points of a square grid inside a radius, and the matrix that makes heights of parameters
    there.
    """

    axis_mm: FloatArray  # (n,): of x and of y
    inside: BoolArray  # (n, n): rows along y
    matrix: FloatArray  # (points, parameters): heights, 0 at the vertex, of the points inside

    @classmethod
    def over(cls, analysis_radius_mm: float, radius_mm: float, side: int = MAP_SIDE) -> "HeightMap":
        """A grid over the analysis radius; `radius_mm` is that of the Zernike disc."""
        axis = np.linspace(-analysis_radius_mm, analysis_radius_mm, side)
        x, y = np.meshgrid(axis, axis)
        inside = np.hypot(x, y) <= analysis_radius_mm
        return cls(axis, inside, height_matrix(x[inside], y[inside], radius_mm))

    def picture(self, heights: FloatArray) -> FloatArray:
        """(n, n) of values at the points inside; NaN outside."""
        out = np.full(self.inside.shape, np.nan)
        out[self.inside] = heights
        return out

    def sigma(self, covariance: FloatArray) -> FloatArray:
        """(points,) standard deviation for a covariance (parameters, parameters) of the parameters,
        in its unit.
        """
        variance = np.einsum("pi,pi->p", self.matrix @ covariance, self.matrix)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def height_matrix(x_mm: FloatArray, y_mm: FloatArray, radius_mm: float) -> FloatArray:
    """Matrix (points, parameters) from parameters to heights, 0 at the vertex."""
    x, y = np.asarray(x_mm) / radius_mm, np.asarray(y_mm) / radius_mm
    out = np.asarray(zernike.values(x, y).T @ parameter_to_coeffs())
    out[:, -1] += (
        np.polynomial.polynomial.polyval(x * x + y * y, hencky_bowl.excess())
        / hencky_bowl.excess_rms()
    )
    return out


def trial_covariance(parameters: FloatArray) -> FloatArray:
    """Covariance (parameters, parameters) over trials (trials, parameters)."""
    return np.atleast_2d(np.cov(parameters, rowvar=False))


def geometry_jacobian(bench: TrialBench, spread: GeometrySpread) -> FloatArray:
    """Change (parameters, k) of the parameters in mm with each number of the geometry, by central
    differences of one sigma.

    The difference is as wide as the spread itself, so that curvature counts as it does in the
    spread.
    """
    columns = []
    for k, sigma in enumerate(spread.sigmas):
        if sigma == 0:
            columns.append(np.zeros(PARAMETERS))
            continue
        step = np.zeros(len(spread.names))
        step[k] = sigma
        ends = [
            bench.solve(bench.geometry(spread.names, sign * step), linear=True)
            for sign in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / (2 * sigma))
    return np.stack(columns, axis=1) if columns else np.zeros((PARAMETERS, 0))


def noise_covariance(bench: TrialBench) -> FloatArray:
    """Covariance (parameters, parameters) in mm^2 from the noise of the pixels."""
    return slope_noise.parameter_covariance(bench.normal, bench.slope_variance())


def geometry_covariance(jacobian: FloatArray, spread: GeometrySpread) -> FloatArray:
    """Covariance (parameters, parameters) in mm^2 from the geometry; the live cycle reports it
    beside its own.
    """
    return np.asarray(jacobian @ spread.covariance @ jacobian.T)


def linear_covariance(benches: Sequence[TrialBench], spread: GeometrySpread) -> FloatArray:
    """What the Monte Carlo finds, without it: (parameters, parameters) in mm^2.

    With two benches the covariance is that of the change between them: they share the geometry, not
    the noise.
    """
    jacobian = geometry_jacobian(benches[0], spread)
    if len(benches) > 1:
        jacobian = jacobian - geometry_jacobian(benches[1], spread)
    noise: FloatArray = np.sum([noise_covariance(bench) for bench in benches], axis=0)
    return geometry_covariance(jacobian, spread) + noise
