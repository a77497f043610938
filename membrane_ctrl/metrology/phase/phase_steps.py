"""Wrapped phase and modulation from N phase steps, equal or not (the paper's eq. 1 for N = 4).

Each frame is I_k = A + B cos(phi + d_k) = A + C cos d_k - S sin d_k with C = B cos phi and S = B
sin phi: linear in (A, C, S). Where the light of the frames is known to differ, frame k is l_k A +
b_k B cos(phi + d_k), with its level l_k and its swing b_k about 1. Least squares over the frames
is one fixed 3 x N matrix for all pixels. For equal steps it is C = 2/N sum I cos d, S = -2/N sum I
sin d, and for N = 4 S : C = (I4 - I2) : (I1 - I3), the paper's formula.

The phasor C + iS is linear in the intensities: sums over pixels may be taken before the
arctangent, which weighs each pixel by its modulation and never meets a phase jump.
"""

import math
from collections.abc import Sequence

import numpy as np

from membrane_ctrl.model.arrays import ArrayLike, ComplexArray, FloatArray

_LARGEST_CONDITION = 100  # a larger one multiplies the noise of the phase a hundredfold


def step_design(
    shifts_rad: Sequence[float] | FloatArray, light: FloatArray | None = None
) -> FloatArray:
    """Matrix from A, C and S of a pixel to its intensities: rows [l, b cos d, -b sin d].

    Parameters
    ----------
    shifts_rad : (N,) array
        Phase steps d.
    light : (2, N) array, optional
        Level l and swing b of each frame; 1 by default.

    Returns
    -------
    (N, 3) array
    """
    shifts = np.asarray(shifts_rad, float)
    if light is None:
        light = np.ones((2, shifts.size))
    level, swing = light
    by_cosine = swing * np.cos(shifts)
    by_sine = -swing * np.sin(shifts)
    return np.stack([level, by_cosine, by_sine], axis=1)


def step_weights(
    shifts_rad: Sequence[float] | FloatArray, light: FloatArray | None = None
) -> FloatArray:
    """Matrix from the N intensities of a pixel to A, C and S: pseudo-inverse of `step_design`.

    Parameters
    ----------
    shifts_rad : (N,) array
        Phase steps, in any order and spacing.
    light : (2, N) array, optional
        As in `step_design`.

    Returns
    -------
    (3, N) array

    Raises
    ------
    ValueError
        The steps do not determine a phase: fewer than three are different on the circle.
    """
    design = step_design(shifts_rad, light)
    if len(design) < 3 or np.linalg.cond(design) > _LARGEST_CONDITION:
        raise ValueError(
            f"phase steps {np.round(shifts_rad, 3).tolist()} rad do not determine a phase"
        )
    return np.asarray(np.linalg.pinv(design), np.float64)


def equal_shifts(steps: int) -> FloatArray:
    """The N equal steps 2 pi k / N."""
    return 2 * math.pi * np.arange(steps) / steps


def compute_phasors(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> ComplexArray:
    """Phasor C + iS of each pixel: its angle is the phase (eq. 1), its length the amplitude B.

    Parameters
    ----------
    frames : (N, ...) array
        Intensities.
    shifts_rad : (N,) array
        Phase steps.

    Returns
    -------
    (...) complex array
        In single precision if the frames are.

    Raises
    ------
    ValueError
        As `step_weights`.
    """
    stack = np.asarray(frames)
    if stack.dtype != np.float32:
        stack = stack.astype(float)
    # C and S of all pixels by one matrix product; the level A is not needed.
    weights = step_weights(shifts_rad)[1:].astype(stack.dtype)
    parts = weights @ stack.reshape(len(stack), -1)
    complex_type = np.result_type(stack, np.complex64)
    out = np.empty(stack.shape[1:], complex_type)
    out.real = parts[0].reshape(out.shape)
    out.imag = parts[1].reshape(out.shape)
    return out


def step_residual(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> FloatArray:
    """What the model A + B cos(phi + d_k) leaves of each frame: noise, if all is well.

    The projector 1 - D W removes all that the three columns of the design D explain.

    Parameters
    ----------
    frames, shifts_rad
        As in `compute_phasors`, whose errors are also raised.

    Returns
    -------
    (N, ...) array
    """
    stack = np.asarray(frames, float)
    fitted = step_design(shifts_rad) @ step_weights(shifts_rad)
    projector = np.eye(len(stack)) - fitted
    return np.asarray(np.tensordot(projector, stack, axes=1))


def phase_sigma_rad(
    shifts_rad: Sequence[float] | FloatArray, noise_adu: float, modulation_adu: float
) -> float:
    """Standard deviation of the phase for white noise in the frames; mean over the phase.

    The phasor's components have the variances sigma^2 sum w^2; across the phasor, averaged over its
    direction, half their sum is left. For N equal steps: sigma sqrt(2 / N) / B
    (docs/explanation/metrology.md, section 1).

    Parameters
    ----------
    shifts_rad : (N,) array
        Phase steps.
    noise_adu : float
        Standard deviation sigma of a pixel (or of a bin's mean) in one frame.
    modulation_adu : float
        Amplitude B of the fringes.

    Returns
    -------
    float
        In rad.
    """
    _, cosine, sine = step_weights(shifts_rad)
    variance_across = float(cosine @ cosine + sine @ sine) / 2  # of the phasor, for noise of 1
    return noise_adu * math.sqrt(variance_across) / modulation_adu
