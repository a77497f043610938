"""Errors of live cycles beyond the noise of the pixels: what the frames show of them, and what
that leaves.

The sensitivities are those of the budget of `measure`, computed once, with the first full cycle.
Each cycle then asks some of its points what light each frame had and where the film was (see
`frame_checks.frame_evidence`), takes the effect out, and states what is left. Errors that all
cycles share count for one figure, not for a change since the reference cycle: the first one near
the film's present displacement.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.optics import OpticsConfig, SigmasConfig
from membrane_ctrl.metrology.frame_checks.held_light import UNKNOWN, HeldLight
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
from membrane_ctrl.metrology.uncertainty.held_light_error import held_light_of_cycles
from membrane_ctrl.model.arrays import AnyArray, FloatArray, IntArray

# Some points determine light and place of a frame to 1e-4 and 20 nm, a tenth of what they leave
POINTS = 1500
# Share of what the frames show that is left when it has been taken out: higher orders, and light
# that is not even
_LEFT = 0.03
# Waves of uneven light nearly cancel over the mirror: the few points that show them would not show
# what is left
_WAVE_POINTS = 20_000
_SECOND_ORDER = 0.01
_FAR_UM = 300.0  # displacement over which the sensitivities are compared
# A film this far from the reference cycle makes a new one: changes are stated within a hold, not
# across setpoints
_REFERENCE_UM = 100.0


@dataclass(frozen=True)
class LiveErrors:
    """Sensitivities of the surface's parameters, in mm."""

    frames: frame_effects.FrameEffects
    vertex: FloatArray  # (parameters,): per µm of the vertex' place
    # (parameters, parameters): covariance of what all cycles share; NaN if the spread is unknown or
    # too wide
    common_mm2: FloatArray
    # (parameters, parameters): covariance of what is left of that in a change, per µm^2 of the
    # film's displacement between the cycles
    per_um2: FloatArray
    # (parameters, parameters): covariance of what the geometry makes of a film that was told to be
    # 1 µm deeper in x than in y
    told_um2: FloatArray

    @classmethod
    def of(
        cls,
        bench: trial_bench.TrialBench,
        waves: trial_bench.TrialBench,
        shifts_rad: FloatArray,
        light: FloatArray,
        seen: FrameErrors,
        spread: geometry_spread.GeometrySpread | None,
        blur_px: float,
        left: FloatArray,
    ) -> "LiveErrors":
        """Of some points of a cycle, and of the many more that the waves of uneven light need.

        `light` (2, n) is that of the latter over the amplitude of their fringes, and `left`
        (parameters, k) the effects of the slopes that the fit leaves.
        """
        frames = frame_effects.frame_effects(waves, bench.optics, shifts_rad, light, seen.harmonics)
        vertex = bench_sources.vertex_source(bench, 1.0, "").effects_mm[:, 0]
        none = np.zeros((vertex.size, vertex.size))
        if spread is None:
            return cls(frames, vertex, none + np.nan, none, none)
        try:
            here = _shared_effects(bench, spread, blur_px)
            per_um = (
                _shared_effects(trial_bench.moved_film(bench, _FAR_UM), spread, blur_px) - here
            ) / _FAR_UM
            x_mm, y_mm = (
                trial_bench.moved_film(bench, sign * _FAR_UM / 2).screen_mm for sign in (1, -1)
            )
            told = _of_geometry(replace(bench, screen_mm=np.stack([x_mm[0], y_mm[1]])), spread)
            told = (told - here[:, : told.shape[1]]) / _FAR_UM
        except ArithmeticError:  # a fit at the spread's end fails
            return cls(frames, vertex, none + np.nan, none, none)
        return cls(frames, vertex, here @ here.T + left @ left.T, per_um @ per_um.T, told @ told.T)

    def correction_mm(self, seen: FrameErrors) -> FloatArray:
        """(parameters,) that the errors of the frames added to the parameters."""
        effects = self.frames
        # the phases were corrected for the told motion as if the fringes were pure sinusoids
        display = effects.display @ (seen.told_um + seen.moved_um)
        return np.asarray(
            effects.level @ seen.level
            + effects.swing @ seen.swing
            + effects.film @ seen.moved_um
            + display
        )

    def own_mm2(
        self, seen: FrameErrors, readings_um: FloatArray, laser_noise_um: float, moved_um: float
    ) -> FloatArray:
        """Covariance (parameters, parameters) in mm^2 of what the reference cycle does not share,
        without slopes and pixels.

        It is from light and film as `seen` and taken out, from the laser's readings (2 N,) of the
        frames, and from the film's displacement since the reference.
        """
        light, film_um = _LEFT * _make_rms(seen.level, seen.swing), _LEFT * _make_rms(seen.moved_um)
        if np.isfinite(readings_um).all():  # motion is taken out to first order
            film_um += _SECOND_ORDER * float(np.std(readings_um))
        x_to_y_um = laser_errors.left_by_laser_um(
            readings_um, _make_rms(seen.moved_um), laser_noise_um
        )
        vertex_um = laser_errors.vertex_um(readings_um, laser_noise_um)
        if not np.isfinite(readings_um).all():  # half of that motion is in the frames' mean
            vertex_um = math.hypot(vertex_um, x_to_y_um / 2)
        effects = [
            light * self.frames.level,
            light * self.frames.swing,
            film_um * self.frames.film,
            x_to_y_um * self.frames.x_to_y[:, None],
            vertex_um * self.vertex[:, None],
        ]
        told_um = float(np.subtract(*(part.mean() for part in np.split(seen.told_um, 2))))
        shared_mm2 = moved_um**2 * self.per_um2 + told_um**2 * self.told_um2
        return np.asarray(sum(effect @ effect.T for effect in effects) + shared_mm2)


def _shared_effects(
    bench: trial_bench.TrialBench, spread: geometry_spread.GeometrySpread, blur_px: float
) -> FloatArray:
    """Effects (parameters, k) of what all cycles share. Raises ArithmeticError if a fit at the
    spread's end fails.
    """
    sources = [
        *bench_sources.bench_sources(bench, bench.optics.geometry.sigmas or SigmasConfig()),
        image_blur.blur_source(bench, blur_px),
    ]
    return np.concatenate(
        [_of_geometry(bench, spread), *(source.effects_mm for source in sources)], axis=1
    )


def _of_geometry(
    bench: trial_bench.TrialBench, spread: geometry_spread.GeometrySpread
) -> FloatArray:
    return np.concatenate(
        [source.effects_mm for source in bench_sources.geometry_sources(bench, spread)], axis=1
    )


@dataclass(frozen=True)
class Cycle:
    """The fitted points of one cycle."""

    tracer: ray_tracing.Tracer
    state: tracked_points.TrackedPoints  # with the fresh phases
    fit: surface_fit.Fit
    sums: Sequence[AnyArray]  # two (N, bins): bin sums of the sinusoids
    readings_um: FloatArray  # (2 N,)


@dataclass(frozen=True)
class CycleErrors:
    """What is known of the errors of one cycle."""

    correction_mm: FloatArray  # (parameters,): to be subtracted from the parameters
    # (parameters, parameters): covariance of what the reference cycle does not share, without
    # slopes and pixels
    own_mm2: FloatArray
    # (2,): variance of the phases' change since the reference that no surface explains
    changed_rad2: FloatArray
    asked: int  # points it is known at
    points: IntArray  # (n,): of the tracked points, those that were asked
    # (2, n): their phases less the surface's, less those of the reference cycle; NaN where unknown
    changed_rad: FloatArray
    is_reference: bool  # whether later cycles are compared with this one


class ErrorWatch:
    """Follows the errors of a reconstructor's cycles.

    Parameters
    ----------
    optics, grid, shifts_rad, laser_noise_um, spread
        Those of the reconstructor.
    shape : (rows, columns)
        Of the bins.
    bin_px : int
        Their side.
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
        self._optics, self._shape, self._bin_px = optics, shape, bin_px
        self._places_px = np.stack([grid.column_px, grid.row_px])
        self._shifts_rad, self._laser_noise_um, self._spread = shifts_rad, laser_noise_um, spread
        self._weights = np.stack([phase_steps.step_weights(shifts) for shifts in shifts_rad])
        self._errors: LiveErrors | None = None
        self._held = UNKNOWN
        self._asked: IntArray = np.empty(0, int)  # of the tracked points
        self._reference_um = math.nan  # displacement of the reference cycle
        # of the bins asked then: phases less those of the surface
        self._reference_rad: FloatArray = np.full((2, self._places_px.shape[1]), np.nan)

    @property
    def common_mm2(self) -> FloatArray:
        """Covariance (parameters, parameters) that all cycles share; NaN before the first, and
        without a spread.
        """
        return (
            np.full((PARAMETERS, PARAMETERS), np.nan)
            if self._errors is None
            else self._errors.common_mm2
        )

    def begin(self, state: tracked_points.TrackedPoints, held: HeldLight = UNKNOWN) -> None:
        """Choose from the points of a full cycle those that are asked.

        `held` is what its frames showed of the previous ones.
        """
        self._held = held
        places_px = self._places_px[:, state.index]
        self._asked = np.flatnonzero(
            trial_bench.spread_evenly(places_px, self._optics.camera.width_px, POINTS)
        )

    def look(self, cycle: Cycle) -> CycleErrors:
        """The errors of a cycle; the first one's determine the sensitivities."""
        state, asked = cycle.state, self._asked[cycle.state.points.weights[self._asked] > 0]
        scale = screen_scale.mm_per_rad(self._optics.pattern)
        predicted_mm = cycle.tracer.predict_screen(state.points.subset(asked), cycle.fit.surface)
        phase_rad, index = (predicted_mm + state.offset_mm[:, asked]) / scale, state.index[asked]
        told_um = np.zeros(self._shifts_rad.shape)
        if film_motion.worth_correcting(cycle.readings_um, self._laser_noise_um):
            told_um = np.reshape(cycle.readings_um - np.mean(cycle.readings_um), told_um.shape)
        means = np.stack([sums[:, index] for sums in cycle.sums]) / self._bin_px**2
        sensitivity = state.sensitivity_rad_per_um[:, asked]
        seen = estimate_frame_errors(
            means, self._shifts_rad, self._weights, phase_rad, told_um, sensitivity
        )
        if self._errors is None:
            self._errors = self._sensitivities(cycle, asked, seen)
        moved_um = self._moved_um(cycle.readings_um)
        left_rad = state.fresh[:, 0, asked] - phase_rad - seen.waves_rad
        is_reference = math.isnan(moved_um)
        if is_reference:
            self._reference_rad[:, index], moved_um = left_rad, 0.0
        changed_rad = left_rad - self._reference_rad[:, index]
        known = np.isfinite(changed_rad[0])
        changed_rad2 = (
            np.mean(np.square(changed_rad[:, known]), axis=1) if known.any() else np.zeros(2)
        )
        own_mm2 = self._errors.own_mm2(seen, cycle.readings_um, self._laser_noise_um, moved_um)
        return CycleErrors(
            self._errors.correction_mm(seen),
            own_mm2,
            changed_rad2,
            int(np.count_nonzero(known)),
            asked,
            changed_rad,
            is_reference,
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

    def _sensitivities(self, cycle: Cycle, asked: IntArray, seen: FrameErrors) -> LiveErrors:
        tracer, state, fit = cycle.tracer, cycle.state, cycle.fit
        field = tracer.slope_field(state.points, fit.surface)
        reach_mm, slopes = self._optics.mirror.analysis_radius_mm, field[2:4] - field[4:6]
        patches = residual_patches.Patches.of(field[:2], state.points.weights, slopes, reach_mm)
        law, _ = film_shape_error.law_effect(patches, tracer.radius_mm, fit.normal.inverse)
        left = np.column_stack([patches.effects(tracer.radius_mm, fit.normal.inverse), law])
        levels = [
            w[0] @ sums[:, state.index] for w, sums in zip(self._weights, cycle.sums, strict=True)
        ]
        light = np.stack(levels) / self._bin_px**2 / state.fresh[:, 4]
        scale = screen_scale.mm_per_rad(self._optics.pattern)
        predicted_rad = tracer.predict_screen(state.points, fit.surface) / scale
        swings = state.fresh[:, 4]
        blur_px = image_blur.estimate_blur_px(
            predicted_rad, swings, state.index, self._shape, self._bin_px
        )
        places_px, width_px = self._places_px[:, state.index], self._optics.camera.width_px
        many = np.flatnonzero(trial_bench.spread_evenly(places_px, width_px, _WAVE_POINTS))

        def bench(at: IntArray) -> trial_bench.TrialBench:
            some, exact = state.points.subset(at), np.zeros((2, at.size))
            return trial_bench.TrialBench.of_points(
                self._optics, tracer, fit.surface, some, places_px[:, at], exact, at.size
            )

        few = bench(asked)
        left = np.column_stack([left, held_light_of_cycles(few, self._shifts_rad, self._held)])
        return LiveErrors.of(
            few,
            bench(many),
            self._shifts_rad,
            light[:, many],
            seen,
            self._spread,
            blur_px,
            left,
        )


def _make_rms(*parts: FloatArray) -> float:
    return math.sqrt(float(np.mean(np.square(parts))))
