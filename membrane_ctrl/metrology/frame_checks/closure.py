"""Do the frames of a series of phase steps agree, and if not, which one is wrong?

Least squares leave of each pixel's N intensities the residual r = P I, with P the projector off
the model's columns. Leaving out frame k needs no second fit: the sum of squares falls by exactly
r_k^2 / P_kk. The frame whose omission makes the rest agree is the wrong one.

With nothing known of a pixel the model has three parameters (mean, cosine, sine). For N = 4 one
degree of freedom is left, I_0 - I_1 + I_2 - I_3: it shows that a frame is wrong, and blames all
four equally. Other knowledge decides:

- the phase, from other frequencies, the other sets or the surface: two parameters are left (mean,
  amplitude);
- mean and amplitude, from the other axis or frequency, or from white and black: with the mean
  alone, two frames half a period apart would share the blame; the length of the phasor separates
  them.

Both work for any N >= 4; from N = 5 on nothing else needs to be known.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase.phase_steps import step_design, step_residual, step_weights
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

# Instead of a division by zero; also the least share P_kk of a frame that the model does not
# explain: below it, the model explains any frame.
_TINY = 1e-9


@dataclass(frozen=True)
class Closure:
    """How well N frames agree.

    Attributes
    ----------
    rms_adu : float
        The residual per degree of freedom: the noise, if no frame is wrong.
    frame_rms_adu : (N,) array
        The residual of each frame, over all pixels.
    without_rms_adu : (N,) array
        The residual per degree of freedom without that frame; NaN where no degree of freedom would
        be left.
    """

    rms_adu: float
    frame_rms_adu: FloatArray
    without_rms_adu: FloatArray

    @property
    def suspect_frame(self) -> int | None:
        """The frame that explains the disagreement best when left out; None if the data cannot
        decide.
        """
        if np.isnan(self.without_rms_adu).any():
            return None
        return int(np.argmin(self.without_rms_adu))

    @property
    def residual_ratio(self) -> float:
        """Residual of all frames over that without the suspect: about 1 if no frame is wrong."""
        if self.suspect_frame is None:
            return 1.0
        without_suspect_adu = float(self.without_rms_adu.min())
        return self.rms_adu / max(without_suspect_adu, _TINY)


def compute_closure(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> Closure:
    """Agreement of the frames with a sinusoid of unknown mean, amplitude and phase in each pixel.

    Parameters
    ----------
    frames : (N, ...) array
        Intensities, N >= 4; the caller leaves out or masks pixels without fringes.
    shifts_rad : (N,) array
        Phase steps.

    Returns
    -------
    Closure
        Names a suspect from N = 5 on.

    Raises
    ------
    ValueError
        Fewer than four frames, no pixels, or steps that determine no phase.
    """
    stack, shifts = _check_frames(frames, shifts_rad)
    residual = step_residual(stack, shifts)

    # Diagonal of the projector P = 1 - D D^+: the share of a frame's error that its residual shows.
    explained = np.einsum("kp,pk->k", step_design(shifts), step_weights(shifts))
    free = 1 - explained
    free_of_pixels = np.broadcast_to(free[:, None], residual.shape)
    return _summarise_residual(residual, free_of_pixels, len(shifts) - 3)


def closure_with_phase(
    frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray, phase_rad: FloatArray
) -> Closure:
    """Agreement with a sinusoid of known phase and unknown mean and amplitude.

    An error of the phase shows in all frames, as amplitude times error: it hides faults below that.

    Parameters
    ----------
    frames, shifts_rad
        As those of `compute_closure`.
    phase_rad : (...) array
        Known phase of each pixel.

    Returns
    -------
    Closure
        Names a suspect from N = 4 on.

    Raises
    ------
    ValueError
        As `compute_closure`.
    """
    stack, shifts = _check_frames(frames, shifts_rad)
    # The model's columns made orthonormal: a constant, and the carrier without its mean.
    carrier = np.cos(np.ravel(phase_rad) + shifts[:, None])
    carrier -= carrier.mean(axis=0)
    carrier /= np.maximum(np.linalg.norm(carrier, axis=0), _TINY)
    centred = stack - stack.mean(axis=0)
    residual = centred - carrier * np.sum(carrier * centred, axis=0)
    free = 1 - 1 / len(shifts) - carrier**2
    return _summarise_residual(residual, free, len(shifts) - 2)


def closure_with_level(
    frames: ArrayLike,
    shifts_rad: Sequence[float] | FloatArray,
    mean_adu: FloatArray,
    amplitude_adu: FloatArray,
) -> Closure:
    """Agreement with a sinusoid of known mean and amplitude and unknown phase.

    With the mean known, the model is linear in cosine and sine; the phasor's length, which should
    be the amplitude, is one more equation. To first order in the noise that is the fit of the phase
    alone.

    Parameters
    ----------
    frames, shifts_rad
        As those of `compute_closure`.
    mean_adu, amplitude_adu : (...) arrays
        Known mean and amplitude of each pixel.

    Returns
    -------
    Closure
        Names a suspect from N = 4 on.

    Raises
    ------
    ValueError
        As `compute_closure`.
    """
    # I_k - A = C cos d_k - S sin d_k, with C^2 + S^2 = B^2 (section 1 of
    # docs/explanation/metrology.md).
    stack, shifts = _check_frames(frames, shifts_rad)
    count = len(shifts)
    centred = stack - np.ravel(mean_adu)
    amplitude = np.ravel(amplitude_adu)
    design = np.stack([np.cos(shifts), -np.sin(shifts)], axis=1)

    # The RMS of all frames: N equations and that of the length, less two unknowns.
    rms_adu = math.sqrt(_level_rss(centred, design, amplitude) / (count - 1))

    # The same without each frame in turn: the suspect is the one without which the rest agrees.
    without_rms_adu = np.empty(count)
    for left_out in range(count):
        kept = np.arange(count) != left_out
        rss = _level_rss(centred[kept], design[kept], amplitude)
        without_rms_adu[left_out] = math.sqrt(rss / (count - 2))

    # What each frame leaves of the best phasor.
    residual = centred - design @ np.linalg.pinv(design) @ centred
    frame_rms_adu = np.sqrt(np.mean(residual**2, axis=1))
    return Closure(rms_adu, frame_rms_adu, without_rms_adu)


def _level_rss(centred: FloatArray, design: FloatArray, amplitude: FloatArray) -> float:
    """Mean over pixels of the sum of squared residuals, with that of the phasor's length.

    The latter is in units of the phasor's variance along itself. `centred` (N, pixels) are the
    intensities less the known mean.
    """
    # The phasor by least squares, and its covariance for noise of 1.
    covariance = np.linalg.inv(design.T @ design)
    phasor = covariance @ design.T @ centred

    # Variance along the phasor itself: e^T C e.
    length = np.linalg.norm(phasor, axis=0)
    direction = phasor / np.maximum(length, _TINY)
    variance = np.einsum("ip,ij,jp->p", direction, covariance, direction)
    least_variance = np.linalg.eigvalsh(covariance)[0]  # a phasor of 0 has no direction
    variance = np.maximum(variance, least_variance)

    # The frames' residuals, and the length's difference from the amplitude as one more.
    rss = np.sum((centred - design @ phasor) ** 2, axis=0)
    of_length = (length - amplitude) ** 2 / variance
    return float(np.mean(rss + of_length))


def _check_frames(
    frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Frames as (N, pixels) and shifts (N,); refuses fewer than four, which always agree."""
    shifts = np.asarray(shifts_rad, float)
    stack = np.asarray(frames, float).reshape(len(shifts), -1)
    if len(shifts) < 4:
        raise ValueError(f"{len(shifts)} phase steps always agree: a closure needs four or more")
    if stack.shape[1] == 0:
        raise ValueError("no pixels to test")
    step_weights(shifts)  # refuses steps that determine no phase
    return stack, shifts


def _summarise_residual(residual: FloatArray, free: FloatArray, freedom: int) -> Closure:
    """The closure from each pixel's residual.

    Parameters
    ----------
    residual : (N, pixels) array
        r = P I.
    free : (N, pixels) array
        Diagonal of P.
    freedom : int
        Degrees of freedom of a pixel: the trace of P.
    """
    rss = np.sum(residual**2, axis=0)
    rms_adu = math.sqrt(float(rss.mean()) / freedom)
    frame_rms_adu = np.sqrt(np.mean(residual**2, axis=1))
    without_rms_adu = np.full(len(residual), math.nan)
    if freedom > 1:
        # Omission of frame k lowers the sum by r_k^2 / P_kk. A frame that the model explains in
        # any case (P_kk = 0) cannot be tested by omission: its pixel keeps its sum.
        drop = np.where(free > _TINY, residual**2 / np.maximum(free, _TINY), 0.0)
        left = np.maximum(np.mean(rss - drop, axis=1), 0.0)
        without_rms_adu = np.sqrt(left / (freedom - 1))
    return Closure(rms_adu, frame_rms_adu, without_rms_adu)
