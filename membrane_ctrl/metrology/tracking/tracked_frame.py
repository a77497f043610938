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
    # standard deviations of sag and terms without motions of the bench that frames do not show:
    # those of changes from frame to frame
    steady_sag_sigma_um: float = math.nan
    steady_sigma_um: FloatArray = field(default_factory=_NONE.copy)

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
