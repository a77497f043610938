"""Follows the figure from frame to frame, and says which frames must not be used and why.

A frame is fitted from the last good solution. A period lost everywhere at once leaves no residual, but it is no tilt
either: rays meet the screen at other distances, so that some micrometres of astigmatism and coma appear (`_Orders`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.optics import surface
from membrane_ctrl.metrology.phasor import Binner
from membrane_ctrl.metrology.track.fit import FrameFit, FrameFitter, squares, stepped
from membrane_ctrl.metrology.track.scene import CrossedScene
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, Singles

# Light of a square of the mirror against the median's: less or more is a hand, a lamp, a blind part of the screen.
_COVERED = 0.25
_COVERED_REJECTED, _COVERED_DEGRADED = 0.25, 0.02
_DARK = 0.3  # of the reference's light
_CONTRAST = 0.4  # of the fringes, against the reference's
_EXPOSURE = 0.03  # change of light from frame to frame that no panel makes
_DIMMED = 0.9  # of the light at the anchor
# What the fit leaves, over the swing of the fringes: noise, light and dust leave hundredths, a lost order 0.7
_REST_REJECTED = 0.15
_OUT_REJECTED = 0.1  # share of bins without weight
_OUT_USUAL = 0.01  # dust and glints
_REACH_SIGMAS = 7.0
_FIRST_REACH = 1e6  # everything counts
_KNOCK_UM, _KNOCK_UM_PER_S = 2.0, 0.5  # RMS of a tilt that neither film nor air makes: 8 urad
_LASER_UM = 20.0  # change of sag from frame to frame, less the laser's
_BLIND_NOISE_ADU = 0.2  # with less noise, two frames of a still mirror may be the same
_SIGMA_EVERY = 25  # frames: errors change slowly, and the covariance costs as much as five fits


@dataclass(frozen=True)
class TrackedFrame:
    """Figure of one frame; NaN where it is rejected."""

    time_s: float  # middle of the exposure
    coeffs_um: FloatArray  # (36,) Noll j = 1..36, the vertex at 0
    sigma_um: FloatArray  # (36,): 1 sigma against the reference's figure
    hencky_um: float
    sag_um: float
    sag_sigma_um: float
    verdict: shape_estimate.Verdict
    reason: str
    rest_share: float  # what the fit leaves, over the swing of the fringes


@dataclass(frozen=True)
class _Fault:
    """Why a frame is not what it should be."""

    verdict: shape_estimate.Verdict
    reason: str


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
        self._blind = noise_adu < _BLIND_NOISE_ADU
        self._noise_adu = math.hypot(noise_adu, math.sqrt(1 / 12)) / scene.bin_px
        self._begin(scene, scene.surface)
        self._last_displacement_um = displacement_um
        self._orders = _Orders(self._fitter)
        self._knocked = ""

    def _begin(self, scene: CrossedScene, shape: surface.Surface) -> None:
        """Start from a scene and a surface, with the light of the scene."""
        none = np.zeros(scene.index.size, np.float32)
        self._fitter = FrameFitter(scene)
        self._last = FrameFit(shape, np.zeros((3, 36)), none, none, True)
        self._last_time_s, self._last_displacement_um = math.nan, math.nan
        self._scale_adu = 0.0
        self._light = self._anchor_light = math.nan
        self._seen: Singles = none
        self._covariance, self._covariance_age = np.full((36, 36), math.nan), 0
        self._squares = _Squares(scene)
        self._left, self._count = np.zeros(scene.index.size), 0

    def anchor(
        self, frames: Sequence[Image], shifts_rad: FloatArray, time_s: FloatArray, displacement_um: FloatArray
    ) -> list[TrackedFrame]:
        """Take light, swings and phases of each bin from steps of the pattern.

        Parameters
        ----------
        frames : five or more frames
            Of a film that moves little.
        shifts_rad : (frames, 2) array
            Their phase steps of x and y.
        time_s, displacement_um : (frames,) arrays
            As in `follow`.

        Returns
        -------
        list of TrackedFrame
            Their figures; if one of them is rejected, the light remains that of the reference.
        """
        found, fits, seen = [], [], []
        for frame, (x, y), at_s, reading in zip(frames, shifts_rad, time_s, displacement_um, strict=True):
            found.append(self.follow(frame, (float(x), float(y)), float(at_s), float(reading)))
            fits.append(self._last)
            seen.append(self._seen)
        if any(frame.verdict == "rejected" for frame in found):
            return found
        scene, moved = stepped(self._fitter, fits, np.stack(seen), shifts_rad)
        known = self._last_time_s, self._last_displacement_um
        parameters = np.mean([fit.surface.parameters for fit in fits], axis=0) + moved
        self._begin(scene, surface.Surface.from_parameters(parameters, scene.surface.radius_mm))
        self._last_time_s, self._last_displacement_um = known
        return [_moved(frame, moved, scene.surface.radius_mm) for frame in found]

    def follow(
        self, frame: Image, shifts_rad: tuple[float, float], time_s: float, displacement_um: float = math.nan
    ) -> TrackedFrame:
        """The figure of the next frame.

        Parameters
        ----------
        frame : (height, width) array
            uint8 or uint16.
        shifts_rad : (float, float)
            Phase steps of x and y.
        time_s : float
            Middle of the exposure.
        displacement_um : float
            Laser reading then, a check; NaN without.

        Raises ValueError for a frame of wrong size or type.
        """
        self._binner.clear()
        self._binner.add([frame], [0])
        index = self._fitter.scene.index
        seen = (self._binner.sums[0].ravel()[index] / np.float32(self._binner.bin_px**2)).astype(np.float32)
        same, self._seen = bool(np.array_equal(seen, self._seen)), seen
        if same and not self._blind:
            return _rejected(time_s, "frozen: the frame is identical to the one before")
        saturated = self._binner.saturated.ravel()[index] > 0
        light, covered = self._squares.look(seen)
        faults = [*_light_faults(float(np.mean(saturated)), light, covered), *self._light_changes(light)]
        rejected = next((f for f in faults if f.verdict == "rejected"), None)
        if rejected is not None:
            return _rejected(time_s, rejected.reason)
        fit = self._fitted(seen, shifts_rad, light, saturated | self._squares.bins(covered), displacement_um)
        rest = self._scale_of(fit) / float(np.median(self._fitter.scene.light_adu[1])) / light
        out = float(np.mean(fit.weights[~saturated & ~self._squares.bins(covered)] == 0))
        doubt = self._doubt(fit, rest, out, time_s, displacement_um)
        if doubt is not None and doubt.verdict == "rejected":
            return _rejected(time_s, doubt.reason, rest)
        self._accept(fit, light, time_s, displacement_um)
        worst = doubt or next(iter(faults), None) or _Fault("ok", "")
        return self._result(fit, shifts_rad, time_s, worst, rest)

    def missed(self, time_s: float, reason: str) -> TrackedFrame:
        """The result of a frame that could not be read."""
        return _rejected(time_s, reason)

    def mean_residual_adu(self) -> FloatArray:
        """Light (rows, columns) that the fits left on average, over the bins; NaN outside the mirror."""
        out = np.full(self._binner.sums.shape[1:], math.nan)
        out.ravel()[self._fitter.scene.index] = self._left / max(self._count, 1)
        return out

    def _light_changes(self, light: float) -> list[_Fault]:
        """What the light says of exposure and panel."""
        faults = []
        if abs(light / self._light - 1) > _EXPOSURE:
            faults.append(
                _Fault("degraded", f"exposure changed: {light / self._light:.2f} of the light of the last frame")
            )
        elif light < _DIMMED * self._anchor_light:
            faults.append(_Fault("degraded", f"the screen dimmed to {light / self._anchor_light:.0%} of its light"))
        return faults

    def _fitted(
        self,
        seen: Singles,
        shifts_rad: tuple[float, float],
        light: float,
        left_out: BoolArray,
        displacement_um: float,
    ) -> FrameFit:
        """Fit from the last solution; if that fails and the laser saw the film move, from where the laser puts it."""
        brighter = light / (self._light if math.isfinite(self._light) else 1.0)
        maps = self._last.light * brighter
        maps[:, 0] += brighter - 1  # the first term is 1 everywhere
        start = replace(self._last, light=maps)
        fit = self._robust(seen, shifts_rad, start, left_out)
        moved_um = displacement_um - self._last_displacement_um
        if self._lost(fit) and math.isfinite(moved_um):
            bowl = surface.Surface.hencky_bowl(1e-3 * moved_um, fit.surface.radius_mm).parameters
            there = surface.Surface.from_parameters(self._last.surface.parameters + bowl, fit.surface.radius_mm)
            fit = self._robust(seen, shifts_rad, replace(start, surface=there), left_out)
        return fit

    def _robust(
        self, seen: Singles, shifts_rad: tuple[float, float], start: FrameFit, left_out: BoolArray
    ) -> FrameFit:
        """Fit with Tukey's weights, at first of the last frame's scale: a film that moved needs all bins to begin."""
        fit = start
        for first in filter(None, (self._scale_adu, _FIRST_REACH)):
            fit, scale = start, first
            for _ in range(4):
                fit = self._fitter.fit(seen, shifts_rad, fit, np.where(left_out, 0.0, _REACH_SIGMAS * scale))
                found = self._scale_of(fit)
                if 0.67 * scale < found < 1.5 * scale or self._lost(fit):
                    break
                scale = found
            if fit.converged and np.mean(fit.weights[~left_out] == 0) < _OUT_USUAL:
                break
        return fit

    def _scale_of(self, fit: FrameFit) -> float:
        """Robust sigma of the residual: the median of its size, unless rounding makes that less than the noise."""
        return max(1.4826 * float(np.median(np.abs(fit.residual_adu[::3]))), self._noise_adu)

    def _lost(self, fit: FrameFit) -> bool:
        swing = float(np.median(self._fitter.scene.light_adu[1]))
        return not fit.converged or self._scale_of(fit) > _REST_REJECTED * swing

    def _doubt(self, fit: FrameFit, rest: float, out: float, time_s: float, displacement_um: float) -> _Fault | None:
        """Whether the solution is the next one of this mirror."""
        if not fit.converged or rest > _REST_REJECTED or out > _OUT_REJECTED:
            left = f"the fit leaves {rest:.0%} of the fringes, {out:.0%} of the bins do not fit"
            return _Fault("rejected", f"order lost: the mirror moved too far since the last good frame ({left})")
        contrast = float(np.min(1 + fit.light[1:, 0]) / (1 + fit.light[0, 0]))  # of the first term, 1 everywhere
        if contrast < -_CONTRAST:
            return _Fault("rejected", "order lost: the fringes moved by half a period")
        if contrast < _CONTRAST:
            return _Fault("rejected", f"no fringes: {abs(contrast):.0%} of the reference's contrast")
        change_um = 1e3 * (fit.surface.parameters - self._last.surface.parameters)
        passed_s = time_s - self._last_time_s
        passed_s = passed_s if math.isfinite(passed_s) else math.inf
        if not self._orders.sure(change_um, passed_s):
            return _Fault(
                "rejected",
                "order lost: the mirror moved by a period or more since the last good frame, or changed its shape "
                f"(tilt {np.hypot(*change_um[:2]):.0f} um RMS, other terms {self._orders.odd_um(change_um):.1f})",
            )
        sag_um = float(surface.sag_gradient() @ change_um)
        if abs(sag_um - (displacement_um - self._last_displacement_um)) > _LASER_UM:
            return _Fault("rejected", f"the sag changed by {sag_um:.0f} um, which the laser did not see")
        tilt_um = float(np.hypot(*change_um[:2]))
        if math.isfinite(self._last_time_s) and tilt_um > _KNOCK_UM + _KNOCK_UM_PER_S * passed_s:
            urad = 2e3 * tilt_um / fit.surface.radius_mm
            self._knocked = (
                f"knocked: the figure tilted by {urad:.0f} urad at {time_s:.2f} s; check camera and screen"
            )
        return _Fault("degraded", self._knocked) if self._knocked else None

    def _accept(self, fit: FrameFit, light: float, time_s: float, displacement_um: float) -> None:
        self._last, self._light = fit, light
        self._last_time_s, self._last_displacement_um = time_s, displacement_um
        self._scale_adu = self._scale_of(fit)
        self._left, self._count = self._left + fit.residual_adu, self._count + 1
        if not math.isfinite(self._anchor_light):
            self._anchor_light = light

    def _result(
        self, fit: FrameFit, shifts_rad: tuple[float, float], time_s: float, fault: _Fault, rest: float
    ) -> TrackedFrame:
        if self._covariance_age % _SIGMA_EVERY == 0:
            found = self._fitter.covariance_mm2(fit, shifts_rad, self._noise_adu)
            known = np.isfinite(self._covariance).all()
            self._covariance = 0.7 * self._covariance + 0.3 * found if known else found
        self._covariance_age += 1
        to_coeffs, gradient = surface.parameter_to_coeffs(), surface.sag_gradient()
        return TrackedFrame(
            time_s=time_s,
            coeffs_um=1e3 * fit.surface.coeffs_mm,
            sigma_um=1e3 * np.sqrt(np.diag(to_coeffs @ self._covariance @ to_coeffs.T)),
            hencky_um=1e3 * fit.surface.hencky_mm,
            sag_um=1e3 * fit.surface.sag_mm,
            sag_sigma_um=1e3 * math.sqrt(gradient @ self._covariance @ gradient),
            verdict=fault.verdict,
            reason=fault.reason,
            rest_share=rest,
        )


def _light_faults(saturated: float, light: float, covered: BoolArray) -> list[_Fault]:
    """What the picture's light says before any fit."""
    share = float(np.mean(covered))
    checks = (
        (
            saturated > shape_estimate.SATURATED_REJECTED_FRACTION,
            "rejected",
            f"saturated: {saturated:.0%} of the bins",
        ),
        (light < _DARK, "rejected", f"dark: {light:.0%} of the reference's light"),
        (share > _COVERED_REJECTED, "rejected", f"covered: the light of {share:.0%} of the mirror is wrong"),
        (
            saturated > shape_estimate.SATURATED_DEGRADED_FRACTION,
            "degraded",
            f"saturated: {saturated:.1%} of the bins",
        ),
        (share > _COVERED_DEGRADED, "degraded", f"covered: {share:.0%} of the mirror is left out"),
    )
    return [_Fault(verdict, reason) for wrong, verdict, reason in checks if wrong]  # type: ignore[arg-type]


def _moved(frame: TrackedFrame, by_mm: FloatArray, radius_mm: float) -> TrackedFrame:
    """The frame with a change of the surface's parameters."""
    change = surface.Surface.from_parameters(by_mm, radius_mm)
    return replace(
        frame,
        coeffs_um=frame.coeffs_um + 1e3 * change.coeffs_mm,
        hencky_um=frame.hencky_um + 1e3 * change.hencky_mm,
        sag_um=frame.sag_um + 1e3 * change.sag_mm,
    )


def _rejected(time_s: float, reason: str, rest: float = math.nan) -> TrackedFrame:
    none = np.full(36, math.nan)
    return TrackedFrame(time_s, none, none, math.nan, math.nan, math.nan, "rejected", reason, rest)


class _Squares:
    """The mirror in squares, each larger than a fringe, for the light of a frame."""

    def __init__(self, scene: CrossedScene) -> None:
        self._number = squares(scene.position_mm, scene.surface.radius_mm, 12)
        self._count = np.bincount(self._number)
        self._whole = self._count > 0.5 * np.median(self._count)  # at the rim a part shows no whole fringe
        self._level = self._means(scene.light_adu[0])

    def _means(self, values: FloatArray | Singles) -> FloatArray:
        return np.asarray(np.bincount(self._number, values) / self._count)

    def look(self, seen: Singles) -> tuple[float, BoolArray]:
        """Light of a frame over the scene's, and the squares whose light is wrong."""
        share = self._means(seen) / self._level
        light = float(np.median(share[self._whole]))
        return light, self._whole & (np.abs(share - light) > _COVERED * max(light, 1e-6))

    def bins(self, chosen: BoolArray) -> BoolArray:
        """The bins (n,) of squares."""
        return np.asarray(chosen[self._number])


class _Orders:
    """What a change of shape would be if whole periods were lost."""

    def __init__(self, fitter: FrameFitter) -> None:
        bowl = surface.Surface.hencky_bowl(1.0, fitter.scene.surface.radius_mm).parameters
        self._bowl = bowl / np.linalg.norm(bowl)
        x, y = fitter.period_um()
        pairs = [(m, n) for m in range(-8, 9) for n in range(-8, 9) if m or n]
        self._lost_um = np.array([m * x + n * y for m, n in pairs])

    def odd_um(self, change_um: FloatArray) -> FloatArray:
        """RMS of a change (..., 36) without its tilt and without its bowl."""
        rest = np.array(change_um)
        rest[..., :2] = 0.0
        rest -= (rest @ self._bowl)[..., None] * self._bowl
        return np.asarray(np.linalg.norm(rest, axis=-1))

    def sure(self, change_um: FloatArray, passed_s: float) -> bool:
        """Whether a change is that of a film, and would not be with any orders lost."""
        usual_um = min(0.5 + 0.05 * passed_s, 1.0)

        def strange(change: FloatArray) -> FloatArray:
            tilt_um = np.hypot(change[..., 0], change[..., 1])
            return np.asarray((self.odd_um(change) / usual_um) ** 2 + (tilt_um / 150.0) ** 2)

        own = float(strange(change_um))
        return own < 16.0 and bool(np.all(strange(change_um + self._lost_um) > own + 16.0))
