"""Follows the figure of the mirror from frame to frame of one crossed pattern.

Each frame passes four stages (`Tracker.follow`):

1. its light: frozen, dark, saturated or covered frames are rejected before any fit;
2. the fit, from the last good solution (`outlier_rejection`, `frame_fit`);
3. the comparison with the last frames: a lost fringe order (`lost_orders`), a knock, a motion of
   the bench (`bench_watch`);
4. the error bars (`fit_covariance`, `step_jumps`).

A frame that passes becomes the start of the next one, and is added to the mean of its step of the
pattern. After five steps that separate the axes, light and phases of each bin are solved again from
these means (`step_solution`), and a new scene begins (`_renew_scene`).

A period that is lost everywhere at once leaves no residual, but it is not only a tilt: rays meet
the screen at other distances, so that micrometres of astigmatism and coma appear (`LostOrders`).
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.backlight_bands import Bands
from membrane_ctrl.metrology.phase.bin_sums import Binner
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking import (
    frame_verdict,
    light_squares,
    lost_orders,
    step_jumps,
    step_means,
    tracked_frame,
)
from membrane_ctrl.metrology.tracking.bench_watch import BenchWatch
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.fit_covariance import OTHER_BINS_SHARE, FitCovariance
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter, Shifts
from membrane_ctrl.metrology.tracking.frame_verdict import Finding
from membrane_ctrl.metrology.tracking.outlier_rejection import RobustFitter
from membrane_ctrl.metrology.tracking.stains import find_stain
from membrane_ctrl.metrology.tracking.step_solution import (
    ENOUGH_STEPS,
    are_steps_separable,
    solve_steps,
)
from membrane_ctrl.metrology.tracking.tracked_frame import TrackedFrame
from membrane_ctrl.metrology.uncertainty.motion_evidence import MotionFinding, find_motion_doubt
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, Singles
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Residual over the swing beyond which a bin counts for a lost order: dust that moved leaves less.
_FAR_OFF = 0.05
# RMS of a tilt that neither film nor air makes: 2 µm are 8 µrad.
_KNOCK_UM = 2.0
_KNOCK_UM_PER_S = 0.5
# With less noise, frames of a still mirror may be identical; here a pixel in 90 differs.
_NOISE_FREE_ADU = 0.01
_BAND_FITS = 2  # with a new band: the second fit uses the frequency that the first one finds


class Tracker:
    """Follows the figure.

    Parameters
    ----------
    scene : CrossedScene
        The bench as the reference set shows it.
    size_px : (int, int)
        Height and width of the frames.
    full_scale_adu : int
        Value of a saturated pixel.
    noise_adu : float
        Noise of a pixel.
    displacement_um : float
        Laser reading of the reference; NaN without.
    reference_doubt : str
        Why all frames are degraded by what the reference shows of the bench, for people; empty if
        they are not.

    Raises
    ------
    ValueError
        If no frame could distinguish a lost period from a film that moved.
    """

    def __init__(
        self,
        scene: CrossedScene,
        size_px: tuple[int, int],
        full_scale_adu: int,
        noise_adu: float,
        displacement_um: float = math.nan,
        reference_doubt: str = "",
    ) -> None:
        self._reference_doubt = reference_doubt
        self._binner = Binner(*size_px, scene.bin_px, full_scale_adu, 1)
        self._is_noise_free = noise_adu < _NOISE_FREE_ADU
        # Noise of a bin, with that of rounding to whole counts.
        self._noise_adu = math.hypot(noise_adu, math.sqrt(1 / 12)) / scene.bin_px

        # The last frame: its bins, the same without bands, and what its fit left.
        self._seen: Singles = np.zeros(scene.index.size, np.float32)
        self._clear = self._seen
        self._scale_adu = 0.0
        self._last_time_s = math.nan
        self._last_displacement_um = displacement_um
        self._anchor_light = math.nan  # light of the first good frame, in units of the scene's

        # The scene and what is fitted to it.
        self._bands = Bands(scene.row)
        self._fitter = FrameFitter(scene, self._bands)
        self._jumps = step_jumps.StepJumps()
        self._covariance = FitCovariance(self._noise_adu)
        self._begin_scene(scene, scene.surface, np.zeros((3, ZERNIKE_TERMS)))

        # What is compared with the reference.
        self._orders = lost_orders.LostOrders(self._fitter)
        self._orders.require_distinguishable()
        self._watch = BenchWatch(self._fitter)
        self._knocked = ""  # reason, once the bench was knocked

        # Mean time and parameters of the last five steps.
        self._mean_place: tuple[float, FloatArray] | None = None
        # Variance of the mirror's place at each step of the last five, by its phase steps.
        self._places_mm2: dict[Shifts, FloatArray] = {}
        self._prepared_rad = (math.nan, math.nan)

        # Sum of the residuals of all good frames.
        self._residual_sum_adu = np.zeros(scene.index.size)
        self._frames = 0

    def _begin_scene(self, scene: CrossedScene, shape: surface.Surface, light: FloatArray) -> None:
        """Start from a scene, a surface and maps (3, terms) of light."""
        bins = scene.index.size
        no_residual = np.zeros(bins, np.float32)
        full_weights = np.ones(bins, np.float32)
        # The fit of this scene; the derivatives hardly change from scene to scene.
        self._fitter = FrameFitter(scene, self._bands, self._fitter.jacobian)
        self._swing_adu = float(np.median(scene.light_adu[1]))
        self._robust = RobustFitter(self._fitter, self._noise_adu, self._swing_adu)
        self._last = FrameFit(shape, light, no_residual, full_weights, True)
        # Nothing is known of frames of this scene yet.
        self._light = math.nan
        self._shown_rad = (math.nan, math.nan)
        self._covariance.drop_request()
        self._squares = light_squares.LightSquares(scene)
        self._jumps.forget_frames()
        self._steps: list[step_means.StepMeans] = []

    def measure_steps(
        self,
        frames: Sequence[Image],
        shifts_rad: FloatArray,
        time_s: FloatArray,
        displacement_um: FloatArray,
    ) -> list[TrackedFrame]:
        """Measure light, swings and phases of each bin from five or more steps of the pattern.

        The film must hardly move meanwhile.

        Parameters
        ----------
        frames : sequence of images
            One frame for each step.
        shifts_rad : (frames, 2) array
            Phase steps of x and y.
        time_s, displacement_um : (frames,) arrays
            As those of `track_frame`.

        Returns
        -------
        list of TrackedFrame
            The frames' figures. If one is rejected or partly covered, the scene keeps the light of
            the reference.
        """
        found = []
        fits = []
        seen_adu = []
        shown = [(float(x), float(y)) for x, y in shifts_rad]
        for frame, shifts, at_s, reading_um in zip(
            frames, shown, time_s, displacement_um, strict=True
        ):
            found.append(self.track_frame(frame, shifts, float(at_s), float(reading_um)))
            fits.append(self._last)
            seen_adu.append(self._clear)

        # Bins that a hand covers in one of the frames have light in none: all must use as many.
        used = [frame.used_share for frame in found]  # 0 where rejected
        if not min(used) > max(max(used) - OTHER_BINS_SHARE, 0):
            return found

        if self._bands.add_wave_of_first_frames():
            # A band was found on the way: fit all frames again with it. Time runs back.
            self._begin_scene(self._fitter.scene, self._last.surface, self._last.light)
            self._last_time_s = math.nan
            return self.measure_steps(frames, shifts_rad, time_s, displacement_um)

        errors_mm2 = np.diag(self._fitter.covariance_mm2(self._last, shown[-1], self._noise_adu))
        moved_mm = self._renew_scene(
            time_s, fits, [errors_mm2] * len(fits), np.stack(seen_adu), shown
        )
        self._mean_place = None  # so few frames show no drift
        radius_mm = self._last.surface.radius_mm
        return [tracked_frame.moved_frame(frame, moved_mm, radius_mm) for frame in found]

    def _renew_scene(
        self,
        time_s: FloatArray,
        fits: list[FrameFit],
        variance_mm2: list[FloatArray],
        seen_adu: Singles,
        shifts_rad: list[Shifts],
    ) -> FloatArray:
        """Solve light, swings and phases of each bin from N steps, and begin a scene with them.

        Parameters
        ----------
        time_s : (N,) array
            Times of the steps.
        fits : list of FrameFit
            Their solutions.
        variance_mm2 : list of (parameters,) arrays
            Variances of the fitted parameters.
        seen_adu : (N, n) array
            Means of the bins, without bands.
        shifts_rad : list of (float, float)
            Phase steps.

        Returns
        -------
        (parameters,) array
            Motion of the surface's parameters that the new phases imply, mm.
        """
        old_light_adu = self._fitter.scene.light_adu[0]
        radius_mm = self._last.surface.radius_mm

        # Where the mirror was in each step: its drift, and motion beyond the errors of the fits.
        fitted_mm = np.array([fit.surface.parameters for fit in fits])
        mean_time_s = float(np.mean(time_s))
        drift_mm_per_s = self._drift_mm_per_s(mean_time_s, fitted_mm.mean(axis=0))
        drifted_mm = np.outer(time_s, drift_mm_per_s)
        places_mm, place_mm2 = step_means.estimate_step_places(
            fitted_mm, np.array(variance_mm2), drifted_mm
        )
        placed_fits = [
            replace(fit, surface=surface.Surface.from_parameters(place_mm, radius_mm))
            for fit, place_mm in zip(fits, places_mm, strict=True)
        ]

        # Light and phases of the bins; the part of the phases that the terms represent moves the
        # surface.
        scene, moved_mm, moved_mm2 = solve_steps(
            self._fitter, placed_fits, seen_adu, np.array(shifts_rad)
        )
        self._watch.take_scene(scene, moved_mm)
        self._mean_place = mean_time_s, places_mm.mean(axis=0) + moved_mm
        self._places_mm2 = dict(zip(shifts_rad, place_mm2 + moved_mm2, strict=True))

        # Light is counted in units of the scene's.
        self._anchor_light /= float(np.median(scene.light_adu[0] / old_light_adu))
        shape = surface.Surface.from_parameters(
            self._last.surface.parameters + moved_mm, scene.surface.radius_mm
        )
        self._begin_scene(scene, shape, np.mean([fit.light for fit in placed_fits], axis=0))
        return moved_mm

    def _drift_mm_per_s(self, time_s: float, place_mm: FloatArray) -> FloatArray:
        """Drift (parameters,) from the mean place in the last five steps to that in these.

        The mean of five steps is free of the errors of each. A drift between single steps would be
        lost in these errors: 0.1 µm in a cycle of five would become a saw-tooth of as much.
        """
        if self._mean_place is None:
            return np.zeros(surface.PARAMETERS)
        before_s, before_mm = self._mean_place
        return np.asarray((place_mm - before_mm) / (time_s - before_s))

    def _add_to_step(
        self, shifts_rad: Shifts, seen_adu: Singles, fit: FrameFit, time_s: float
    ) -> None:
        """Add a good frame to the means of its step; keep the last five steps."""
        if not self._steps or self._steps[-1].shifts_rad != shifts_rad:
            former = self._steps[1 - ENOUGH_STEPS :]
            self._steps = [*former, step_means.StepMeans(shifts_rad)]
        self._steps[-1].add_frame(seen_adu, fit, time_s)

    def prepare(self, shifts_rad: Shifts) -> None:
        """Compute in advance what the next frame, with these phase steps of x and y, needs.

        New error bars take three times as long as a frame's fit, light from five steps twenty
        times: computed between frames, they delay no figure. `track_frame` computes what was not
        prepared.
        """
        self._covariance.estimate_if_due(self._fitter)
        if shifts_rad == self._prepared_rad:
            return
        self._finish_step(shifts_rad)
        if shifts_rad != self._shown_rad:
            self._fitter.prepare(shifts_rad, self._last)
        self._prepared_rad = shifts_rad

    def _finish_step(self, next_shifts_rad: Shifts) -> None:
        """At the end of a step of the pattern, estimate the errors of its mean; renew the scene
        after five steps that separate the axes.
        """
        steps = self._steps
        if not steps or steps[-1].shifts_rad == next_shifts_rad:
            return
        radius_mm = self._last.surface.radius_mm

        # Variance of the mean of the step's frames: of the fit, and of the mirror's place.
        step = steps[-1]
        noise_adu = self._noise_adu / math.sqrt(step.count)
        covariance_mm2 = self._fitter.covariance_mm2(
            step.fit(radius_mm), step.shifts_rad, noise_adu
        )
        step.variance_mm2 = np.diag(covariance_mm2) + self._place_mm2(step.shifts_rad)

        shown = [step.shifts_rad for step in steps]
        if are_steps_separable(np.array(shown)):
            self._renew_scene(
                np.array([step.time_s for step in steps]),
                [step.fit(radius_mm) for step in steps],
                [step.variance_mm2 for step in steps],
                np.stack([step.seen_adu() for step in steps]),
                shown,
            )

    def _place_mm2(self, shifts_rad: Shifts) -> FloatArray:
        """Variance (parameters,) of the mirror's place in the step with these shifts, which all
        frames with these shifts share.
        """
        return self._places_mm2.get(shifts_rad, np.zeros(surface.PARAMETERS))

    def track_frame(
        self,
        frame: Image,
        shifts_rad: Shifts,
        time_s: float,
        displacement_um: float = math.nan,
    ) -> TrackedFrame:
        """Measure the figure of the next frame.

        Parameters
        ----------
        frame : (height, width) array, uint8 or uint16
            The picture.
        shifts_rad : (float, float)
            Phase steps of x and y.
        time_s : float
            Middle of the exposure.
        displacement_um : float
            Laser reading then, a check; NaN without.

        Returns
        -------
        TrackedFrame

        Raises
        ------
        ValueError
            For a frame of wrong size or type.
        """
        self.prepare(shifts_rad)

        # 1. Light of the bins: frozen, saturated, dark or covered frames are not fitted.
        seen_adu, saturated = self._bin_frame(frame)
        is_same = bool(np.array_equal(seen_adu, self._seen))
        self._seen = seen_adu
        if is_same and not self._is_noise_free:
            reason = "frozen: the frame is identical to the one before"
            return tracked_frame.rejected_frame(time_s, reason)
        light, covered = self._squares.judge_light(seen_adu)
        saturated_share = float(np.mean(saturated))
        faults = frame_verdict.light_faults(saturated_share, light, covered)
        faults += frame_verdict.light_changes(light, self._light, self._anchor_light)
        rejected = next((fault for fault in faults if fault.verdict == "rejected"), None)
        if rejected is not None:
            return tracked_frame.rejected_frame(time_s, rejected.reason)

        # 2. The fit, without clipped and covered bins.
        left_out = saturated | self._squares.bins(covered)
        fit = self._fit_frame(seen_adu, shifts_rad, light, left_out, displacement_um)
        swing_adu = self._swing_adu * light
        rest_share = self._robust.scale_adu(fit) / swing_adu
        is_far_off = np.abs(fit.residual_adu) > _FAR_OFF * swing_adu
        outlier_share = float(np.mean((is_far_off & (fit.weights == 0))[~left_out]))

        # 3. Is the solution the next one of this mirror?
        doubt = self._compare_with_last(fit, rest_share, outlier_share, time_s, displacement_um)
        if doubt is not None and doubt.lost and self._robust.has_failed(fit):
            no_fringes = self._squares.explain_failed_fit(seen_adu, float(np.mean(covered)))
            doubt = no_fringes or doubt
        if doubt is not None and doubt.verdict == "rejected":
            return tracked_frame.rejected_frame(time_s, doubt.reason, rest_share, doubt.lost)
        self._accept(fit, light, shifts_rad, time_s, displacement_um)

        # 4. Error bars, and the motions of the bench that explain the frame.
        covariance_mm2 = self._covariance_mm2(fit, shifts_rad, time_s)
        motion = self._watch.find(fit, shifts_rad, self._fitter, covariance_mm2, time_s)
        doubt = doubt or self._judge_motion(motion, covariance_mm2, fit)
        finding = doubt or next(iter(faults), None) or Finding("ok", "")
        if finding.verdict == "ok":
            self._add_to_step(shifts_rad, self._clear, fit, time_s)
            if self._reference_doubt:
                finding = Finding("degraded", self._reference_doubt)
        return self._make_frame(
            fit, covariance_mm2, motion, time_s, finding, rest_share, saturated_share
        )

    def _bin_frame(self, frame: Image) -> tuple[Singles, BoolArray]:
        """Means (n,) of a frame over the scene's bins, and the bins (n,) with a clipped pixel."""
        self._binner.clear_saturation()
        self._binner.sum_frames([frame], [0])
        index = self._fitter.scene.index
        pixels = np.float32(self._binner.bin_px**2)
        means_adu: Singles = self._binner.sums[0].ravel()[index].astype(np.float32) / pixels
        return means_adu, self._binner.saturated.ravel()[index] > 0

    def mean_residual_adu(self) -> FloatArray:
        """Light (rows, columns) that the fits left on average, over the bins; NaN outside the
        mirror.
        """
        out = np.full(self._binner.sums.shape[1:], math.nan)
        out.ravel()[self._fitter.scene.index] = self._residual_sum_adu / max(self._frames, 1)
        return out

    def _fit_frame(
        self,
        seen_adu: Singles,
        shifts_rad: Shifts,
        light: float,
        left_out: BoolArray,
        displacement_um: float,
    ) -> FrameFit:
        """Fit from the last solution; if that fails and the laser saw the film move, from where the
        laser puts it.
        """
        # The maps of light follow the frame's own. If the pattern stepped, they do not: a square
        # shows no whole number of fringes, and its light changes by a per cent with the step.
        brighter = 1.0
        if shifts_rad == self._shown_rad:
            brighter = light / self._light
        maps = self._last.light * brighter
        maps[:, 0] += brighter - 1  # the first term is 1 everywhere
        start = replace(self._last, light=maps)
        fit = self._fit_robustly(seen_adu, shifts_rad, start, left_out)

        # New bands of the backlight, one after the other.
        known = len(self._bands.waves)
        while self._bands.add_wave_of_frame(self._fitter.sum_over_rows()):
            for _ in range(_BAND_FITS):
                begin = start if self._robust.has_failed(fit) else fit
                fit = self._fit_robustly(seen_adu, shifts_rad, begin, left_out)
                if not self._robust.has_failed(fit):
                    self._bands.refine_frequencies(self._fitter.sum_over_rows(), fit.bands)
        if self._robust.has_failed(fit) and len(self._bands.waves) > known:
            # A lost order leaves fringes, which are no bands.
            self._bands.keep_first_waves(known)
            fit = self._fit_robustly(seen_adu, shifts_rad, start, left_out)

        # The film may have moved further than the fit can follow: begin where the laser saw it.
        moved_um = displacement_um - self._last_displacement_um
        if self._robust.has_failed(fit) and math.isfinite(moved_um):
            radius_mm = fit.surface.radius_mm
            bowl = surface.Surface.hencky_bowl(1e-3 * moved_um, radius_mm)
            moved = surface.Surface.from_parameters(
                self._last.surface.parameters + bowl.parameters, radius_mm
            )
            fit = self._fit_robustly(seen_adu, shifts_rad, replace(start, surface=moved), left_out)
        return fit

    def _fit_robustly(
        self, seen_adu: Singles, shifts_rad: Shifts, start: FrameFit, left_out: BoolArray
    ) -> FrameFit:
        """`RobustFitter.fit` with the scale of the last frame."""
        return self._robust.fit(seen_adu, shifts_rad, start, left_out, self._scale_adu)

    def _compare_with_last(
        self,
        fit: FrameFit,
        rest_share: float,
        outlier_share: float,
        time_s: float,
        displacement_um: float,
    ) -> Finding | None:
        """Why the solution is not the next one of this mirror; None if it is.

        Parameters
        ----------
        fit : FrameFit
            The frame's solution.
        rest_share : float
            What it leaves, over the swing of the fringes.
        outlier_share : float
            Share of the bins that are far off.
        time_s, displacement_um : float
            Time of the frame and laser reading then.
        """
        failed = frame_verdict.fit_fault(fit, rest_share, outlier_share)
        if failed is not None:
            return failed

        # Fringe orders: a change of the figure that no film makes in this time.
        change_um = 1e3 * (fit.surface.parameters - self._last.surface.parameters)
        passed_s = time_s - self._last_time_s
        if not math.isfinite(passed_s):
            passed_s = math.inf
        lost = self._orders.find_lost_order(
            change_um, passed_s, displacement_um - self._last_displacement_um
        )
        if lost is not None:
            return lost

        # A knock of camera or screen: a sudden tilt. The verdict stays until a new reference.
        tilt_um = float(np.hypot(*change_um[:2]))
        if math.isfinite(self._last_time_s) and tilt_um > _KNOCK_UM + _KNOCK_UM_PER_S * passed_s:
            urad = 2e3 * tilt_um / fit.surface.radius_mm
            self._knocked = (
                f"knocked: the figure tilted by {urad:.0f} µrad at {time_s:.2f} s; check camera "
                "and screen"
            )
        if self._knocked:
            return Finding("degraded", self._knocked, True)
        return None

    def _accept(
        self,
        fit: FrameFit,
        light: float,
        shifts_rad: Shifts,
        time_s: float,
        displacement_um: float,
    ) -> None:
        """Keep a good frame as the last one."""
        self._last = fit
        self._light = light
        self._shown_rad = shifts_rad
        self._clear = self._seen / self._bands.gain_of_bins(fit.bands)
        if fit.bands.size:
            self._bands.refine_frequencies(self._fitter.sum_over_rows(), fit.bands)
        self._last_time_s = time_s
        self._last_displacement_um = displacement_um
        self._scale_adu = self._robust.scale_adu(fit)
        self._residual_sum_adu = self._residual_sum_adu + fit.residual_adu
        self._frames += 1
        if not math.isfinite(self._anchor_light):
            self._anchor_light = light

    def _judge_motion(
        self, motion: MotionFinding, covariance_mm2: FloatArray, fit: FrameFit
    ) -> Finding | None:
        """Whether the bench has moved by so much that the figure must not be used.

        Smaller motions only widen the error bars.
        """
        tilt_urad = self._watch.tilt_urad(fit.surface)
        reason = find_motion_doubt(motion, covariance_mm2, tilt_urad)
        if not reason:
            return None
        reason = self._compare_with_stain(reason, motion, fit)
        if motion.is_proven:
            self._knocked = reason
        return Finding("degraded", reason, True)

    def _compare_with_stain(self, reason: str, motion: MotionFinding, fit: FrameFit) -> str:
        """The reason by which a motion is doubted, or the stain that explains the frame better;
        both, if the figure is bent by more than a stain does.
        """
        products, powers = self._fitter.explain_residual(fit, self._shown_rad)
        stain = find_stain(products, powers, self._noise_adu)
        if stain is None:
            return reason
        if stain.explains(max(motion.figure_um, motion.hidden_um)):
            return stain.describe()
        return f"{reason}; {stain.describe()}"

    def _covariance_mm2(self, fit: FrameFit, shifts_rad: Shifts, time_s: float) -> FloatArray:
        """Covariance (parameters, parameters) of a frame's fit, on a bench that has not moved."""
        has_new_jump = self._jumps.add_frame(shifts_rad, fit.surface.parameters)
        fit_mm2 = self._covariance.estimate_frame_covariance(
            self._fitter, fit, shifts_rad, time_s, has_new_jump
        )

        # Errors that frames of one step share: the mirror's place in it, and the jumps between
        # steps beyond those of the places.
        places_mm2 = [*self._places_mm2.values()] or [np.zeros(surface.PARAMETERS)]
        jumps_mm2 = self._jumps.variance_mm2(np.mean(places_mm2, axis=0))
        of_step_mm2 = self._place_mm2(shifts_rad) + jumps_mm2
        return np.asarray(fit_mm2 + np.diag(of_step_mm2))

    def _make_frame(
        self,
        fit: FrameFit,
        covariance_mm2: FloatArray,
        motion: MotionFinding,
        time_s: float,
        finding: Finding,
        rest_share: float,
        saturated_share: float,
    ) -> TrackedFrame:
        """The figure of a frame in micrometres, with its error bars.

        Errors of changes contain the motions that the frame shows; those against the reference
        also contain what may have moved without any sign of it.
        """
        to_coeffs = surface.parameter_to_coeffs()
        gradient = surface.sag_gradient()

        # Covariance of a change, and that against the reference.
        change_mm2 = covariance_mm2 + motion.found_mm2
        total_mm2 = change_mm2 + motion.allowed_mm2
        return TrackedFrame(
            time_s=time_s,
            coeffs_um=1e3 * fit.surface.coeffs_mm,
            covariance_um2=1e6 * to_coeffs @ total_mm2 @ to_coeffs.T,
            hencky_um=1e3 * fit.surface.hencky_mm,
            sag_um=1e3 * fit.surface.sag_mm,
            sag_sigma_um=1e3 * math.sqrt(gradient @ total_mm2 @ gradient),
            verdict=finding.verdict,
            reason=finding.reason,
            rest_share=rest_share,
            used_share=float(np.mean(fit.weights > 0)),
            swing_adu=self._swing_adu * (1 + float(fit.light[1, 0])),
            saturated_share=saturated_share,
            lost=finding.lost,
            sag_change_sigma_um=1e3 * math.sqrt(gradient @ change_mm2 @ gradient),
            change_sigma_um=1e3 * np.sqrt(np.diag(to_coeffs @ change_mm2 @ to_coeffs.T)),
        )
