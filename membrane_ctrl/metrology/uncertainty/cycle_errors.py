"""Errors of live cycles beyond the noise of the pixels: what the frames show of them, and what
remains.

The sensitivities are those of the budget of `measure`, computed once, with the first full cycle.
In each cycle, some of its points show what light each frame had and where the film was
(`cycle_frames`); the effect on the figure is removed, and a share of it remains as an error. Errors
that all cycles share count for one figure, but not for a change since the reference cycle: the
first one near the film's present displacement.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig, SigmasConfig
from membrane_ctrl.metrology.frame_checks import picture_blur
from membrane_ctrl.metrology.frame_checks.image_lag import ImageLag
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.rays import ray_tracing
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.reconstruction import (
    bin_grid,
    film_motion,
    surface_fit,
    tracked_points,
)
from membrane_ctrl.metrology.uncertainty import (
    bench_sources,
    film_shape_error,
    frame_effects,
    geometry_spread,
    image_blur,
    laser_errors,
    residual_patches,
    trial_bench,
)
from membrane_ctrl.metrology.uncertainty.cycle_frames import FrameErrors, estimate_frame_errors
from membrane_ctrl.metrology.uncertainty.image_lag_error import image_lag_of_cycles
from membrane_ctrl.metrology.uncertainty.round_slopes import RoundSlopes
from membrane_ctrl.model.arrays import AnyArray, FloatArray, IntArray

# So many points determine light and place of a frame to 1e-4 and 20 nm, a tenth of what remains
# after the correction.
POINTS = 1500
# Share of what the frames show that remains after the correction: higher orders, and light that is
# not even.
_REMAINING = 0.03
# Points for the sensitivities to light. Waves of uneven light nearly cancel over the mirror: fewer
# points would not show what remains of them.
_WAVE_POINTS = 20_000
_SECOND_ORDER = 0.01  # share of the laser's motion that the linear correction leaves
_FAR_UM = 300.0  # displacement over which the sensitivities are compared
# A film this far from the reference cycle makes a new one: changes are stated within a hold, not
# across setpoints.
_REFERENCE_UM = 100.0


@dataclass(frozen=True)
class LiveErrors:
    """Sensitivities of the surface's parameters to the errors of a cycle.

    Attributes
    ----------
    frames : FrameEffects
        Effects of light and film of single frames.
    vertex : (parameters,) array
        Effect of the vertex' place, mm per µm.
    common_mm2 : (parameters, parameters) array
        Covariance of what all cycles share; NaN if the spread of the geometry is unknown or too
        wide.
    per_um2 : (parameters, parameters) array
        Covariance of what remains of that in a change, mm^2 per µm^2 of the film's displacement
        between the cycles.
    corrected_um2 : (parameters, parameters) array
        Covariance of the geometry's effect on the correction for the film's motion: mm^2 per µm^2
        that the film was deeper in x than in y.
    """

    frames: frame_effects.FrameEffects
    vertex: FloatArray
    common_mm2: FloatArray
    per_um2: FloatArray
    corrected_um2: FloatArray

    @classmethod
    def from_benches(
        cls,
        bench: trial_bench.TrialBench,
        wave_bench: trial_bench.TrialBench,
        shifts_rad: FloatArray,
        light: FloatArray,
        seen: FrameErrors,
        spread: geometry_spread.GeometrySpread | None,
        blur_px: float,
        left: FloatArray,
    ) -> "LiveErrors":
        """Compute the sensitivities.

        Parameters
        ----------
        bench : TrialBench
            Some points of a cycle.
        wave_bench : TrialBench
            The many more points, n, that waves of uneven light need.
        shifts_rad : (2, N) array
            Phase steps of x and y.
        light : (2, n) array
            Light over the amplitude of the fringes at the points of `wave_bench`.
        seen : FrameErrors
            What the frames show.
        spread : GeometrySpread or None
            Covariance of the geometry, if known.
        blur_px : float
            Width of the image's blur.
        left : (parameters, k) array
            Effects of the slopes that the fit leaves, mm.
        """
        frames = frame_effects.frame_effects(
            wave_bench, wave_bench.optics, shifts_rad, light, seen.harmonics
        )
        vertex = bench_sources.vertex_source(bench, 1.0, "").effects_mm[:, 0]
        zero = np.zeros((vertex.size, vertex.size))
        unknown = zero + np.nan
        if spread is None:
            return cls(frames, vertex, unknown, zero, zero)
        try:
            shared = _shared_effects(bench, spread, blur_px)

            # The same at another displacement.
            far = trial_bench.moved_film(bench, _FAR_UM)
            per_um = (_shared_effects(far, spread, blur_px) - shared) / _FAR_UM

            # And with a film that is deeper in the x frames than in the y frames.
            x_mm = trial_bench.moved_film(bench, _FAR_UM / 2).screen_mm
            y_mm = trial_bench.moved_film(bench, -_FAR_UM / 2).screen_mm
            moving = replace(bench, screen_mm=np.stack([x_mm[0], y_mm[1]]))
            geometry = _geometry_effects(moving, spread)
            per_corrected_um = (geometry - shared[:, : geometry.shape[1]]) / _FAR_UM
        except ArithmeticError:  # a fit at the spread's end fails
            return cls(frames, vertex, unknown, zero, zero)
        return cls(
            frames,
            vertex,
            common_mm2=shared @ shared.T + left @ left.T,
            per_um2=per_um @ per_um.T,
            corrected_um2=per_corrected_um @ per_corrected_um.T,
        )

    def correction_mm(self, seen: FrameErrors) -> FloatArray:
        """Change (parameters,) that the errors of the frames have made in the parameters."""
        effects = self.frames
        # The phases were corrected for the laser's motion as if the fringes were pure sinusoids.
        display = effects.display @ (seen.corrected_um + seen.moved_um)
        return np.asarray(
            effects.level @ seen.level
            + effects.swing @ seen.swing
            + effects.film @ seen.moved_um
            + display
        )

    def unshared_covariance_mm2(
        self, seen: FrameErrors, readings_um: FloatArray, laser_noise_um: float, moved_um: float
    ) -> FloatArray:
        """Covariance of what the reference cycle does not share, without slopes and pixels.

        Parameters
        ----------
        seen : FrameErrors
            Light and film of the frames, whose effect was removed.
        readings_um : (2 N,) array
            The laser's readings at the frames; NaN without.
        laser_noise_um : float
            Their noise.
        moved_um : float
            The film's displacement since the reference cycle.

        Returns
        -------
        (parameters, parameters) array
            In mm^2.
        """
        # What remains of light and film after the correction, which is linear in the motion.
        light = _REMAINING * _rms(seen.level, seen.swing)
        film_um = _REMAINING * _rms(seen.moved_um)
        has_laser = np.isfinite(readings_um).all()
        if has_laser:
            film_um += _SECOND_ORDER * float(np.std(readings_um))

        # What the laser leaves unknown: motion from x to y, and the vertex. Without it, half of
        # that motion is in the mean of the frames.
        x_to_y_um = laser_errors.left_by_laser_um(readings_um, _rms(seen.moved_um), laser_noise_um)
        vertex_um = laser_errors.vertex_um(readings_um, laser_noise_um)
        if not has_laser:
            vertex_um = math.hypot(vertex_um, x_to_y_um / 2)

        effects = [
            light * self.frames.level,
            light * self.frames.swing,
            film_um * self.frames.film,
            x_to_y_um * self.frames.x_to_y[:, None],
            vertex_um * self.vertex[:, None],
        ]

        # Errors that cycles share cancel but for the film's displacement between them.
        x_um, y_um = (part.mean() for part in np.split(seen.corrected_um, 2))
        corrected_um = float(np.subtract(x_um, y_um))
        shared_mm2 = moved_um**2 * self.per_um2 + corrected_um**2 * self.corrected_um2
        return np.asarray(sum(effect @ effect.T for effect in effects) + shared_mm2)


def _shared_effects(
    bench: trial_bench.TrialBench, spread: geometry_spread.GeometrySpread, blur_px: float
) -> FloatArray:
    """Effects (parameters, k), mm, of what all cycles share; those of the geometry are first.

    Raises ArithmeticError if a fit at the spread's end fails.
    """
    sigmas = bench.optics.geometry.sigmas or SigmasConfig()
    sources = [
        *bench_sources.bench_sources(bench, sigmas),
        image_blur.blur_source(bench, blur_px),
    ]
    geometry = _geometry_effects(bench, spread)
    return np.concatenate([geometry, *(source.effects_mm for source in sources)], axis=1)


def _geometry_effects(
    bench: trial_bench.TrialBench, spread: geometry_spread.GeometrySpread
) -> FloatArray:
    """Effects (parameters, k), mm, of the geometry's spread."""
    sources = bench_sources.geometry_sources(bench, spread)
    return np.concatenate([source.effects_mm for source in sources], axis=1)


@dataclass(frozen=True)
class Cycle:
    """The fitted points of one cycle.

    Attributes
    ----------
    tracer : Tracer
        The bench.
    state : TrackedPoints
        The points with their newest phases.
    fit : Fit
        The surface through them.
    sums : two (N, bins) arrays
        Bin sums of the sinusoids of x and of y.
    readings_um : (2 N,) array
        Laser readings; NaN without.
    """

    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints
    fit: surface_fit.Fit
    sums: Sequence[AnyArray]
    readings_um: FloatArray


@dataclass(frozen=True)
class CycleErrors:
    """What is known of the errors of one cycle.

    Attributes
    ----------
    correction_mm : (parameters,) array
        To be subtracted from the parameters.
    own_mm2 : (parameters, parameters) array
        Covariance of what the reference cycle does not share, without slopes and pixels.
    changed_rad2 : (2,) array
        Variance of the phases' change since the reference that no surface explains.
    known_points : int
        Number of points at which that change is known.
    points : (n,) int array
        Those of the tracked points that were examined.
    changed_rad : (2, n) array
        Their phases less the surface's, less those of the reference cycle; NaN where unknown.
    is_reference : bool
        Whether later cycles are compared with this one.
    """

    correction_mm: FloatArray
    own_mm2: FloatArray
    changed_rad2: FloatArray
    known_points: int
    points: IntArray
    changed_rad: FloatArray
    is_reference: bool


class ErrorWatch:
    """Follows the errors of a reconstructor's cycles.

    Parameters
    ----------
    optics : OpticsConfig
        The bench.
    grid : BinGrid
        Its bins.
    shape : (rows, columns)
        Number of the bins.
    bin_px : int
        Their side.
    shifts_rad : (2, N) array
        Phase steps of x and y.
    laser_noise_um : float
        Noise of the laser's readings.
    spread : GeometrySpread or None
        Covariance of the geometry, if known.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        grid: bin_grid.BinGrid,
        shape: tuple[int, int],
        bin_px: int,
        shifts_rad: FloatArray,
        laser_noise_um: float,
        spread: geometry_spread.GeometrySpread | None,
    ) -> None:
        self._optics = optics
        self._shape = shape
        self._bin_px = bin_px
        self._places_px = np.stack([grid.column_px, grid.row_px])
        self._shifts_rad = shifts_rad
        self._weights = np.stack([phase_steps.step_weights(shifts) for shifts in shifts_rad])
        self._laser_noise_um = laser_noise_um
        self._spread = spread
        self._mm_per_rad = screen_scale.mm_per_rad(optics.pattern)
        self._errors: LiveErrors | None = None
        self._lag = ImageLag.unknown()
        self._examined: IntArray = np.empty(0, int)  # numbers of tracked points
        self._reference_um = math.nan  # displacement of the reference cycle
        # Phases of all bins less those of the surface, in the reference cycle; NaN where unknown.
        self._reference_rad: FloatArray = np.full((2, self._places_px.shape[1]), np.nan)

    @property
    def common_mm2(self) -> FloatArray:
        """Covariance (parameters, parameters) that all cycles share; NaN before the first, and
        without a spread.
        """
        if self._errors is None:
            return np.full((PARAMETERS, PARAMETERS), np.nan)
        return self._errors.common_mm2

    def begin(self, state: tracked_points.TrackedPoints, lag: ImageLag | None = None) -> None:
        """Choose the points that are examined from those of a full cycle.

        Parameters
        ----------
        state : TrackedPoints
            The points of the full cycle.
        lag : ImageLag, optional
            Share of the previous picture that its frames show; unknown by default.
        """
        if lag is None:
            lag = ImageLag.unknown()
        self._lag = lag
        places_px = np.take(self._places_px, state.index, axis=1)
        chosen = trial_bench.spread_evenly(places_px, self._optics.camera.width_px, POINTS)
        self._examined = np.flatnonzero(chosen)

    def estimate_errors(self, cycle: Cycle) -> CycleErrors:
        """Estimate the errors of a cycle; the first one determines the sensitivities."""
        state = cycle.state
        points = self._examined[state.points.weights[self._examined] > 0]
        bins = state.index[points]

        # Phases of the points by the fitted surface.
        predicted_mm = cycle.tracer.predict_screen(state.points.subset(points), cycle.fit.surface)
        phase_rad = (predicted_mm + state.offset_mm[:, points]) / self._mm_per_rad

        # Light and film of each frame, at these phases.
        corrected_um = np.zeros(self._shifts_rad.shape)
        if film_motion.is_worth_correcting(cycle.readings_um, self._laser_noise_um):
            about_mean_um = cycle.readings_um - np.mean(cycle.readings_um)
            corrected_um = np.reshape(about_mean_um, corrected_um.shape)
        means = np.stack([np.take(sums, bins, axis=1) for sums in cycle.sums]) / self._bin_px**2
        seen = estimate_frame_errors(
            means,
            self._shifts_rad,
            self._weights,
            phase_rad,
            corrected_um,
            state.sensitivity_rad_per_um[:, points],
        )
        if self._errors is None:
            self._errors = self._compute_sensitivities(cycle, points, seen)

        # Change of the phases since the reference cycle beyond surface, light and film.
        moved_um = self._moved_um(cycle.readings_um)
        left_rad = state.fresh[:, 0, points] - phase_rad - seen.waves_rad
        is_reference = math.isnan(moved_um)
        if is_reference:
            self._reference_rad[:, bins] = left_rad
            moved_um = 0.0
        changed_rad = left_rad - self._reference_rad[:, bins]
        known = np.isfinite(changed_rad[0])
        changed_rad2 = np.zeros(2)
        if known.any():
            changed_rad2 = np.mean(np.square(changed_rad[:, known]), axis=1)
        return CycleErrors(
            correction_mm=self._errors.correction_mm(seen),
            own_mm2=self._errors.unshared_covariance_mm2(
                seen, cycle.readings_um, self._laser_noise_um, moved_um
            ),
            changed_rad2=changed_rad2,
            known_points=int(np.count_nonzero(known)),
            points=points,
            changed_rad=changed_rad,
            is_reference=is_reference,
        )

    def renew_reference(self) -> None:
        """Compare later cycles with the next one: the bench has moved."""
        self._reference_um = math.nan

    def _moved_um(self, readings_um: FloatArray) -> float:
        """The film's displacement since the reference cycle; NaN if that is to be this one."""
        known = readings_um[np.isfinite(readings_um)]
        mean_um = float(known.mean()) if known.size else 0.0
        if abs(mean_um - self._reference_um) <= _REFERENCE_UM:
            return mean_um - self._reference_um
        self._reference_um = mean_um
        return math.nan

    def _compute_sensitivities(
        self, cycle: Cycle, points: IntArray, seen: FrameErrors
    ) -> LiveErrors:
        """The sensitivities at a cycle.

        Parameters
        ----------
        cycle : Cycle
            Its points.
        points : (n,) int array
            Numbers of those that are examined.
        seen : FrameErrors
            What its frames show.
        """
        tracer = cycle.tracer
        state = cycle.state
        fit = cycle.fit
        swings = state.fresh[:, 4]
        places_px = np.take(self._places_px, state.index, axis=1)

        # Slopes that the fit leaves, as patches, and as a film that is not Hencky's.
        field = tracer.slope_field(state.points, fit.surface)
        slopes = field[2:4] - field[4:6]
        reach_mm = self._optics.mirror.analysis_radius_mm
        patches = residual_patches.Patches.from_points(
            field[:2], state.points.weights, slopes, reach_mm
        )
        rings = RoundSlopes.from_points(field[:2], state.points.weights, slopes, reach_mm)
        inverse = fit.normal.inverse
        of_round, _ = film_shape_error.round_effect(patches, rings, tracer.radius_mm, inverse)
        of_waves, _ = film_shape_error.wave_effect(patches, tracer.radius_mm, inverse)
        law = np.column_stack([of_round, of_waves])
        left = np.column_stack([patches.effects(tracer.radius_mm, fit.normal.inverse), law])

        # Light over the amplitude of the fringes, and blur of the image.
        levels = [
            weights[0] @ np.take(sums, state.index, axis=1)
            for weights, sums in zip(self._weights, cycle.sums, strict=True)
        ]
        light = np.stack(levels) / self._bin_px**2 / swings
        predicted_rad = tracer.predict_screen(state.points, fit.surface) / self._mm_per_rad
        gradients = picture_blur.phase_gradients(
            predicted_rad, state.index, self._shape, self._bin_px
        )
        blur_px = picture_blur.estimate_blur_px(gradients, swings, self._bin_px)

        # The bench with the examined points, and with as many as waves of light need.
        width_px = self._optics.camera.width_px
        many = np.flatnonzero(trial_bench.spread_evenly(places_px, width_px, _WAVE_POINTS))
        bench = self._make_bench(cycle, places_px, points)
        wave_bench = self._make_bench(cycle, places_px, many)
        left = np.column_stack([left, image_lag_of_cycles(bench, self._shifts_rad, self._lag)])
        return LiveErrors.from_benches(
            bench,
            wave_bench,
            self._shifts_rad,
            light[:, many],
            seen,
            self._spread,
            blur_px,
            left,
        )

    def _make_bench(
        self, cycle: Cycle, places_px: FloatArray, points: IntArray
    ) -> trial_bench.TrialBench:
        """A trial bench of n points of a cycle, without noise.

        `places_px` (2, tracked points) are the places of all tracked points in the picture,
        `points` (n,) the numbers of those to use.
        """
        return trial_bench.TrialBench.from_points(
            self._optics,
            cycle.tracer,
            cycle.fit.surface,
            cycle.state.points.subset(points),
            places_px[:, points],
            np.zeros((2, points.size)),
            points.size,
        )


def _rms(*parts: FloatArray) -> float:
    """Root mean square of all values."""
    return math.sqrt(float(np.mean(np.square(parts))))
