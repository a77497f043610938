"""The figure of one tracked frame."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.model import shape_estimate, zernike_terms
from membrane_ctrl.model.arrays import FloatArray

_NONE = np.full(zernike_terms.ZERNIKE_TERMS, math.nan)
_NO_COVARIANCE = np.full((_NONE.size, _NONE.size), math.nan)


@dataclass(frozen=True)
class TrackedFrame:
    """Figure of one frame; NaN where it is rejected.

    Attributes
    ----------
    time_s : float
        Middle of the exposure.
    coeffs_um : (terms,) array
        Zernike terms in Noll's order; the vertex is at 0.
    covariance_um2 : (terms, terms) array
        Covariance of their error against the reference's figure.
    hencky_um : float
        Amplitude of the Hencky excess, as sag.
    sag_um : float
        Height of the rim above the vertex.
    sag_sigma_um : float
        Its standard deviation against the reference's figure.
    verdict : Verdict
    reason : str
        Why it is not `ok`.
    rest_share : float
        What the fit leaves, over the swing of the fringes.
    used_share : float
        Share of the bins with weight.
    swing_adu : float
        Swing of the fringes, median over the bins.
    saturated_share : float
        Share of the bins with a saturated pixel.
    lost : bool
        The mirror may be elsewhere than in the last good frame: a new reference is needed.
    sag_change_sigma_um : float
        Standard deviation of the sag without motions of the bench that frames do not show: that of
        changes from frame to frame.
    change_sigma_um : (terms,) array
        The same of the terms.
    """

    time_s: float
    coeffs_um: FloatArray
    covariance_um2: FloatArray
    hencky_um: float
    sag_um: float
    sag_sigma_um: float
    verdict: shape_estimate.Verdict
    reason: str
    rest_share: float
    used_share: float = 0.0
    swing_adu: float = math.nan
    saturated_share: float = 0.0
    lost: bool = False
    sag_change_sigma_um: float = math.nan
    change_sigma_um: FloatArray = field(default_factory=_NONE.copy)

    @property
    def sigma_um(self) -> FloatArray:
        """Standard deviations (terms,) of the terms against the reference's figure."""
        return np.sqrt(np.diag(self.covariance_um2))


def moved_frame(frame: TrackedFrame, by_mm: FloatArray, radius_mm: float) -> TrackedFrame:
    """Return the frame with another surface; its error bars stay.

    Parameters
    ----------
    frame : TrackedFrame
    by_mm : (parameters,) array
        Change of the surface's parameters.
    radius_mm : float
        Radius of the Zernike disc.
    """
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
    """Return a frame without a figure.

    Parameters
    ----------
    time_s : float
        Middle of the exposure.
    reason : str
        Why, for people.
    rest : float
        What the fit left, over the swing of the fringes; NaN without a fit.
    lost : bool
        Whether a new reference is needed.
    """
    nan = math.nan
    return TrackedFrame(
        time_s, _NONE, _NO_COVARIANCE, nan, nan, nan, "rejected", reason, rest, lost=lost
    )
