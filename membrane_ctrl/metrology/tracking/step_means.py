"""Means of the frames of one step of the pattern, and the mirror's places at five steps."""

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, Shifts
from membrane_ctrl.model.arrays import FloatArray, Singles

# Motion at the rim within which the mean of frames is the frame of the mean, to a nanometre.
_STANDING_MM = 3e-3
# Share of the errors of the steps' fits that remains where these fits show no motion.
_STILL = 0.2
_LEAST_WEIGHT = np.float32(1e-6)  # instead of a division by zero


class StepMeans:
    """Means of the frames of one step of the pattern, while the mirror hardly moves.

    Attributes
    ----------
    shifts_rad : (float, float)
        Phase steps of x and y.
    count : int
        Frames in the means.
    variance_mm2 : (parameters,) array
        Variance of the mean parameters, once the step is over.
    """

    def __init__(self, shifts_rad: Shifts) -> None:
        self.shifts_rad = shifts_rad
        self.count = 0
        self.variance_mm2 = np.zeros(surface.PARAMETERS)
        self._first_mm = np.zeros(surface.PARAMETERS)  # parameters of the first frame
        self._parameters_mm: list[FloatArray] = []
        self._times_s: list[float] = []

    def add_frame(self, seen_adu: Singles, fit: FrameFit, time_s: float) -> None:
        """Add a frame; the means begin again if the mirror has moved since the first one.

        Parameters
        ----------
        seen_adu : (n,) array
            Light of the bins.
        fit : FrameFit
            The frame's solution.
        time_s : float
            Middle of the exposure.
        """
        parameters_mm = fit.surface.parameters
        if self.count:
            moved_mm = surface.height_probe() @ (parameters_mm - self._first_mm)
            if np.max(np.abs(moved_mm)) > _STANDING_MM:
                self.count = 0
        if not self.count:
            self._begin(seen_adu, fit)
        self.count += 1
        self._seen_adu += seen_adu
        self._light += fit.light
        self._residual_adu += fit.weights * fit.residual_adu
        self._weights += fit.weights
        self._parameters_mm.append(parameters_mm)
        self._times_s.append(time_s)

    def _begin(self, seen_adu: Singles, fit: FrameFit) -> None:
        """Start with empty sums from the place of a frame."""
        self._first_mm = fit.surface.parameters
        self._seen_adu = np.zeros(seen_adu.size)
        self._light = np.zeros_like(fit.light)
        self._residual_adu = np.zeros(seen_adu.size)
        self._weights = np.zeros(seen_adu.size)
        self._parameters_mm = []
        self._times_s = []

    @property
    def time_s(self) -> float:
        """Mean time of the frames."""
        return float(np.mean(self._times_s))

    def seen_adu(self) -> Singles:
        """Mean light (n,) of the bins."""
        return (self._seen_adu / self.count).astype(np.float32)

    def fit(self, radius_mm: float) -> FrameFit:
        """The mean solution."""
        mean_mm = np.mean(self._parameters_mm, axis=0)
        shape = surface.Surface.from_parameters(mean_mm, radius_mm)
        weights = (self._weights / self.count).astype(np.float32)
        residual_adu = (self._residual_adu / self.count).astype(np.float32)
        residual_adu /= np.maximum(weights, _LEAST_WEIGHT)
        return FrameFit(shape, self._light / self.count, residual_adu, weights, True)


def estimate_step_places(
    places_mm: FloatArray, variance_mm2: FloatArray, drifted_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Estimate where the mirror was in each of N steps, from the steps' own fits.

    The five unknowns of a bin reproduce five steps whatever motion of the mirror is assumed between
    them: an error of a step's place becomes an error of all later frames with its shifts. If the
    fits of the steps scatter about the mirror's drift as much as their errors do, the mirror did
    nothing but drift; scatter beyond that is its motion, parameter by parameter.

    Parameters
    ----------
    places_mm : (N, parameters) array
        Parameters of the steps' fits.
    variance_mm2 : (N, parameters) array
        Their variances.
    drifted_mm : (N, parameters) array
        The mirror's drift until each step.

    Returns
    -------
    places_mm, variance_mm2 : (N, parameters) arrays
        Estimated parameters and their variances.
    """
    error_mm2 = variance_mm2.mean(axis=0)
    steady_mm = places_mm.mean(axis=0) + drifted_mm - drifted_mm.mean(axis=0)
    moved_mm = places_mm - steady_mm
    scatter_mm2 = np.sum(moved_mm**2, axis=0) / (len(places_mm) - 1)
    share = np.maximum(scatter_mm2 - error_mm2, 0.0) / np.maximum(scatter_mm2, 1e-30)
    return steady_mm + share * moved_mm, np.maximum(share, _STILL) * variance_mm2
