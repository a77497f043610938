"""The fit of a frame without its outliers: the fit is repeated with a reach that shrinks to the
scale of what it leaves.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.tracking.frame_fit import FrameFit, FrameFitter, Shifts
from membrane_ctrl.metrology.tracking.frame_verdict import REST_REJECTED
from membrane_ctrl.model.arrays import BoolArray, Singles

_REACH_SIGMAS = 7.0  # residual at which a bin has no weight
_FIRST_REACH_ADU = 1e6  # every bin counts
_REPEATS = 4  # fits with one starting scale
# The scale of what a fit leaves agrees with that of its reach within these factors.
_SMALLEST_RATIO = 0.67
_LARGEST_RATIO = 1.5
_USUAL_OUTLIERS = 0.01  # share of bins that dust and glints cover


@dataclass(frozen=True)
class RobustFitter:
    """Fits frames of one scene without outliers.

    Attributes
    ----------
    fitter : FrameFitter
        The fit with given reach.
    noise_adu : float
        Noise of a bin.
    swing_adu : float
        Swing of the scene's fringes, median over the bins.
    """

    fitter: FrameFitter
    noise_adu: float
    swing_adu: float

    def scale_adu(self, fit: FrameFit) -> float:
        """Robust sigma of the residual, but not less than the noise: rounding may leave zeros."""
        return max(fit.scale_adu, self.noise_adu)

    def has_failed(self, fit: FrameFit) -> bool:
        """Whether the fit did not converge, or leaves too much of the fringes."""
        return not fit.converged or self.scale_adu(fit) > REST_REJECTED * self.swing_adu

    def fit(
        self,
        seen_adu: Singles,
        shifts_rad: Shifts,
        start: FrameFit,
        left_out: BoolArray,
        last_scale_adu: float,
    ) -> FrameFit:
        """Fit a frame without outliers.

        The first attempt uses the scale of the last frame. If it fails, or excludes more bins than
        dust does, the second one begins with all bins: a film that moved needs them.

        Parameters
        ----------
        seen_adu : (n,) array
            Means of the frame over the bins.
        shifts_rad : (float, float)
            Phase steps of x and y.
        start : FrameFit
            Where the fit begins.
        left_out : (n,) bool array
            Bins without weight: clipped or covered.
        last_scale_adu : float
            Robust sigma that the last frame's fit left; 0 without one.

        Returns
        -------
        FrameFit
        """
        # Changes of the light are in proportion to it: bright fringes in a bright patch are no
        # outliers.
        brightness = np.maximum(seen_adu / self.fitter.light_adu[0], np.float32(1)) * ~left_out
        fit = start
        for first_scale_adu in filter(None, (last_scale_adu, _FIRST_REACH_ADU)):
            # Fits until the scale that decided the weights is the one that the fit leaves.
            fit = start
            scale_adu = first_scale_adu
            for _ in range(_REPEATS):
                reach_adu = np.float32(_REACH_SIGMAS * scale_adu) * brightness
                fit = self.fitter.fit(seen_adu, shifts_rad, fit, reach_adu)
                found_adu = self.scale_adu(fit)
                agrees = _SMALLEST_RATIO * scale_adu < found_adu < _LARGEST_RATIO * scale_adu
                if agrees or self.has_failed(fit):
                    break
                scale_adu = found_adu
            outliers = np.mean(fit.weights[~left_out] == 0)
            if fit.converged and outliers < _USUAL_OUTLIERS:
                break
        return fit
