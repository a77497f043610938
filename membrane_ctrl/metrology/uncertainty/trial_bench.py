"""A thinned set on its bench, which solves for the surface when an input is disturbed.

All sensitivities and Monte Carlo trials use it: a few thousand points, and one to three
Gauss-Newton steps from the fitted surface to the disturbed one.
"""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure import bin_figure
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays import bench_poses, ray_tracing
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction import (
    film_motion,
    normal_matrix,
    slope_noise,
    surface_fit,
)
from membrane_ctrl.metrology.reconstruction.normal_matrix import NormalMatrix
from membrane_ctrl.metrology.uncertainty.geometry_spread import moved_bench
from membrane_ctrl.model.arrays import ArrayLike, BoolArray, FloatArray

# 170 for each parameter: the errors of a geometry are smooth, and a trial takes about a
# millisecond.
TRIAL_POINTS = 6000
_GOLDEN_RATIO = (np.sqrt(5) - 1) / 2


@dataclass(frozen=True)
class TrialBench:
    """All that the trials of one set need; half a megabyte, so that it can be sent to where they
    run.

    Attributes
    ----------
    optics : OpticsConfig
        The bench, with the nominal geometry.
    vertex_z_mm : float
        Height of the vertex.
    column_px, row_px : (n,) arrays
        The points in the picture.
    screen_mm : (2, n) array
        Where the fitted surface sends them on the screen.
    residual_mm : (2, n) array
        Where they were seen, less that.
    sigma_mm : (2, n) array
        Standard uncertainty of where they were seen, from noise.
    t_mm : (n,) array
        Lengths of their rays.
    surface : Surface
        The fitted surface.
    normal : NormalMatrix
        Matrix of its least squares.
    """

    optics: OpticsConfig
    vertex_z_mm: float
    column_px: FloatArray
    row_px: FloatArray
    screen_mm: FloatArray
    residual_mm: FloatArray
    sigma_mm: FloatArray
    t_mm: FloatArray
    surface: Surface
    normal: normal_matrix.NormalMatrix

    @classmethod
    def from_set(
        cls,
        optics: OpticsConfig,
        checked: Checked,
        figure: bin_figure.BinFigure,
        count: int = TRIAL_POINTS,
    ) -> "TrialBench":
        """Return the trial bench of a set.

        Parameters
        ----------
        optics : OpticsConfig
            The bench.
        checked : Checked
            The set.
        figure : BinFigure
            Its figure by bins.
        count : int
            About how many of the bins to use.
        """
        places_px = checked.places_px(figure.index)
        return cls.from_points(
            optics,
            checked.tracer,
            figure.fit.surface,
            figure.points,
            places_px,
            figure.sigma_mm,
            count,
        )

    @classmethod
    def from_points(
        cls,
        optics: OpticsConfig,
        tracer: ray_tracing.Tracer,
        surface: Surface,
        points: ray_tracing.Points,
        place_px: FloatArray,
        sigma_mm: FloatArray,
        count: int,
    ) -> "TrialBench":
        """The trial bench of points on a surface.

        Parameters
        ----------
        optics : OpticsConfig
            The bench.
        tracer : Tracer
            Its rays.
        surface : Surface
            The fitted surface.
        points : Points
            n rays, traced to it.
        place_px : (2, n) array
            Columns and rows at which they are seen.
        sigma_mm : (2, n) array
            Standard uncertainty of their screen points.
        count : int
            About how many of them to use.
        """
        chosen = spread_evenly(place_px, optics.camera.width_px, count)
        # Fewer points are as certain together as all of them.
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
        """Return the parameters of the surface that `fit` finds.

        Parameters
        ----------
        there : BenchGeometry
            The bench.
        disturbance_mm : (2, n) array or float
            Error of the screen points.
        linear : bool
            One step of the fit suffices.

        Returns
        -------
        (parameters,) array
            In mm.

        Raises
        ------
        ArithmeticError
            The fit does not converge.
        """
        return self.fit(there, disturbance_mm, linear).surface.parameters

    def fit(
        self, there: BenchGeometry, disturbance_mm: FloatArray | float = 0.0, linear: bool = False
    ) -> surface_fit.Fit:
        """Fit the surface on another bench.

        Parameters
        ----------
        there : BenchGeometry
            The bench.
        disturbance_mm : (2, n) array or float
            Error of the screen points.
        linear : bool
            One step of the fit suffices: the next would change its answer by 1/300.

        Returns
        -------
        Fit

        Raises
        ------
        ArithmeticError
            If the fit does not converge: the geometry is not near the nominal one.
        """
        # The points on that bench.
        geometry = there.geometry
        screen_mm = there.pitch * (self.screen_mm + disturbance_mm)
        tracer = ray_tracing.Tracer(geometry, self.surface.radius_mm, self.vertex_z_mm)
        points = ray_tracing.Points.from_rays(geometry.rays(self.column_px, self.row_px), screen_mm)
        points.t_mm[:] = self.t_mm
        tracer.intersect(points, self.surface, newton=3)

        # The fit with a matrix of its own: a turn of the camera moves the points by centimetres. A
        # fit that diverges is reported below.
        steps = 1 if linear else surface_fit.MAX_ITERATIONS
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                normal = NormalMatrix.from_points(tracer, points)
                fit = surface_fit.fit_surface(
                    tracer, points, self.surface, normal=normal, max_iterations=steps
                )
            except ValueError:
                fit = None
        if fit is not None:
            is_linear_answer = linear and np.isfinite(fit.changes_mm[-1])
            if fit.converged or is_linear_answer:
                return fit
        raise ArithmeticError("a trial did not converge: the geometry's spread is too wide")

    def geometry(self, names: tuple[str, ...] = (), change: ArrayLike = ()) -> BenchGeometry:
        """Return the bench with some of its numbers changed.

        Parameters
        ----------
        names : tuple of str
            k parameters; none for the nominal bench.
        change : (k,) array
            By how much, in the unit of each.
        """
        return moved_bench(self.optics, names, change)

    def slope_variance(self) -> FloatArray:
        """Variance (2,) of an x and of a y slope from the noise."""
        gain = slope_noise.slope_per_screen(
            Geometry.from_config(self.optics), self.surface.radius_mm, self.surface.sag_mm
        )
        return np.asarray(gain @ np.mean(np.square(self.sigma_mm), axis=1))


def spread_evenly(place_px: FloatArray, width_px: int, count: int) -> BoolArray:
    """Choose points by a golden-ratio sequence, evenly along rows and columns.

    A place is chosen in every set or in none, so that sets of one bench can be compared.

    Parameters
    ----------
    place_px : (2, n) array
        Columns and rows of the points.
    width_px : int
        Width of the picture.
    count : int
        About how many points to choose.

    Returns
    -------
    (n,) bool array
    """
    size = place_px.shape[1]
    if size <= count:
        return np.ones(size, bool)
    column, row = np.rint(place_px)
    turn = ((row * width_px + column) * _GOLDEN_RATIO) % 1
    return np.asarray(turn < count / size)


def moved_film(bench: TrialBench, displacement_um: float) -> TrialBench:
    """Return the bench with a bowl that is deeper; the ring stays.

    Parameters
    ----------
    bench : TrialBench
        The bench.
    displacement_um : float
        By how much the vertex is lower.
    """
    deeper_mm = displacement_um * 1e-3
    surface = bench.surface
    bowl = Surface.hencky_bowl(deeper_mm, surface.radius_mm)
    surface = Surface.from_parameters(surface.parameters + bowl.parameters, surface.radius_mm)
    there = replace(bench, surface=surface, vertex_z_mm=bench.vertex_z_mm - deeper_mm)
    return replace(there, screen_mm=predicted_mm(there, bench.geometry(), surface))


def moves_mm(bench: TrialBench, there: bench_poses.BenchGeometry | None = None) -> FloatArray:
    """Return the change of the screen points per µm of the film's displacement.

    Parameters
    ----------
    bench : TrialBench
        n points.
    there : BenchGeometry, optional
        Another bench than the nominal one.

    Returns
    -------
    (2, n) array
        In mm.
    """
    if there is None:
        there = bench.geometry()
    tracer, points = traced_points(bench, there.geometry)
    return film_motion.sensitivity_mm_per_um(tracer, points, bench.surface) / there.pitch


def predicted_mm(
    bench: TrialBench, there: bench_poses.BenchGeometry, surface: Surface
) -> FloatArray:
    """Return where a surface on another bench sends the rays of the points.

    Parameters
    ----------
    bench : TrialBench
        n points.
    there : BenchGeometry
        The other bench.
    surface : Surface
        The surface.

    Returns
    -------
    (2, n) array
        Screen points in mm, in the scale of the stated screen.
    """
    tracer, points = traced_points(bench, there.geometry)
    tracer.intersect(points, surface, newton=3)
    return tracer.predict_screen(points, surface) / there.pitch


def traced_points(
    bench: TrialBench, geometry: Geometry, bent: FloatArray | float = 0.0
) -> tuple[Tracer, Points]:
    """Return the points of a bench with another geometry, near the surface.

    Parameters
    ----------
    bench : TrialBench
        n points.
    geometry : Geometry
        The other geometry.
    bent : (3, n) array, optional
        Added to the directions of their rays.

    Returns
    -------
    Tracer, Points
    """
    points = Points.from_rays(geometry.rays(bench.column_px, bench.row_px) + bent, bench.screen_mm)
    points.t_mm[:] = bench.t_mm
    return Tracer(geometry, bench.surface.radius_mm, bench.vertex_z_mm), points
