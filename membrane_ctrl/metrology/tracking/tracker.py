"""Follows the figure from frame to frame, and says which frames must not be used and why.

A frame is fitted from the last good solution. A period lost everywhere at once leaves no residual,
but it is no tilt
either: rays meet the screen at other distances, so that micrometres of astigmatism and coma appear
(`LostOrders`).
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
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter
from membrane_ctrl.metrology.tracking.frame_verdict import Finding
from membrane_ctrl.metrology.tracking.step_solution import (
    ENOUGH_STEPS,
    are_steps_separable,
    solve_steps,
)
from membrane_ctrl.metrology.tracking.tracked_frame import TrackedFrame
from membrane_ctrl.metrology.uncertainty.motion_evidence import MotionFinding, find_motion_doubt
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, Singles
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

_FAR_OFF = 0.05  # over the swing: dust that moved is no lost order
_OUT_USUAL = 0.01  # dust and glints
_REACH_SIGMAS = 7.0
_FIRST_REACH = 1e6  # everything counts
_KNOCK_UM, _KNOCK_UM_PER_S = 2.0, 0.5  # RMS of a tilt that neither film nor air makes: 8 µrad
# with less, frames of a still mirror may be the same; here a pixel in 90 differs
_BLIND_NOISE_ADU = 0.01
_OTHER_BINS = 0.03  # change of their share with weight with which the errors change, too
_SIGMA_EVERY_S = 2.5  # errors change slowly, and the covariance costs as much as eight fits


class Tracker:
    """Follows the figure.

    Parameters
    ----------
    scene : CrossedScene
        Of the reference.
    size_px : (int, int)
        Height and width of the frames.
    full_scale_adu : int
        Value of a saturated pixel.
    noise_adu : float
        Noise of a pixel.
    displacement_um : float
        Laser reading of the reference; NaN without.

    Raises ValueError if no frame could tell a lost period from a film that moved.
    """

    def __init__(
        self,
        scene: CrossedScene,
        size_px: tuple[int, int],
        full_scale_adu: int,
        noise_adu: float,
        displacement_um: float = math.nan,
    ) -> None:
        self._binner = Binner(*size_px, scene.bin_px, full_scale_adu, 1)
        self._seen: Singles = np.zeros(scene.index.size, np.float32)
        self._clear = self._seen  # of the last frame, without bands
        self._scale_adu = 0.0
        self._blind = noise_adu < _BLIND_NOISE_ADU
        self._noise_adu = math.hypot(noise_adu, math.sqrt(1 / 12)) / scene.bin_px
        self._bands = Bands(scene.row)
        self._fitter = FrameFitter(scene, self._bands)
        self._jumps = step_jumps.Jumps()
        self._begin(scene, scene.surface, np.zeros((3, ZERNIKE_TERMS)))
        self._last_time_s, self._last_displacement_um = math.nan, displacement_um
        self._anchor_light = math.nan
        self._orders = lost_orders.LostOrders(self._fitter)
        self._orders.require_telling()
        self._watch = BenchWatch(self._fitter)
        self._knocked = ""
        # its time, parameters: of the last five steps
        self._mean_place: tuple[float, FloatArray] | None = None
        self._places_mm2: dict[tuple[float, float], FloatArray] = {}  # by the shifts of a step
        self._fit_mm2, self._covariance_s = np.full((surface.PARAMETERS,) * 2, math.nan), -math.inf
        self._used_share = math.nan  # of the bins, when errors were estimated
        self._prepared_rad = (math.nan, math.nan)
        self._left, self._count = np.zeros(scene.index.size), 0

    def _begin(self, scene: CrossedScene, shape: surface.Surface, light: FloatArray) -> None:
        """Start from a scene, a surface and maps (3, terms) of light."""
        none, all_bins = (
            np.zeros(scene.index.size, np.float32),
            np.ones(scene.index.size, np.float32),
        )
        self._swing_adu = float(np.median(scene.light_adu[1]))
        self._fitter = FrameFitter(scene, self._bands, self._fitter.jacobian)
        self._last = FrameFit(shape, light, none, all_bins, True)
        self._light, self._shown_rad = math.nan, (math.nan, math.nan)
        self._errors_due: tuple[FrameFit, tuple[float, float]] | None = None
        self._squares = light_squares.Squares(scene)
        self._jumps.begin()
        self._steps: list[step_means.StandingFrames] = []

    def anchor(
        self,
        frames: Sequence[Image],
        shifts_rad: FloatArray,
        time_s: FloatArray,
        displacement_um: FloatArray,
    ) -> list[TrackedFrame]:
        """Take light, swings and phases of each bin from five steps of the pattern or more; the
        film moves little.

        Frames, `shifts_rad` (frames, 2), `time_s` and `displacement_um` (frames,) are those of
        `follow`. Returns the frames' figures; if one is rejected or partly covered, the light
        remains that of the reference.
        """
        found, fits, seen = [], [], []
        for frame, (x, y), at_s, reading in zip(
            frames, shifts_rad, time_s, displacement_um, strict=True
        ):
            found.append(self.follow(frame, (float(x), float(y)), float(at_s), float(reading)))
            fits.append(self._last)
            seen.append(self._clear)
        used = [frame.used_share for frame in found]  # 0 where rejected
        if not min(used) > max(
            max(used) - _OTHER_BINS, 0
        ):  # what a hand covers in one has light in none
            return found
        if self._bands.recall():
            self._begin(self._fitter.scene, self._last.surface, self._last.light)
            self._last_time_s = math.nan  # time runs back
            return self.anchor(frames, shifts_rad, time_s, displacement_um)
        shown = [(float(x), float(y)) for x, y in shifts_rad]
        errors_mm2 = np.diag(self._fitter.covariance_mm2(self._last, shown[-1], self._noise_adu))
        moved = self._renew(time_s, fits, [errors_mm2] * len(fits), np.stack(seen), shown)
        self._mean_place = None  # a few frames tell no drift
        return [
            tracked_frame.moved_frame(frame, moved, self._last.surface.radius_mm) for frame in found
        ]

    def _renew(
        self,
        time_s: FloatArray,
        fits: list[FrameFit],
        variance_mm2: list[FloatArray],
        seen_adu: Singles,
        shifts_rad: list[tuple[float, float]],
    ) -> FloatArray:
        """Light, swings and phases of each bin from steps; returns by how much the parameters
        (parameters,) move.

        `variance_mm2` are those of the fits' parameters, each (parameters,).
        """
        old, radius_mm = self._fitter.scene, self._last.surface.radius_mm
        fitted = np.array([fit.surface.parameters for fit in fits])
        drifted_mm = np.outer(
            time_s, self._drift_mm_per_s(float(np.mean(time_s)), fitted.mean(axis=0))
        )
        seen_at, place_mm2 = step_means.estimate_step_places(
            fitted, np.array(variance_mm2), drifted_mm
        )
        places = [surface.Surface.from_parameters(place, radius_mm) for place in seen_at]
        fits = [replace(fit, surface=place) for fit, place in zip(fits, places, strict=True)]
        scene, moved, moved_mm2 = solve_steps(self._fitter, fits, seen_adu, np.array(shifts_rad))
        self._watch.take_scene(scene, moved)
        self._mean_place = float(np.mean(time_s)), seen_at.mean(axis=0) + moved
        self._places_mm2 = dict(zip(shifts_rad, place_mm2 + moved_mm2, strict=True))
        self._anchor_light /= float(
            np.median(scene.light_adu[0] / old.light_adu[0])
        )  # light counts from the scene's
        parameters = self._last.surface.parameters + moved
        shape = surface.Surface.from_parameters(parameters, scene.surface.radius_mm)
        self._begin(scene, shape, np.mean([fit.light for fit in fits], axis=0))
        return moved

    def _drift_mm_per_s(self, time_s: float, place_mm: FloatArray) -> FloatArray:
        """Of the parameters (parameters,), from the mean place in the last five steps to that in
        these.

        The mean of five steps is free of the errors of each. Taken from the steps themselves, a
        drift was lost in these errors: 0.1 µm in a cycle of five became a saw-tooth of as much.
        """
        if self._mean_place is None:
            return np.zeros(surface.PARAMETERS)
        before_s, before_mm = self._mean_place
        return np.asarray((place_mm - before_mm) / (time_s - before_s))

    def _remember(
        self, shifts_rad: tuple[float, float], seen_adu: Singles, fit: FrameFit, time_s: float
    ) -> None:
        """Add a good frame to its step."""
        if not self._steps or self._steps[-1].shifts_rad != shifts_rad:
            self._steps = [
                *self._steps[1 - ENOUGH_STEPS :],
                step_means.StandingFrames(shifts_rad),
            ]
        self._steps[-1].add(seen_adu, fit, time_s)

    def prepare(self, shifts_rad: tuple[float, float]) -> None:
        """Do ahead what the next frame, with these phase steps of x and y, needs.

        New error bars take three times as long as a frame's fit, light from five steps twenty
        times: between frames they make no figure late. `follow` does what was not done ahead.
        """
        if self._errors_due is not None:
            self._estimate_errors(*self._errors_due)
        if shifts_rad == self._prepared_rad:
            return
        self._take_steps(shifts_rad)
        if shifts_rad != self._shown_rad:
            self._fitter.prepare(shifts_rad, self._last)
        self._prepared_rad = shifts_rad

    def _take_steps(self, shifts_rad: tuple[float, float]) -> None:
        """At the end of a step of the pattern, judge its mean; renew the scene after five that
        separate the axes.
        """
        steps = self._steps
        if not steps or steps[-1].shifts_rad == shifts_rad:
            return
        radius_mm = self._last.surface.radius_mm
        last, noise_adu = steps[-1].fit(radius_mm), self._noise_adu / math.sqrt(steps[-1].count)
        errors_mm2 = np.diag(self._fitter.covariance_mm2(last, steps[-1].shifts_rad, noise_adu))
        steps[-1].variance_mm2 = errors_mm2 + self._place_mm2(steps[-1].shifts_rad)
        shown = [step.shifts_rad for step in steps]
        if are_steps_separable(np.array(shown)):
            fits, variance_mm2 = (
                [step.fit(radius_mm) for step in steps],
                [step.variance_mm2 for step in steps],
            )
            times_s = np.array([step.time_s for step in steps])
            self._renew(
                times_s, fits, variance_mm2, np.stack([step.seen_adu() for step in steps]), shown
            )

    def _place_mm2(self, shifts_rad: tuple[float, float]) -> FloatArray:
        """Variance (parameters,) of the place at which the steps saw the mirror with these shifts,
        common to their frames."""
        return self._places_mm2.get(shifts_rad, np.zeros(surface.PARAMETERS))

    def follow(
        self,
        frame: Image,
        shifts_rad: tuple[float, float],
        time_s: float,
        displacement_um: float = math.nan,
    ) -> TrackedFrame:
        """The figure of the next frame.

        Parameters
        ----------
        frame : (height, width) array, uint8 or uint16
        shifts_rad : (float, float)
            Phase steps of x and y.
        time_s : float
            Middle of the exposure.
        displacement_um : float
            Laser reading then, a check; NaN without.

        Raises ValueError for a frame of wrong size or type.
        """
        self.prepare(shifts_rad)
        self._binner.clear()
        self._binner.add([frame], [0])
        index = self._fitter.scene.index
        seen = self._binner.sums[0].ravel()[index].astype(np.float32) / np.float32(
            self._binner.bin_px**2
        )
        same, self._seen = bool(np.array_equal(seen, self._seen)), seen
        if same and not self._blind:
            return tracked_frame.rejected_frame(
                time_s, "frozen: the frame is identical to the one before"
            )
        saturated = self._binner.saturated.ravel()[index] > 0
        light, covered = self._squares.look(seen)
        faults = frame_verdict.light_faults(float(np.mean(saturated)), light, covered)
        faults += frame_verdict.light_changes(light, self._light, self._anchor_light)
        rejected = next((f for f in faults if f.verdict == "rejected"), None)
        if rejected is not None:
            return tracked_frame.rejected_frame(time_s, rejected.reason)
        fit = self._fitted(
            seen, shifts_rad, light, saturated | self._squares.bins(covered), displacement_um
        )
        swing_adu = self._swing_adu * light
        rest, far = self._scale_of(fit) / swing_adu, np.abs(fit.residual_adu) > _FAR_OFF * swing_adu
        out = float(np.mean((far & (fit.weights == 0))[~saturated & ~self._squares.bins(covered)]))
        doubt = self._doubt(fit, rest, out, time_s, displacement_um)
        if doubt is not None and doubt.lost and self._lost(fit):
            doubt = self._squares.blinded(seen, float(np.mean(covered))) or doubt
        if doubt is not None and doubt.verdict == "rejected":
            return tracked_frame.rejected_frame(time_s, doubt.reason, rest, doubt.lost)
        self._accept(fit, light, shifts_rad, time_s, displacement_um)
        covariance_mm2 = self._covariance_mm2(fit, shifts_rad, time_s)
        motion = self._watch.find(fit, shifts_rad, self._fitter, covariance_mm2, time_s)
        doubt = doubt or self._bench_doubt(motion, covariance_mm2, fit)
        worst = doubt or next(iter(faults), None) or Finding("ok", "")
        if worst.verdict == "ok":
            self._remember(shifts_rad, self._clear, fit, time_s)
        steady_mm2 = covariance_mm2 + motion.found_mm2
        gradient, to_coeffs = surface.sag_gradient(), surface.parameter_to_coeffs()
        found = self._result(fit, steady_mm2 + motion.allowed_mm2, time_s, worst, rest)
        return replace(
            found,
            steady_sag_sigma_um=1e3 * math.sqrt(gradient @ steady_mm2 @ gradient),
            steady_sigma_um=1e3 * np.sqrt(np.diag(to_coeffs @ steady_mm2 @ to_coeffs.T)),
            saturated_share=float(np.mean(saturated)),
        )

    def mean_residual_adu(self) -> FloatArray:
        """Light (rows, columns) that the fits left on average, over the bins; NaN outside the
        mirror.
        """
        out = np.full(self._binner.sums.shape[1:], math.nan)
        out.ravel()[self._fitter.scene.index] = self._left / max(self._count, 1)
        return out

    def _fitted(
        self,
        seen: Singles,
        shifts_rad: tuple[float, float],
        light: float,
        left_out: BoolArray,
        displacement_um: float,
    ) -> FrameFit:
        """Fit from the last solution; if that fails and the laser saw the film move, from where the
        laser puts it.
        """
        # A square shows no whole number of fringes: where these step, its light changes by a per
        # cent, which the maps must not follow.
        brighter = light / self._light if shifts_rad == self._shown_rad else 1.0
        maps = self._last.light * brighter
        maps[:, 0] += brighter - 1  # the first term is 1 everywhere
        start = replace(self._last, light=maps)
        known = len(self._bands.waves)
        fit = self._robust(seen, shifts_rad, start, left_out)
        while self._bands.search(self._fitter.rows()):
            for _ in range(2):  # the second time with the frequency that the first one leaves
                fit = self._robust(seen, shifts_rad, start if self._lost(fit) else fit, left_out)
                if not self._lost(fit):
                    self._bands.refine(self._fitter.rows(), fit.bands)
        if (
            self._lost(fit) and len(self._bands.waves) > known
        ):  # a lost order leaves fringes, which are no bands
            self._bands.keep(known)
            fit = self._robust(seen, shifts_rad, start, left_out)
        moved_um = displacement_um - self._last_displacement_um
        if self._lost(fit) and math.isfinite(moved_um):
            bowl = surface.Surface.hencky_bowl(1e-3 * moved_um, fit.surface.radius_mm).parameters
            there = surface.Surface.from_parameters(
                self._last.surface.parameters + bowl, fit.surface.radius_mm
            )
            fit = self._robust(seen, shifts_rad, replace(start, surface=there), left_out)
        return fit

    def _robust(
        self, seen: Singles, shifts_rad: tuple[float, float], start: FrameFit, left_out: BoolArray
    ) -> FrameFit:
        """Fit without outliers, at first of the last frame's scale: a film that moved needs all
        bins to begin.
        """
        fit = start
        # light wanders in proportion to itself: bright fringes in a bright patch are no outliers
        bright = np.maximum(seen / self._fitter.light_adu[0], np.float32(1)) * ~left_out
        for first in filter(None, (self._scale_adu, _FIRST_REACH)):
            fit, scale = start, first
            for _ in range(4):
                fit = self._fitter.fit(
                    seen, shifts_rad, fit, np.float32(_REACH_SIGMAS * scale) * bright
                )
                found = self._scale_of(fit)
                if 0.67 * scale < found < 1.5 * scale or self._lost(fit):
                    break
                scale = found
            if fit.converged and np.mean(fit.weights[~left_out] == 0) < _OUT_USUAL:
                break
        return fit

    def _scale_of(self, fit: FrameFit) -> float:
        """Robust sigma of the residual: the median of its size, unless rounding makes that less
        than the noise.
        """
        return max(fit.scale_adu, self._noise_adu)

    def _lost(self, fit: FrameFit) -> bool:
        return (
            not fit.converged or self._scale_of(fit) > frame_verdict.REST_REJECTED * self._swing_adu
        )

    def _doubt(
        self, fit: FrameFit, rest: float, out: float, time_s: float, displacement_um: float
    ) -> Finding | None:
        """Whether the solution is the next one of this mirror."""
        failed = frame_verdict.fit_fault(fit, rest, out)
        if failed is not None:
            return failed
        change_um = 1e3 * (fit.surface.parameters - self._last.surface.parameters)
        passed_s = time_s - self._last_time_s
        passed_s = passed_s if math.isfinite(passed_s) else math.inf
        strange = self._orders.doubt(
            change_um, passed_s, displacement_um - self._last_displacement_um
        )
        if strange is not None:
            return strange
        tilt_um = float(np.hypot(*change_um[:2]))
        if math.isfinite(self._last_time_s) and tilt_um > _KNOCK_UM + _KNOCK_UM_PER_S * passed_s:
            urad = 2e3 * tilt_um / fit.surface.radius_mm
            self._knocked = (
                f"knocked: the figure tilted by {urad:.0f} µrad at {time_s:.2f} s; check camera "
                "and screen"
            )
        return Finding("degraded", self._knocked, True) if self._knocked else None

    def _accept(
        self,
        fit: FrameFit,
        light: float,
        shifts_rad: tuple[float, float],
        time_s: float,
        displacement_um: float,
    ) -> None:
        self._last, self._light, self._shown_rad = fit, light, shifts_rad
        self._clear = self._seen / self._bands.gain(fit.bands)
        if fit.bands.size:
            self._bands.refine(self._fitter.rows(), fit.bands)
        self._last_time_s, self._last_displacement_um = time_s, displacement_um
        self._scale_adu = self._scale_of(fit)
        self._left, self._count = self._left + fit.residual_adu, self._count + 1
        if not math.isfinite(self._anchor_light):
            self._anchor_light = light

    def _bench_doubt(
        self, motion: MotionFinding, covariance_mm2: FloatArray, fit: FrameFit
    ) -> Finding | None:
        """Whether the bench has moved by so much that the figure must not be used.

        What is less is in the error bars alone.
        """
        tilt_urad = self._watch.tilt_urad(fit.surface)
        reason = find_motion_doubt(motion, covariance_mm2, tilt_urad)
        if motion.is_sure and reason:
            self._knocked = reason
        return Finding("degraded", reason, True) if reason else None

    def _covariance_mm2(
        self, fit: FrameFit, shifts_rad: tuple[float, float], time_s: float
    ) -> FloatArray:
        """Covariance (parameters, parameters) of a frame's fit, on a bench that has not moved."""
        if (
            self._jumps.add(shifts_rad, fit.surface.parameters)
            or time_s >= self._covariance_s + _SIGMA_EVERY_S
        ):
            self._covariance_s, self._errors_due = time_s, (fit, shifts_rad)
        used = float(np.mean(fit.weights > 0))
        if not abs(used - self._used_share) < _OTHER_BINS or np.isnan(self._fit_mm2).any():
            self._fit_mm2, self._used_share = np.full_like(self._fit_mm2, math.nan), used
            self._estimate_errors(fit, shifts_rad)
        places_mm2 = [*self._places_mm2.values()] or [np.zeros(surface.PARAMETERS)]
        apart_mm2 = self._place_mm2(shifts_rad) + self._jumps.variance_mm2(
            np.mean(places_mm2, axis=0)
        )
        return np.asarray(self._fit_mm2 + np.diag(apart_mm2))

    def _result(
        self,
        fit: FrameFit,
        covariance_mm2: FloatArray,
        time_s: float,
        fault: Finding,
        rest: float,
    ) -> TrackedFrame:
        used = float(np.mean(fit.weights > 0))
        to_coeffs, gradient = surface.parameter_to_coeffs(), surface.sag_gradient()
        return TrackedFrame(
            time_s=time_s,
            coeffs_um=1e3 * fit.surface.coeffs_mm,
            covariance_um2=1e6 * to_coeffs @ covariance_mm2 @ to_coeffs.T,
            hencky_um=1e3 * fit.surface.hencky_mm,
            sag_um=1e3 * fit.surface.sag_mm,
            sag_sigma_um=1e3 * math.sqrt(gradient @ covariance_mm2 @ gradient),
            verdict=fault.verdict,
            reason=fault.reason,
            rest_share=rest,
            used_share=used,
            swing_adu=self._swing_adu * (1 + float(fit.light[1, 0])),
            lost=fault.lost,
        )

    def _estimate_errors(self, fit: FrameFit, shifts_rad: tuple[float, float]) -> None:
        """Covariance of a fit's parameters, smoothed over the estimates."""
        self._errors_due = None
        found = self._fitter.covariance_mm2(fit, shifts_rad, self._noise_adu)
        self._fit_mm2 = (
            0.7 * self._fit_mm2 + 0.3 * found if np.isfinite(self._fit_mm2).all() else found
        )
