"""Means of the frames of one step of the pattern, and the mirror's places at five steps."""

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit
from membrane_ctrl.model.arrays import FloatArray, Singles

_STANDING_MM = 3e-3  # within it, the mean of frames is the frame of the mean: to a nanometre
# share of the errors of the steps' fits that stays where these say nothing of a motion
_STILL = 0.2


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


def estimate_step_places(
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
