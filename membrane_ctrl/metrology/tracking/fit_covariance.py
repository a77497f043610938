"""Covariance of the parameters that tracked frames are fitted with, estimated now and then."""

import math

import numpy as np

from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter, Shifts
from membrane_ctrl.model.arrays import FloatArray

# Errors change slowly, and one estimate costs as much as eight fits.
_ESTIMATE_EVERY_S = 2.5
_NEW_SHARE = 0.3  # weight of a new estimate in the mean with the former ones
# Change of the share of bins with weight with which the errors change, too.
OTHER_BINS_SHARE = 0.03


class FitCovariance:
    """The covariance of the fits, a running mean of estimates.

    An estimate that becomes due is made between two frames (`estimate_if_due`), so that no figure
    waits for it. Only if the used bins change, or nothing is known, it is made at once.

    Parameters
    ----------
    noise_adu : float
        Noise of a bin.
    """

    def __init__(self, noise_adu: float) -> None:
        self._noise_adu = noise_adu
        self._mean_mm2 = np.full((PARAMETERS, PARAMETERS), math.nan)
        self._requested_s = -math.inf
        self._used_share = math.nan  # of the bins, when the mean began
        self._due: tuple[FrameFit, Shifts] | None = None

    def drop_request(self) -> None:
        """Forget the estimate that is due: its fit belongs to another scene."""
        self._due = None

    def estimate_if_due(self, fitter: FrameFitter) -> None:
        """Make the estimate that is due, if any."""
        if self._due is not None:
            fit, shifts_rad = self._due
            self._estimate(fitter, fit, shifts_rad)

    def estimate_frame_covariance(
        self, fitter: FrameFitter, fit: FrameFit, shifts_rad: Shifts, time_s: float, renew: bool
    ) -> FloatArray:
        """Covariance (parameters, parameters) of a frame's fit, on a bench that has not moved.

        Parameters
        ----------
        fitter : FrameFitter
            Which made the fit.
        fit : FrameFit
            The frame's solution.
        shifts_rad : (float, float)
            Its phase steps.
        time_s : float
            Its time.
        renew : bool
            Whether a new estimate is due in any case.
        """
        if renew or time_s >= self._requested_s + _ESTIMATE_EVERY_S:
            self._requested_s = time_s
            self._due = (fit, shifts_rad)

        used_share = float(np.mean(fit.weights > 0))
        same_bins = abs(used_share - self._used_share) < OTHER_BINS_SHARE
        if not same_bins or np.isnan(self._mean_mm2).any():
            self._mean_mm2 = np.full_like(self._mean_mm2, math.nan)
            self._used_share = used_share
            self._estimate(fitter, fit, shifts_rad)
        return self._mean_mm2

    def _estimate(self, fitter: FrameFitter, fit: FrameFit, shifts_rad: Shifts) -> None:
        """Estimate the covariance of a fit, and add it to the mean."""
        self._due = None
        found_mm2 = fitter.covariance_mm2(fit, shifts_rad, self._noise_adu)
        if np.isfinite(self._mean_mm2).all():
            self._mean_mm2 = (1 - _NEW_SHARE) * self._mean_mm2 + _NEW_SHARE * found_mm2
        else:
            self._mean_mm2 = found_mm2
