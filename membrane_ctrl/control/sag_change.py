"""Change of sag from the change of a Zernike vector. Pure.

A change of sag moves the coefficients along a known direction s (the sensitivity, µm per µm).
With the change dc = c - c_ref and its covariance C the best linear unbiased estimate and its
variance are (Gauss-Markov)

    d = (s' W dc) / (s' W s),    var d = 1 / (s' W s),    W = (C + f^2 I)^-1

C comes from pixel noise: nanometres, and nearly singular where terms are hard to separate. Alone
it would put all weight on a few terms whose *model* error (the film's motion between frames,
geometry, gamma) is far larger. f stands for that: it is the same for every term, and bounds the
condition of W.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.state_tree import StateNode

# Standard deviation of a coefficient's model error (assumed; a bench shows it as the scatter of the
# estimates): 0.05 µm RMS over the disc is 0.17 µm of sag, which is what a cycle gives.
MODEL_FLOOR_UM = 0.05
MEASURED = slice(1, None)  # all but piston, which is set by the surface being 0 at the vertex


@dataclass(frozen=True, slots=True)
class SagChange(StateNode):
    """Change of sag in µm, positive when the bowl deepens, and its standard deviation; NaN without
    one.
    """

    change_um: float = math.nan
    sigma_um: float = math.nan


def compute_weighted_change(
    coeffs_um: FloatArray,
    reference_um: FloatArray,
    covariance_um2: FloatArray,
    weights: FloatArray,
) -> SagChange:
    """Return the change of one scalar of the figure, and its standard deviation.

    Parameters
    ----------
    coeffs_um, reference_um, covariance_um2
        As in `compute_sag_change`.
    weights : (terms,) array
        Of the terms, in µm of sag per µm; that of piston is 0.
    """
    change_um = float(weights @ (coeffs_um - reference_um))
    variance_um2 = float(weights @ covariance_um2 @ weights)
    return SagChange(change_um, math.sqrt(max(0.0, variance_um2)))


def compute_sag_change(
    coeffs_um: FloatArray,
    reference_um: FloatArray,
    covariance_um2: FloatArray,
    sensitivity: FloatArray,
) -> SagChange:
    """Return the sag now minus the sag at the reference.

    Parameters
    ----------
    coeffs_um : (terms,) array
        Zernike coefficients now, in µm.
    reference_um : (terms,) array
        Those at the reference; it is constant, so it adds no noise to a change.
    covariance_um2 : (terms, terms) array
        Covariance of the coefficients now.
    sensitivity : (terms,) array
        Change of the coefficients in µm per µm of sag.

    Returns
    -------
    SagChange
        By the equations of the module.
    """
    s = sensitivity[MEASURED]
    covariance = covariance_um2[MEASURED, MEASURED] + MODEL_FLOOR_UM**2 * np.eye(s.size)
    weighted = np.linalg.solve(covariance, s)
    information = float(weighted @ s)
    change_um = float(weighted @ (coeffs_um - reference_um)[MEASURED]) / information
    return SagChange(change_um, information**-0.5)
