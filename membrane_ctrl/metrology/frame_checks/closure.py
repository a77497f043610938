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

from membrane_ctrl.metrology.phase.phase_steps import step_residual, step_weights
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

_TINY = 1e-9  # share of a frame that the model does not explain; below this it explains any frame


@dataclass(frozen=True)
class Closure:
    """How well N frames agree."""

    rms_adu: float  # the residual, per degree of freedom: the noise, if all is well
    frame_rms_adu: FloatArray  # (N,): the residual of each frame, over all pixels
    # (N,): the residual, per degree of freedom, without that frame; NaN where nothing would be left
    # to test
    without_rms_adu: FloatArray

    @property
    def suspect(self) -> int | None:
        """The frame that explains the disagreement best when left out; None if the data cannot
        tell.
        """
        return (
            None if np.isnan(self.without_rms_adu).any() else int(np.argmin(self.without_rms_adu))
        )

    @property
    def gain(self) -> float:
        """How many times better the rest agrees without the suspect:
        about 1 if no frame is wrong.
        """
        return (
            1.0
            if self.suspect is None
            else self.rms_adu / max(float(self.without_rms_adu.min()), _TINY)
        )


def compute_closure(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> Closure:
    """Agreement of the frames with a sinusoid of unknown mean, amplitude and phase in each pixel.

    Raises ValueError for fewer than four frames, or steps that determine no phase.

    Parameters
    ----------
    frames : (N, ...) array
        Intensities, N >= 4; pixels without fringes left out or masked by the caller.
    shifts_rad : (N,) array
        Phase steps.
    """
    stack, shifts = _check_frames(frames, shifts_rad)
    residual = step_residual(stack, shifts)
    design = np.stack([np.ones_like(shifts), np.cos(shifts), -np.sin(shifts)], axis=1)
    free = 1 - np.einsum("kp,pk->k", design, step_weights(shifts))  # diagonal of P
    return _summarise_residual(
        residual, np.broadcast_to(free[:, None], residual.shape), len(shifts) - 3
    )


def closure_with_phase(
    frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray, phase_rad: FloatArray
) -> Closure:
    """Agreement with a sinusoid of known phase (...) and unknown mean and amplitude; names a frame
    from N = 4 on.

    An error of the phase shows in all frames, as amplitude times error: it hides faults below that.
    """
    stack, shifts = _check_frames(frames, shifts_rad)
    carrier = np.cos(np.ravel(phase_rad) + shifts[:, None])
    carrier -= carrier.mean(axis=0)
    carrier /= np.maximum(np.linalg.norm(carrier, axis=0), _TINY)
    centred = stack - stack.mean(axis=0)
    residual = centred - carrier * np.sum(carrier * centred, axis=0)
    return _summarise_residual(residual, 1 - 1 / len(shifts) - carrier**2, len(shifts) - 2)


def closure_with_level(
    frames: ArrayLike,
    shifts_rad: Sequence[float] | FloatArray,
    mean_adu: FloatArray,
    amplitude_adu: FloatArray,
) -> Closure:
    """Agreement with a sinusoid of known mean and amplitude (...) and unknown phase; names a frame
    from N = 4 on.

    Linear in cosine and sine with the mean known; the phasor's length, which should be the
    amplitude, is one more equation. To first order in the noise that is the fit of the phase alone.
    """
    stack, shifts = _check_frames(frames, shifts_rad)
    centred, amplitude = stack - np.ravel(mean_adu), np.ravel(amplitude_adu)
    design = np.stack([np.cos(shifts), -np.sin(shifts)], axis=1)
    rest = [np.arange(len(shifts)) != k for k in range(len(shifts))]
    without = [
        math.sqrt(_level_rss(centred[keep], design[keep], amplitude) / (len(shifts) - 2))
        for keep in rest
    ]
    rms = math.sqrt(_level_rss(centred, design, amplitude) / (len(shifts) - 1))
    residual = centred - design @ np.linalg.pinv(design) @ centred
    return Closure(rms, np.sqrt(np.mean(residual**2, axis=1)), np.array(without))


def _level_rss(centred: FloatArray, design: FloatArray, amplitude: FloatArray) -> float:
    """Mean over pixels of the residual squares, that of the phasor's length in units of its
    variance along itself.
    """
    covariance = np.linalg.inv(design.T @ design)
    phasor = covariance @ design.T @ centred
    length = np.linalg.norm(phasor, axis=0)
    along = phasor / np.maximum(length, _TINY)
    variance = np.einsum("ip,ij,jp->p", along, covariance, along)
    variance = np.maximum(
        variance, np.linalg.eigvalsh(covariance)[0]
    )  # a phasor of 0 points nowhere
    rss = np.sum((centred - design @ phasor) ** 2, axis=0)
    return float(np.mean(rss + (length - amplitude) ** 2 / variance))


def _check_frames(
    frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Frames as (N, pixels) and shifts; four frames at least, as three always agree."""
    shifts = np.asarray(shifts_rad, float)
    stack = np.asarray(frames, float).reshape(len(shifts), -1)
    if len(shifts) < 4:
        raise ValueError(f"{len(shifts)} phase steps always agree: a closure needs four or more")
    if stack.shape[1] == 0:
        raise ValueError("no pixels to test")
    step_weights(shifts)  # refuses steps that determine no phase
    return stack, shifts


def _summarise_residual(residual: FloatArray, free: FloatArray, freedom: int) -> Closure:
    """From the residual (N, pixels), the diagonal of P there, and the degrees of freedom of a
    pixel.
    """
    rss = np.sum(residual**2, axis=0)
    rms = math.sqrt(float(rss.mean()) / freedom)
    # a frame that the model explains in any case cannot be tested by omission: its pixel keeps its
    # sum
    drop = np.where(free > _TINY, residual**2 / np.maximum(free, _TINY), 0.0)
    without = np.full(len(residual), math.nan)
    if freedom > 1:
        without = np.sqrt(np.maximum(np.mean(rss - drop, axis=1), 0.0) / (freedom - 1))
    return Closure(rms, np.sqrt(np.mean(residual**2, axis=1)), without)
