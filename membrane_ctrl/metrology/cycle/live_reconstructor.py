"""The live cycle: from frames in memory to the figure with its covariance.

A full cycle finds the fringe orders and the points that see the pattern. A fringes-only cycle
follows each point's phase from the last accepted one, which is unambiguous while no phase moved by
half a period (4.34 mrad of slope), and needs one or two Gauss-Newton steps with the normal matrix
of the full cycle. Derivation: sections 6 to 8 of docs/explanation/metrology.md.

The error bars are made in `LiveReconstructor._estimate`: white noise by `phase_sigma_rad` and
`parameter_covariance`, all other errors by `uncertainty.cycle_errors.ErrorWatch`. The verdict is
`judge_quality`'s, unless a doubt about the cycle's light or about the bench degrades it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.cycle import cycle_geometry, cycle_motion
from membrane_ctrl.metrology.cycle.cycle_sums import CycleSums
from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.frame_checks import (
    film_image,
    picture_orientation,
)
from membrane_ctrl.metrology.frame_checks.clipping import ClippedShares
from membrane_ctrl.metrology.phase import (
    full_decoder,
    pattern_sequence,
    phase_change,
    phase_steps,
    screen_scale,
)
from membrane_ctrl.metrology.rays import geometry, ray_tracing, surface
from membrane_ctrl.metrology.rays.film_reflections import find_reflecting_rays
from membrane_ctrl.metrology.reconstruction import (
    bin_grid,
    film_motion,
    slope_noise,
    surface_fit,
    tracked_points,
)
from membrane_ctrl.metrology.uncertainty import cycle_errors, geometry_spread
from membrane_ctrl.metrology.uncertainty.geometry_statement import GeometryStatement
from membrane_ctrl.metrology.uncertainty.motion_evidence import MotionFinding, find_motion_doubt
from membrane_ctrl.model.arrays import (
    ArrayLike,
    BoolArray,
    FloatArray,
    Image,
    Singles,
)
from membrane_ctrl.model.shape_estimate import Kind, Quality, ShapeEstimate, judge_quality
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Beyond this change of phase a point may have been taken for its neighbour a period away. 0.9 of
# half a period, so that a field which passes half a period anywhere shows points in the band before
# it.
GUARD_RAD = 0.9 * math.pi
LOST_SHARE = 0.002  # share of points beyond the guard; dust and glints are fewer
# A film that changes its shape moves as many phases up as down. If all of them move one way, the
# mount was knocked, perhaps by a whole period: phase alone cannot distinguish a tilt of 7 mrad from
# one of -1.7.
TILT_GUARD_RAD = 0.3 * math.pi
NOTHING_TO_FOLLOW = "tracking lost: no accepted full cycle to follow"
# With this share of its points the full cycle's normal matrix still contracts a hundredfold a step.
MATRIX_KEPT_SHARE = 0.99
# A ray meets the film this far at most from where it crosses the plane z = 0.
_FILM_BESIDE_PLANE_MM = 25.0
# Variance of the phases' change that is called noise, over the expected one: their scatter by
# chance is smaller.
_SURELY = 1.2
_BRIGHTEST_PERCENTILE = 95  # of the light that the least light of the mirror refers to
_EVERY = 16  # points between those of which medians are taken: a median costs more than the fit


class LiveReconstructor:
    """Figure of the mirror from cycles of frames.

    Parameters
    ----------
    optics : OpticsConfig
        Geometry, camera, pattern and mirror.
    bin_px : int
        Side of the bins whose phasors are used.
    laser_noise_um : float
        Noise of one displacement as given (an average over an exposure has less than a sample);
        motion is corrected only if it is clearly above this.
    shifts_rad : (N,) or (2, N) array, optional
        Phase steps, of x and y if they differ; equal ones if not given.
    spread : GeometrySpread, optional
        How well the geometry is known; with it the first full cycle computes
        `common_covariance_um2`, and each full cycle a `geometry_statement`.
    known_by, source : KnownBy, str, optional
        What the spread rests on, for the statement.

    Raises
    ------
    ValueError
        If the phase steps do not determine a phase, or their number is not the pattern's.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        bin_px: int = 4,
        *,
        laser_noise_um: float = 0.3,
        shifts_rad: ArrayLike | None = None,
        spread: geometry_spread.GeometrySpread | None = None,
        known_by: geometry_spread.KnownBy = geometry_spread.KnownBy.DATA_SHEETS,
        source: str = "",
    ) -> None:
        self._optics = optics
        self._geometry = geometry.Geometry.from_config(optics)
        self._bin_px = bin_px
        self._laser_noise_um = laser_noise_um
        steps = optics.pattern.steps
        if shifts_rad is None:
            shifts_rad = phase_steps.equal_shifts(steps)
        self._shifts_rad = np.broadcast_to(np.asarray(shifts_rad, float), (2, steps))
        self._weights = [phase_steps.step_weights(shifts) for shifts in self._shifts_rad]
        # Sigma of a phase whose fringes swing by as much as the noise.
        self._sigma_per_noise_rad = np.array(
            [phase_steps.phase_sigma_rad(shifts, 1.0, 1.0) for shifts in self._shifts_rad]
        )
        self._slots = pattern_sequence.FullSlots(steps)
        # Why cycles are degraded by a front film that the last full cycle found; empty if by none.
        self._film_doubt = ""
        self._full_scale_adu = 2**optics.camera.bits - 1
        self._sums = CycleSums(optics, bin_px, self._shifts_rad)
        self._grid = bin_grid.BinGrid(self._geometry, optics.camera, bin_px)
        # Bins on the mirror, without those in which a front film may show the pattern again.
        near = self._grid.near_mirror(optics.mirror.analysis_radius_mm + _FILM_BESIDE_PLANE_MM)
        near &= ~find_reflecting_rays(self._geometry, optics, self._grid.rays)
        self._near = np.flatnonzero(near)
        self._reference_um = optics.geometry.reference_displacement_um
        self._mm_per_rad = screen_scale.mm_per_rad(optics.pattern)
        self._pixel_sigma_adu = slope_noise.pixel_sigma_adu(optics.camera.noise_adu)
        self._tracked: tracked_points.TrackedPoints | None = None
        bench = (optics, self._grid, self._sums.shape, bin_px)
        self._motion: cycle_motion.CycleMotion | None = None
        self._watch = cycle_errors.ErrorWatch(*bench, self._shifts_rad, laser_noise_um, spread)
        self._geometry_watch = (
            None
            if spread is None
            else cycle_geometry.CycleGeometry(optics, self._grid, bin_px, spread, known_by, source)
        )
        self._statement: GeometryStatement | None = None

    def measure_full(
        self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike
    ) -> ShapeEstimate:
        """One full cycle. Raises ValueError for a wrong number, size or type of frames.

        Parameters
        ----------
        frames : sequence of (height, width) uint8 or uint16 arrays
            In the order of `pattern_sequence.full_sequence`.
        time_s, displacement_um : (frames,) arrays
            Of each exposure; NaN where there is no laser reading.

        Returns
        -------
        ShapeEstimate
            Verdict "rejected" with the reason when the images give no figure.
        """
        optics = self._optics
        times, readings = _per_frame(frames, time_s, displacement_um, self._slots.count, "full")
        sinusoids = np.r_[self._slots.sinusoids].tolist()
        if self._reference_um is None and np.isfinite(readings).any():
            self._reference_um = float(readings[np.isfinite(readings)][0])

        # Sums over the bins, without bands of the backlight.
        self._sums.sum_full(frames)

        # Absolute phases of the bins near the mirror.
        images = self._sums.take_means(self._near)
        phase_rad = full_decoder.decode_full(images, optics.pattern, self._shifts_rad)
        is_saturated = self._sums.find_saturated(self._near)
        phase_rad[:, is_saturated] = np.nan

        self._film_doubt = self._search_film_image(images, ~is_saturated).describe()

        # The points to follow, and their surface.
        times, readings = times[sinusoids], readings[sinusoids]
        self._tracked = None  # until this cycle is accepted
        tracer = self._make_tracer(readings)
        analysis_mm = optics.mirror.analysis_radius_mm
        try:
            state = tracked_points.select_points(
                self._grid, tracer, self._near, phase_rad, optics.pattern, analysis_mm
            )
        except ValueError as error:
            cause = ClippedShares(float(np.mean(is_saturated)), 0.0).cause
            return make_rejected_cycle("full", times, readings, cause or str(error))

        # The figure, without light of previous pictures.
        places_px = np.stack([self._grid.column_px[state.index], self._grid.row_px[state.index]])
        self._sums.remove_lag_of_full(state.index, places_px, state.accepted[:, 0])
        self._watch.begin(state, self._sums.lag)
        self._statement = None
        estimate = self._follow_phases("full", state, times, readings)
        estimate = self._judge_geometry(estimate, state, readings)

        # If no surface explains the slopes, pictures or pattern may be turned.
        if estimate.slope_residual_urad <= picture_orientation.SUSPICIOUS_URAD:
            return estimate
        near_px = np.stack([self._grid.column_px, self._grid.row_px])[:, self._near]
        orientation = picture_orientation.find_orientation(
            optics, tracer.vertex_z_mm, near_px, phase_rad
        )
        if orientation is None:
            return estimate
        self._tracked = None
        return make_rejected_cycle("full", times, readings, orientation.describe())

    def measure_fringes(
        self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike
    ) -> ShapeEstimate:
        """One fringes-only cycle. Raises ValueError for a wrong number, size or type of frames.

        Parameters
        ----------
        frames : sequence of 2 N (height, width) uint8 or uint16 arrays
            In the order of `pattern_sequence.fringe_sequence`.
        time_s, displacement_um : (2 N,) arrays
            Of each exposure; NaN where there is no laser reading.

        Returns
        -------
        ShapeEstimate
            With `tracking_lost` if a full cycle must follow.
        """
        times, readings = _per_frame(
            frames, time_s, displacement_um, 2 * self._slots.steps, "fringes"
        )
        if self._tracked is None:
            return make_rejected_cycle(
                "fringes", times, readings, NOTHING_TO_FOLLOW, tracking_lost=True
            )
        self._sums.sum_fringes(frames)
        estimate = self._follow_phases("fringes", self._tracked, times, readings)
        return self._degrade_contradicted(estimate)

    def prepare(self) -> None:
        """Nothing: a cycle needs no preparation (`LiveTracker.prepare` does)."""

    def height_map(
        self, coeffs_um: FloatArray, hencky_um: float, n: int = 256
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return a figure as a picture.

        Parameters
        ----------
        coeffs_um : (terms,) array
            Zernike terms in Noll's order.
        hencky_um : float
            Amplitude of the excess of Hencky's bowl, as its sag.
        n : int
            Pixels along a side.

        Returns
        -------
        x_mm, y_mm : (n,) array
            Places of columns and rows.
        h_mm : (n, n) array
            Heights, rows along y; NaN outside the analysed radius.
        """
        mirror = self._optics.mirror
        axis = np.linspace(-mirror.radius_mm, mirror.radius_mm, n)
        x, y = np.meshgrid(axis, axis)
        shape = surface.Surface(np.asarray(coeffs_um) / 1e3, hencky_um / 1e3, mirror.radius_mm)
        h = shape.height(x, y)
        h[x**2 + y**2 > mirror.analysis_radius_mm**2] = np.nan
        return axis, axis.copy(), h

    @property
    def common_covariance_um2(self) -> FloatArray:
        """Covariance (terms, terms) of the coefficients that all cycles share: geometry, lens,
        screen, air, blur.

        Add it to a cycle's own for a single figure, not for changes. NaN before the first full
        cycle and without a spread.
        """
        to_coeffs = surface.parameter_to_coeffs()
        return np.asarray(1e6 * to_coeffs @ self._watch.common_mm2 @ to_coeffs.T)

    def sag_sensitivity(self) -> FloatArray:
        """Change of the coefficients (terms,) in µm per µm of sag of a Hencky bowl."""
        return hencky_bowl.zernike_projection().copy()

    @property
    def geometry_statement(self) -> GeometryStatement | None:
        """How well the geometry is known, by the newest full cycle; None without a spread, and if
        that cycle has no figure.
        """
        return self._statement

    def _judge_geometry(
        self, estimate: ShapeEstimate, state: tracked_points.TrackedPoints, readings: FloatArray
    ) -> ShapeEstimate:
        """State how well the geometry is known, by a full cycle; the figure of one that is
        contradicted is degraded.
        """
        if self._geometry_watch is None or estimate.verdict == "rejected":
            return estimate
        tracer = self._make_tracer(readings)
        light = self._sums.mean_light()
        self._statement = self._geometry_watch.judge(tracer, state, state.surface, light)
        return self._degrade_contradicted(estimate)

    def _degrade_contradicted(self, estimate: ShapeEstimate) -> ShapeEstimate:
        """The estimate, degraded if the last full cycle contradicts the geometry."""
        doubts = () if self._statement is None else self._statement.doubts
        if not doubts or estimate.verdict == "rejected":
            return estimate
        known = [estimate.reason] if estimate.reason else []
        return replace(estimate, verdict="degraded", reason="; ".join([*known, *doubts]))

    def _make_tracer(self, readings_um: FloatArray) -> ray_tracing.Tracer:
        """The bench with the vertex where the laser saw it, on average over the frames."""
        mean_um = _finite_mean(readings_um)
        vertex_z_mm = 0.0
        if self._reference_um is not None and math.isfinite(mean_um):
            vertex_z_mm = -(mean_um - self._reference_um) * 1e-3
        return ray_tracing.Tracer(self._geometry, self._optics.mirror.radius_mm, vertex_z_mm)

    def _follow_phases(
        self,
        kind: Kind,
        state: tracked_points.TrackedPoints,
        times: FloatArray,
        readings: FloatArray,
    ) -> ShapeEstimate:
        """Phases of the points against the last accepted ones, and the figure from them."""
        # Phases, and the points that can be used: fringes with contrast, and no saturated pixel.
        self._track_phases(state, readings)
        change_rad = state.fresh[:, 3]
        swing_adu = state.fresh[:, 4]
        modulation_adu = float(np.median(swing_adu[:, ::_EVERY]))
        saturated = self._sums.find_saturated(state.index)
        has_fringes = swing_adu.min(axis=0) > full_decoder.FRINGE_SHARE * modulation_adu
        usable = ~saturated & has_fringes
        if reason := _find_loss_reason(change_rad, usable):
            return make_rejected_cycle(kind, times, readings, reason, tracking_lost=True)

        # The surface, without the effect of what the frames show of their own light and motion.
        fit = self._fit_points(state, usable, readings)
        cycle = cycle_errors.Cycle(
            self._make_tracer(readings), state, fit, self._sums.of_sinusoids(), readings
        )
        errors = self._watch.estimate_errors(cycle)
        corrected = fit.surface.parameters - errors.correction_mm
        corrected_surface = surface.Surface.from_parameters(corrected, fit.surface.radius_mm)
        fit = replace(fit, surface=corrected_surface)

        # Its quality, error bars and verdict.
        area_mm2 = math.pi * self._optics.mirror.analysis_radius_mm**2
        quality = Quality(
            modulation_share=modulation_adu / self._full_scale_adu,
            saturated_fraction=float(np.mean(saturated)),
            valid_fraction=min(1.0, float(np.sum(state.area_mm2[usable])) / area_mm2),
            residual_urad=1e6 * math.hypot(fit.residual_x, fit.residual_y) / math.sqrt(2),
            converged=fit.converged,
        )
        estimate = self._estimate(kind, state, fit, errors, quality, times, readings)
        if estimate.verdict == "rejected":
            # The points go back onto the last good surface.
            self._make_tracer(readings).place_on_shape(state.points, state.surface.height)
        else:
            state.accept(fit.surface, usable)
            self._tracked = state
        return estimate

    def _search_film_image(self, images: Singles, usable: BoolArray) -> film_image.FilmImage:
        """A second reflection of the screen in the bins near the mirror, by a front film that the
        configuration does not have.

        `images` (frames, n) are their means, `usable` (n,) those that are not saturated.
        """
        if self._geometry.cushion is not None:
            return film_image.NO_FILM_IMAGE
        light = images[self._slots.white].astype(float) - images[self._slots.black]
        bright = float(np.percentile(light[::_EVERY], _BRIGHTEST_PERCENTILE))
        seen = np.flatnonzero(usable & (light > full_decoder.CONTRAST_SHARE * bright))

        # Where their rays cross the plane half way down the bowl, inside the analysed part.
        mirror = self._optics.mirror
        pinhole_mm = self._geometry.pinhole_mm
        rays = np.take(self._grid.rays, self._near[seen], axis=1)
        t = (mirror.sag_mm / 2 - pinhole_mm[2]) / rays[2]
        position_mm = pinhole_mm[:2, None] + t * rays[:2]
        inside = np.square(position_mm).sum(axis=0) < mirror.analysis_radius_mm**2
        seen = seen[inside]
        position_mm = np.compress(inside, position_mm, axis=1)

        def compute_swing() -> FloatArray:
            """Amplitude of the fringes, mean of both axes."""
            swing = np.zeros(seen.size)
            for slots, weights in zip(self._slots.sinusoids, self._weights, strict=True):
                _, cosine, sine = weights @ np.take(images[slots], seen, axis=1)
                swing += np.hypot(cosine, sine) / 2
            return swing

        return film_image.find_film_image(
            self._sums.shape, self._near[seen], position_mm, light[seen], compute_swing
        )

    def _track_phases(self, state: tracked_points.TrackedPoints, readings: FloatArray) -> None:
        """Fresh phases from the bin sums, corrected for the film's motion between the frames."""
        # Motion between the frames, about its mean over both axes, where it exceeds the laser's
        # noise (section 7 of docs/explanation/metrology.md).
        moved = film_motion.is_worth_correcting(readings, self._laser_noise_um)
        motion_um = np.reshape(readings - np.mean(readings), (2, -1)) if moved else None
        # One row of weights per frame turns sums of bins into phasors, corrected for that motion.
        combined = []
        for axis in range(2):
            part = None if motion_um is None else motion_um[axis]
            combined.append(
                film_motion.combine_steps(
                    self._weights[axis], self._shifts_rad[axis], self._bin_px, part
                )
            )
        phase_change.update_phases(
            self._sums.of_sinusoids(),
            state.index,
            combined,
            state.sensitivity_rad_per_um,
            state.accepted,
            state.fresh,
        )

    def _fit_points(
        self, state: tracked_points.TrackedPoints, usable: BoolArray, readings: FloatArray
    ) -> surface_fit.Fit:
        """One or two steps from the last surface; the full cycle's normal matrix while its points
        are there.
        """
        # Screen points s = T phi / 2 pi less the averaging over a bin (sections 1 and 2 of
        # docs/explanation/metrology.md).
        state.points.weights[:] = usable
        np.multiply(state.fresh[:, 0], self._mm_per_rad, out=state.points.screen_mm)
        state.points.screen_mm -= state.offset_mm
        # Any matrix leads to the same solution (section 5); the kept one saves its computation.
        complete = np.count_nonzero(usable) > MATRIX_KEPT_SHARE * usable.size
        normal = state.normal if complete else None
        return surface_fit.fit_surface(
            self._make_tracer(readings), state.points, state.surface, normal=normal
        )

    def _estimate(
        self,
        kind: Kind,
        state: tracked_points.TrackedPoints,
        fit: surface_fit.Fit,
        errors: cycle_errors.CycleErrors,
        quality: Quality,
        times: FloatArray,
        readings: FloatArray,
    ) -> ShapeEstimate:
        """The result in micrometres, with its covariance and verdict.

        Error bars: section 8 of docs/explanation/metrology.md.
        """
        # Variance (2,) of the phase of a bin from the noise of its pixels.
        modulation_adu = quality.modulation_share * self._full_scale_adu
        sigmas_rad = self._sigma_per_noise_rad * (self._pixel_sigma_adu / modulation_adu)
        noise_rad2 = np.square(sigmas_rad) / self._bin_px**2

        # Phases that changed by more than noise since the reference: an independent error of each
        # of the points that were asked.
        changed_rad2 = np.maximum(errors.changed_rad2 - _SURELY * 2 * noise_rad2, 0.0)
        changed_rad2 *= fit.weight_sum / max(errors.known_points, 1)

        # Both as slopes, and as a covariance of the parameters; with the cycle's other errors.
        gain = slope_noise.slope_per_screen(
            self._geometry, fit.surface.radius_mm, fit.surface.sag_mm
        )
        slope_variance = gain @ (self._mm_per_rad**2 * (noise_rad2 + changed_rad2))
        noise_mm2 = slope_noise.parameter_covariance(fit.normal, slope_variance)
        own_mm2 = noise_mm2 + errors.own_mm2

        # Motions of the bench: found ones count in the sag, too small ones in the figure alone.
        motion, motion_doubt = self._find_motion(state, fit, errors, own_mm2, readings)
        sag_covariance_mm2 = own_mm2
        covariance_mm2 = own_mm2
        if motion is not None:
            sag_covariance_mm2 = own_mm2 + motion.found_mm2
            covariance_mm2 = sag_covariance_mm2 + motion.allowed_mm2
        to_coeffs = surface.parameter_to_coeffs()
        gradient = surface.sag_gradient()
        sag_sigma_mm = math.sqrt(gradient @ sag_covariance_mm2 @ gradient)
        geometry_sag_sigma_mm = math.sqrt(gradient @ self._watch.common_mm2 @ gradient)

        verdict, reason = judge_quality(quality)
        doubt = self._sums.doubt or self._film_doubt or motion_doubt
        if verdict == "ok" and doubt:
            verdict, reason = "degraded", doubt
        return ShapeEstimate(
            time_s=_finite_mean(times),
            kind=kind,
            coeffs_um=1e3 * fit.surface.coeffs_mm,
            hencky_um=1e3 * fit.surface.hencky_mm,
            covariance_um2=1e6 * to_coeffs @ covariance_mm2 @ to_coeffs.T,
            sag_um=1e3 * fit.surface.sag_mm,
            sag_change_sigma_um=1e3 * sag_sigma_mm,
            geometry_sag_sigma_um=1e3 * geometry_sag_sigma_mm,
            displacement_um=_finite_mean(readings),
            slope_residual_urad=quality.residual_urad,
            valid_fraction=quality.valid_fraction,
            modulation_median_adu=modulation_adu,
            saturated_fraction=quality.saturated_fraction,
            verdict=verdict,
            reason=reason,
        )

    def _find_motion(
        self,
        state: tracked_points.TrackedPoints,
        fit: surface_fit.Fit,
        errors: cycle_errors.CycleErrors,
        covariance_mm2: FloatArray,
        readings: FloatArray,
    ) -> tuple[MotionFinding | None, str]:
        """The motions of the bench since the reference cycle, and why the figure must not be used
        as it is; None for the reference itself.

        After a motion the next cycle is the reference: what has moved stays there.
        """
        if self._sums.doubt or not np.isfinite(covariance_mm2).all():
            if errors.is_reference:  # a disturbed cycle cannot be the reference
                self._motion = None
            return None, ""
        index = state.index[errors.points]
        changed_mm = self._mm_per_rad * errors.changed_rad
        if errors.is_reference or self._motion is None:
            points = state.points.subset(errors.points)
            self._motion = cycle_motion.CycleMotion.from_reference(
                self._make_tracer(readings), points, index, fit.surface, covariance_mm2, changed_mm
            )
            return None, ""
        motion = self._motion.find(fit.surface, index, changed_mm, covariance_mm2)
        tilt_urad = self._motion.tilt_urad(fit.surface)
        doubt = find_motion_doubt(motion, covariance_mm2, tilt_urad)
        if doubt:
            self._watch.renew_reference()
        return motion, doubt


def _per_frame(
    frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike, count: int, kind: Kind
) -> tuple[FloatArray, FloatArray]:
    """Times and readings as arrays. Raises ValueError unless there is one of each for each of
    `count` frames.
    """
    times = np.asarray(time_s, float)
    readings = np.asarray(displacement_um, float)
    if not len(frames) == times.size == readings.size == count:
        found = f"{len(frames)} frames, {times.size} times and {readings.size} displacements"
        raise ValueError(
            f"a {kind} cycle has {count} frames with a time and a displacement each; got {found}"
        )
    return times, readings


def _find_loss_reason(change_rad: FloatArray, usable: BoolArray) -> str:
    """Why the phases (2, n) cannot be followed; empty if they can."""
    seen = max(1, int(np.count_nonzero(usable)))
    is_beyond = np.abs(change_rad).max(axis=0) > GUARD_RAD
    beyond = int(np.count_nonzero(usable & is_beyond))
    if beyond > LOST_SHARE * seen:
        share = beyond / seen
        return f"tracking lost: the phase moved by half a period at {share:.1%} of the points"
    common_change_rad = np.median(change_rad[:, ::_EVERY], axis=1)
    if np.abs(common_change_rad).max() > TILT_GUARD_RAD:
        return "tracking lost: the whole mirror tilted"
    return ""


def _finite_mean(values: FloatArray) -> float:
    """Mean of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def make_rejected_cycle(
    kind: Kind, times: FloatArray, readings: FloatArray, reason: str, tracking_lost: bool = False
) -> ShapeEstimate:
    """Return the estimate of a cycle without a figure.

    Parameters
    ----------
    kind : Kind
        "full" or "fringes".
    times, readings : (frames,) arrays
        Time in s and laser reading in µm of each exposure; NaN where there is none.
    reason : str
        Why, for people.
    tracking_lost : bool
        Whether a full cycle is needed.

    Returns
    -------
    ShapeEstimate
        Verdict "rejected"; NaN for all that follows from a figure.
    """
    nan = float("nan")
    return ShapeEstimate(
        time_s=_finite_mean(times),
        kind=kind,
        coeffs_um=np.full(ZERNIKE_TERMS, nan),
        hencky_um=nan,
        covariance_um2=np.full((ZERNIKE_TERMS, ZERNIKE_TERMS), nan),
        sag_um=nan,
        sag_change_sigma_um=nan,
        displacement_um=_finite_mean(readings),
        slope_residual_urad=nan,
        valid_fraction=0.0,
        modulation_median_adu=nan,
        saturated_fraction=nan,
        verdict="rejected",
        reason=reason,
        tracking_lost=tracking_lost,
    )
