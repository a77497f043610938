"""Change of sag from the change of a Zernike vector.

A change of sag moves the coefficients along a known direction s (the sensitivity, um per um). With the change
dc = c - c_ref and its covariance C the best linear unbiased estimate and its variance are (Gauss-Markov)

    d = (s' W dc) / (s' W s),    var d = 1 / (s' W s),    W = (C + f^2 I)^-1

C is what pixel noise makes: nanometres, and nearly singular where terms are hard to tell apart. Taken alone it would
put all weight on a few terms whose *model* error (the film's motion between frames, geometry, gamma) is far larger.
f stands for that: it is the same for every term, and bounds the condition of W.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Standard deviation of a coefficient's model error (assumed; a bench shows it as the scatter of the estimates):
# 0.05 um RMS over the disc is 0.17 um of sag, which is what a cycle gives.
MODEL_FLOOR_UM = 0.05

MEASURED = slice(1, None)  # all but piston, which is set by the surface being 0 at the vertex


@dataclass(frozen=True, slots=True)
class SagChange:
    """Change of sag in um, positive when the bowl deepens, and its standard deviation."""

    change_um: float
    sigma_um: float


def sag_change(
    coeffs_um: NDArray[np.float64],
    reference_um: NDArray[np.float64],
    covariance_um2: NDArray[np.float64],
    sensitivity: NDArray[np.float64],
) -> SagChange:
    """Sag now minus sag at the reference.

    Parameters
    ----------
    coeffs_um, reference_um : (36,) array
    covariance_um2 : (36, 36) array
        Of `coeffs_um`; the reference's is constant, hence no noise of the change.
    sensitivity : (36,) array
        Coefficients' change per um of sag.
    """
    s = sensitivity[MEASURED]
    covariance = covariance_um2[MEASURED, MEASURED] + MODEL_FLOOR_UM**2 * np.eye(s.size)
    weighted = np.linalg.solve(covariance, s)
    information = float(weighted @ s)
    change_um = float(weighted @ (coeffs_um - reference_um)[MEASURED]) / information
    return SagChange(change_um, information**-0.5)
