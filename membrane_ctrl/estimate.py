"""The small result of a measurement cycle: what crosses from acquisition to control and recorder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Verdict = Literal["ok", "degraded", "rejected"]


@dataclass(frozen=True, slots=True)
class ShapeEstimate:
    """Figure of the mirror from one cycle.

    Attributes
    ----------
    time_s : float
        Middle of the exposures on the run's clock.
    kind : str
        "full" (Gray codes taken) or "fringes" (fringe orders carried over from the last absolute phase).
    coeffs_um : (36,) array
        Noll j = 1..36, orthonormal over `mirror.radius_mm`, of the height measured from the vertex;
        piston makes the surface 0 at the vertex.
    hencky_um : float
        Amplitude of the part of a Hencky bowl that the 36 terms cannot carry, as the sag of that bowl.
    covariance_um2 : (36, 36) array
        Of `coeffs_um`, from pixel noise and the residual of the fit.
    sag_um : float
        Height at `mirror.radius_mm`, mean over azimuth, above the vertex.
    sag_sigma_um : float
        Its standard deviation from `covariance_um2`.
    geometry_sag_sigma_um : float
        Its standard deviation from how well the geometry is known, which all cycles have in common; NaN if that is
        not stated.
    displacement_um : float
        Mean laser reading during the exposures (NaN without a laser).
    slope_residual_urad : float
        RMS of measured minus fitted slopes.
    valid_fraction : float
        Share of the analysis area that gave a slope.
    modulation_median_adu, saturated_fraction : float
        Fringe quality.
    verdict, reason : str
        "ok", "degraded" or "rejected", and why.
    latency_s : float
        Last frame to this result (filled by the acquisition).
    cycle : int
        Number of the cycle in the run (filled by the acquisition).
    """

    time_s: float
    kind: Literal["full", "fringes"]
    coeffs_um: NDArray[np.float64]
    hencky_um: float
    covariance_um2: NDArray[np.float64]
    sag_um: float
    sag_sigma_um: float
    displacement_um: float
    slope_residual_urad: float
    valid_fraction: float
    modulation_median_adu: float
    saturated_fraction: float
    verdict: Verdict
    reason: str = ""
    latency_s: float = float("nan")
    cycle: int = 0
    geometry_sag_sigma_um: float = float("nan")
