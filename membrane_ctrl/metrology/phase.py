"""Wrapped phase and modulation from N phase steps, equal or not (the paper's eq. 1 for N = 4).

Each frame is I_k = A + B cos(phi + d_k) = A + C cos d_k - S sin d_k with C = B cos phi and S = B sin phi: linear
in (A, C, S). Least squares over the frames is one fixed 3 x N matrix for all pixels. For equal steps it is
C = 2/N sum I cos d, S = -2/N sum I sin d, and for N = 4 S : C = (I4 - I2) : (I1 - I3), the paper's formula.

The phasor C + iS is linear in the intensities: sums over pixels may be taken before the arctangent, which weighs
each pixel by its modulation and never meets a phase jump.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def step_weights(shifts_rad: Sequence[float] | FloatArray) -> FloatArray:
    """Rows that turn the N intensities of a pixel into A, C and S.

    Parameters
    ----------
    shifts_rad : (N,) array
        Phase step of each frame, N >= 3, in any order and spacing.

    Returns
    -------
    (3, N) array
        Pseudo-inverse of the columns [1, cos d, -sin d].

    Raises
    ------
    ValueError
        If the steps do not determine a phase (fewer than three different ones on the circle).
    """
    shifts = np.asarray(shifts_rad, float)
    design = np.stack([np.ones_like(shifts), np.cos(shifts), -np.sin(shifts)], axis=1)
    # a condition number beyond this multiplies the noise of the phase a hundredfold
    if len(shifts) < 3 or np.linalg.cond(design) > 100:
        raise ValueError(f"phase steps {np.round(shifts, 3).tolist()} rad do not determine a phase")
    return np.linalg.pinv(design)


def equal_shifts(steps: int) -> FloatArray:
    """The N equal steps 2 pi k / N."""
    return 2 * math.pi * np.arange(steps) / steps


def phasors(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> NDArray[np.complex128]:
    """Phasor C + iS per pixel from a stack of frames (N, ...)."""
    stack = np.asarray(frames, float)
    _, cosine, sine = step_weights(shifts_rad)
    out = np.empty(stack.shape[1:], np.complex128)
    out.real = np.einsum("k,k...->...", cosine, stack)
    out.imag = np.einsum("k,k...->...", sine, stack)
    return out


def wrapped_phase(phasor: NDArray[np.complex128]) -> FloatArray:
    """Phase in (-pi, pi] of C + iS."""
    return np.angle(phasor)


def modulation(phasor: NDArray[np.complex128]) -> FloatArray:
    """Fringe amplitude B in the units of the frames."""
    return np.abs(phasor)


def step_residual(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> FloatArray:
    """What the model A + B cos(phi + d_k) leaves of each frame, (N, ...): zero but for noise if all is well."""
    stack = np.asarray(frames, float)
    shifts = np.asarray(shifts_rad, float)
    design = np.stack([np.ones_like(shifts), np.cos(shifts), -np.sin(shifts)], axis=1)
    projector = np.eye(len(shifts)) - design @ step_weights(shifts)
    return np.asarray(np.tensordot(projector, stack, axes=1))


def phase_sigma_rad(shifts_rad: Sequence[float] | FloatArray, noise_adu: float, modulation_adu: float) -> float:
    """Standard deviation of the phase for white noise in the frames; mean over the phase.

    The phasor's components have the variances sigma^2 sum w^2; across the phasor, averaged over its direction, half
    their sum is left. For N equal steps: sigma sqrt(2 / N) / B.
    """
    _, cosine, sine = step_weights(shifts_rad)
    return noise_adu * math.sqrt(float(cosine @ cosine + sine @ sine) / 2) / modulation_adu
