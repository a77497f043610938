"""A tracked frame: its figure, faults that its light shows, whether its change can be a film's, the
mean of many.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.numerics.grouped_sums import sums_by
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.frame_fit import ENOUGH_STEPS, FrameFit, FrameFitter
from membrane_ctrl.model import shape_estimate, zernike_terms
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray, Singles

# Light of a square of the mirror against the median's: less or more is a hand, a lamp, a blind part
# of the screen.
_COVERED = 0.25
_COVERED_REJECTED, _COVERED_DEGRADED = 0.25, 0.02
# contrast of a square against the median's: less is no fringe but a grey thing before it
_GREY = 0.3
_CONTRAST = 0.4  # of the fringes, against the reference's
_EXPOSURE = 0.03  # change of light from frame to frame that no panel makes
_DIMMED = 0.9  # of the light at the anchor
# What the fit leaves, over the swing of the fringes: noise, light and dust leave hundredths, a lost
# order 0.7
REST_REJECTED = 0.15
_OUT_REJECTED = 0.1  # share of bins without weight and far off
_LASER_UM = 20.0  # change of sag from frame to frame, less the laser's
_UNEVEN = 0.1  # of a square's light: as much of a fringe does not average out in it
_DARK = 0.3  # of the reference's light
_STANDING_MM = 3e-3  # within it, the mean of frames is the frame of the mean: to a nanometre
# share of the errors of the steps' fits that stays where these say nothing of a motion
_STILL = 0.2
_NONE = np.full(zernike_terms.ZERNIKE_TERMS, math.nan)
_NO_COVARIANCE = np.full((_NONE.size, _NONE.size), math.nan)


@dataclass(frozen=True)
class TrackedFrame:
    """Figure of one frame; NaN where it is rejected."""

    time_s: float  # middle of the exposure
    coeffs_um: FloatArray  # (terms,) in Noll's order, the vertex at 0
    covariance_um2: FloatArray  # (terms, terms): of the error against the reference's figure
    hencky_um: float
    sag_um: float
    sag_sigma_um: float
    verdict: shape_estimate.Verdict
    reason: str
    rest_share: float  # what the fit leaves, over the swing of the fringes
    used_share: float = 0.0  # of the bins, those with weight
    swing_adu: float = math.nan  # of the fringes, median
    saturated_share: float = 0.0  # of the bins
    # the mirror may not be where the last good frame left it: a new reference is needed
    lost: bool = False

    @property
    def sigma_um(self) -> FloatArray:
        """(terms,): 1 sigma against the reference's figure."""
        return np.sqrt(np.diag(self.covariance_um2))


def moved_frame(frame: TrackedFrame, by_mm: FloatArray, radius_mm: float) -> TrackedFrame:
    """The frame with a change of the surface's parameters."""
    change = surface.Surface.from_parameters(by_mm, radius_mm)
    return replace(
        frame,
        coeffs_um=frame.coeffs_um + 1e3 * change.coeffs_mm,
        hencky_um=frame.hencky_um + 1e3 * change.hencky_mm,
        sag_um=frame.sag_um + 1e3 * change.sag_mm,
    )


def rejected_frame(
    time_s: float, reason: str, rest: float = math.nan, lost: bool = False
) -> TrackedFrame:
    nan = math.nan
    return TrackedFrame(
        time_s, _NONE, _NO_COVARIANCE, nan, nan, nan, "rejected", reason, rest, lost=lost
    )


class StandingFrames:
    """Means of the frames of one step of the pattern, while the mirror stays about where it is."""

    def __init__(self, shifts_rad: tuple[float, float]) -> None:
        self.shifts_rad = shifts_rad
        self.count = 0
        self.variance_mm2 = np.zeros(
            surface.PARAMETERS
        )  # of the mean parameters, once the step is over
        self._parameters: list[FloatArray] = []  # of the first frame, then of all
        self._times_s: list[float] = []

    def add(self, seen_adu: Singles, fit: FrameFit, time_s: float) -> None:
        """Take a frame; the means begin anew where the mirror has left the first one's place."""
        parameters = fit.surface.parameters
        if (
            self.count
            and np.max(np.abs(surface.height_probe() @ (parameters - self._parameters[0])))
            > _STANDING_MM
        ):
            self.count = 0
        if not self.count:
            self._seen, self._light = np.zeros(seen_adu.size), np.zeros_like(fit.light)
            self._left, self._weights = np.zeros(seen_adu.size), np.zeros(seen_adu.size)
            self._parameters, self._times_s = [parameters], []
        self.count += 1
        self._seen += seen_adu
        self._light += fit.light
        self._left += fit.weights * fit.residual_adu
        self._weights += fit.weights
        self._parameters.append(parameters)
        self._times_s.append(time_s)

    @property
    def time_s(self) -> float:
        """Mean of the frames'."""
        return float(np.mean(self._times_s))

    def seen_adu(self) -> Singles:
        """Means over the bins (n,)."""
        return (self._seen / self.count).astype(np.float32)

    def fit(self, radius_mm: float) -> FrameFit:
        """The mean solution."""
        shape = surface.Surface.from_parameters(np.mean(self._parameters[1:], axis=0), radius_mm)
        left, weights = (
            (sums / self.count).astype(np.float32) for sums in (self._left, self._weights)
        )
        left /= np.maximum(weights, np.float32(1e-6))
        return FrameFit(shape, self._light / self.count, left, weights, True)


def steadied(
    places_mm: FloatArray, variance_mm2: FloatArray, drifted_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where the mirror was in each of N steps, (N, parameters) parameters and their variance, from
    the steps' own fits.

    Five unknowns of a bin reproduce five steps whatever is assumed of the mirror's motion between
    them: an error of a step's place becomes an error of all later frames with its shifts. Fits of
    the steps that scatter about the mirror's drift, `drifted_mm` (N, parameters), as their errors
    do say that it did nothing else; the rest is its motion, parameter by parameter.
    """
    error_mm2 = variance_mm2.mean(axis=0)
    steady_mm = places_mm.mean(axis=0) + drifted_mm - drifted_mm.mean(axis=0)
    moved_mm = places_mm - steady_mm
    scatter_mm2 = np.sum(moved_mm**2, axis=0) / (len(places_mm) - 1)
    share = np.maximum(scatter_mm2 - error_mm2, 0.0) / np.maximum(scatter_mm2, 1e-30)
    return steady_mm + share * moved_mm, np.maximum(share, _STILL) * variance_mm2


class Jumps:
    """By how much the figure jumps at steps of the pattern, beyond what it does from frame to
    frame.

    A panel on which pictures stick shows the former step beside the present one, which looks like a
    tilt.
    """

    def __init__(self) -> None:
        self._still: deque[FloatArray] = deque(maxlen=50)
        self._steps: deque[FloatArray] = deque(
            maxlen=5 * ENOUGH_STEPS
        )  # fewer scatter more than they tell
        self.begin()

    def begin(self) -> None:
        """What comes next is not compared with what was before."""
        self._path: deque[tuple[tuple[float, float], FloatArray]] = deque(maxlen=3)

    def add(self, shifts_rad: tuple[float, float], parameters: FloatArray) -> bool:
        """Take the next frame; True if it showed a jump's size."""
        self._path.append((shifts_rad, parameters))
        if len(self._path) < 3 or self._path[0][0] != self._path[1][0]:
            return False
        before, last, now = (place for _, place in self._path)
        stepped = shifts_rad != self._path[1][0]
        (self._steps if stepped else self._still).append((now - 2 * last + before) ** 2)
        return stepped

    def variance_mm2(self, place_mm2: FloatArray) -> FloatArray:
        """Of the parameters (parameters,), beyond that of the steps' places, which jump, too.

        Zeros where frames of one step scatter nearly as much.
        """
        if not self._steps or not self._still:
            return np.zeros(surface.PARAMETERS)
        steps_mm2, still_mm2 = (np.mean(squared, axis=0) for squared in (self._steps, self._still))
        return np.asarray(np.maximum(steps_mm2 - 2 * still_mm2 - 2 * place_mm2, 0.0))


@dataclass(frozen=True)
class Finding:
    """Why a frame is not what it should be."""

    verdict: shape_estimate.Verdict
    reason: str
    lost: bool = False


def light_faults(saturated: float, light: float, covered: BoolArray) -> list[Finding]:
    """What the picture's light says before any fit."""
    share = float(np.mean(covered))
    rejected, degraded = (
        shape_estimate.SATURATED_REJECTED_FRACTION,
        shape_estimate.SATURATED_DEGRADED_FRACTION,
    )
    checks = (
        (saturated > rejected, "rejected", f"saturated: {saturated:.0%} of the bins"),
        (light < _DARK, "rejected", f"dark: {light:.0%} of the reference's light"),
        (
            share > _COVERED_REJECTED,
            "rejected",
            f"covered: the light of {share:.0%} of the mirror is wrong",
        ),
        (saturated > degraded, "degraded", f"saturated: {saturated:.1%} of the bins"),
        (share > _COVERED_DEGRADED, "degraded", f"covered: {share:.0%} of the mirror is left out"),
    )
    return [Finding(verdict, reason) for wrong, verdict, reason in checks if wrong]  # type: ignore[arg-type]


def light_changes(light: float, last: float, anchor: float) -> list[Finding]:
    """What the light of a frame says of exposure and panel, beside that of the last and that at the
    anchor.
    """
    if abs(light / last - 1) > _EXPOSURE:
        return [
            Finding(
                "degraded", f"exposure changed: {light / last:.2f} of the light of the last frame"
            )
        ]
    if light < _DIMMED * anchor:
        return [Finding("degraded", f"the screen dimmed to {light / anchor:.0%} of its light")]
    return []


def fit_fault(fit: FrameFit, rest: float, out: float) -> Finding | None:
    """Whether a fit has failed: `rest` over the swing of the fringes is left, `out` of the bins
    have no weight.
    """
    if not fit.converged or rest > REST_REJECTED or out > _OUT_REJECTED:
        left = f"the fit leaves {rest:.0%} of the fringes, {out:.0%} of the bins do not fit"
        if fit.converged and rest <= REST_REJECTED:
            return Finding("rejected", f"covered or order lost: {left}", True)
        return Finding(
            "rejected",
            f"order lost: the mirror moved too far since the last good frame ({left})",
            True,
        )
    contrast = float(
        np.min(1 + fit.light[1:, 0]) / (1 + fit.light[0, 0])
    )  # of the first term, 1 everywhere
    if contrast < -_CONTRAST:
        return Finding("rejected", "order lost: the fringes moved by half a period", True)
    if contrast < _CONTRAST:
        return Finding("rejected", f"no fringes: {abs(contrast):.0%} of the reference's contrast")
    return None


class Squares:
    """The mirror in squares, for the light of a frame.

    Where the film's slopes spread the fringes, a square shows parts of one, and its light depends
    on the phase: by that much more it may differ.
    """

    def __init__(self, scene: CrossedScene) -> None:
        self._number = _squares(scene.position_mm, scene.surface.radius_mm, 12)
        self._count = np.bincount(self._number)
        self._whole = self._count > 0.5 * np.median(
            self._count
        )  # at the rim a part shows no whole fringe
        self._light_adu = scene.light_adu[0].astype(np.float32)
        waves = (scene.light_adu[1:] * np.exp(1j * scene.phase_rad(scene.surface))).astype(
            np.complex64
        )
        swing: Singles = np.sum(
            (scene.light_adu[1:] / self._light_adu) ** 2, axis=0, dtype=np.float32
        )
        means = self._means(self._light_adu, swing, *waves.real, *waves.imag)
        self._level, self._swing = means[0], np.sqrt(means[1] / 2)
        self._fringe = (
            np.hypot(means[2:4], means[4:]).sum(axis=0) / self._level
        )  # that does not average out
        self._even = self._whole & (
            self._fringe <= max(_UNEVEN, float(np.median(self._fringe[self._whole])))
        )

    def _means(self, *values: Singles) -> FloatArray:
        return np.asarray(sums_by(self._number, np.stack(values), self._count.size) / self._count)

    def look(self, seen: Singles) -> tuple[float, BoolArray]:
        """Light of a frame over the scene's, and the squares whose light is wrong."""
        share, contrast = self._shares(seen)
        light = float(np.median(share[self._even]))
        wrong = np.abs(share - light) > (_COVERED + self._fringe) * max(light, 1e-6)
        grey = self._even & (contrast < _GREY * float(np.median(contrast[self._even])))
        return light, self._whole & (wrong | grey)

    def blinded(self, seen: Singles, covered: float) -> Finding | None:
        """Why a frame has no fit, if it is not that the mirror moved; `covered` is a share of the
        squares.
        """
        contrast = float(np.median(self._shares(seen)[1][self._even]))
        if contrast < _CONTRAST:
            return Finding("rejected", f"no fringes: {contrast:.0%} of the reference's contrast")
        if covered > _COVERED_DEGRADED:
            left = f"without {covered:.0%} of the mirror there is no fit"
            return Finding("rejected", f"covered or order lost: {left}", lost=True)
        return None

    def _shares(self, seen: Singles) -> FloatArray:
        """Of the scene's light and contrast (2, squares)."""
        share = seen / self._light_adu
        level, mean, square = self._means(seen, share, share**2)
        scatter = np.sqrt(np.maximum(square - mean**2, 0.0))
        return np.stack([level / self._level, scatter / self._swing / np.maximum(mean, 1e-6)])

    def bins(self, chosen: BoolArray) -> BoolArray:
        """The bins (n,) of squares."""
        return np.asarray(chosen[self._number])


def _squares(position_mm: FloatArray, radius_mm: float, across: int) -> IntArray:
    """Number (n,) of the square of the mirror, so many across, that each bin is in; numbers without
    gaps.
    """
    column, row = np.floor((position_mm / radius_mm + 1) / 2 * across).astype(int)
    return np.unique(row * across + column, return_inverse=True)[1]


class LostOrders:
    """What a change of shape would be if whole periods were lost."""

    def __init__(self, fitter: FrameFitter) -> None:
        bowl = surface.Surface.hencky_bowl(1.0, fitter.scene.surface.radius_mm).parameters
        self._bowl = bowl / np.linalg.norm(bowl)
        x, y = fitter.period_um()
        pairs = [(m, n) for m in range(-8, 9) for n in range(-8, 9) if m or n]
        self._lost_um = np.array([m * x + n * y for m, n in pairs])

    def require_telling(self) -> None:
        """Raise ValueError if even a mirror that stood still might have lost an order since the
        reference.
        """
        if self.sure(np.zeros(surface.PARAMETERS), math.inf):
            return
        tilt_um, odd_um = (
            np.hypot(self._lost_um[:, 0], self._lost_um[:, 1]),
            self.odd_um(self._lost_um),
        )
        least = int(np.argmin(odd_um**2 + (tilt_um / 150.0) ** 2))
        raise ValueError(
            f"a lost period looks like a tilt of {tilt_um[least]:.0f} µm RMS with "
            f"{odd_um[least]:.1f} µm of "
            "other terms, as if the mirror had moved: use a longer period"
        )

    def odd_um(self, change_um: FloatArray) -> FloatArray:
        """RMS of a change (..., parameters) without its tilt and without its bowl."""
        rest = np.array(change_um)
        rest[..., :2] = 0.0
        rest -= (rest @ self._bowl)[..., None] * self._bowl
        return np.asarray(np.linalg.norm(rest, axis=-1))

    def doubt(
        self, change_um: FloatArray, passed_s: float, displacement_um: float
    ) -> Finding | None:
        """Whether a change (parameters,) is none of this mirror's; `displacement_um` is that of the
        laser, NaN without."""
        if not self.sure(change_um, passed_s):
            tilt_um, odd_um = np.hypot(*change_um[:2]), self.odd_um(change_um)
            return Finding(
                "rejected",
                "order lost: the mirror moved by a period or more since the last good frame, "
                "or changed its shape "
                f"(tilt {tilt_um:.0f} µm RMS, other terms {odd_um:.1f})",
                lost=True,
            )
        sag_um = float(surface.sag_gradient() @ change_um)
        if abs(sag_um - displacement_um) > _LASER_UM:
            return Finding(
                "rejected", f"the sag changed by {sag_um:.0f} µm, which the laser did not see", True
            )
        return None

    def sure(self, change_um: FloatArray, passed_s: float) -> bool:
        """Whether a change is that of a film, and would not be with any orders lost."""
        usual_um = min(0.5 + 0.05 * passed_s, 1.0)

        def strange(change: FloatArray) -> FloatArray:
            tilt_um = np.hypot(change[..., 0], change[..., 1])
            return np.asarray((self.odd_um(change) / usual_um) ** 2 + (tilt_um / 150.0) ** 2)

        own = float(strange(change_um))
        return own < 16.0 and bool(np.all(strange(change_um + self._lost_um) > own + 16.0))
