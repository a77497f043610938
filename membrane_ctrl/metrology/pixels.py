"""Phase, modulation and closure of every pixel: the full result's pass over the frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.frame_stack import Frames
from membrane_ctrl.metrology.jit import kernel
from membrane_ctrl.metrology.phase import step_weights
from membrane_ctrl.metrology.phasor import StepCombination, arctan2
from membrane_ctrl.metrology.threads import split

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PixelPhases:
    """One axis at n pixels.

    Attributes
    ----------
    phase_rad : (n,) array
        Absolute phase, the period nearest to the reference.
    swing_adu : (n,) float32 array
        Fringe amplitude.
    rest_adu : (n,) float32 array
        Root of the sum of squares that the sinusoid leaves; 0 for three frames.
    saturated : (n,) bool array
        Whether a frame is saturated there.
    """

    phase_rad: FloatArray
    swing_adu: NDArray[np.float32]
    rest_adu: NDArray[np.float32]
    saturated: NDArray[np.bool_]


@kernel
def _phases(frames, index, weights, shift_cos, shift_sin, turn, mirror, slope, reference, limit, out, start, stop):  # type: ignore[no-untyped-def]
    """Rows of `out` (2, n): swing (negative where saturated) and rest; `reference` (n,) is replaced by the phase."""
    steps = weights.shape[1]
    for p in range(start, stop):
        place = index[p]
        mean = 0.0
        c = 0.0
        s = 0.0
        top = 0.0
        for k in range(steps):
            value = float(frames[k, place])
            top = max(top, value)
            mean += weights[0, k] * value
            c += weights[1, k] * value
            s += weights[2, k] * value
        rest = 0.0
        for k in range(steps):
            left = float(frames[k, place]) - mean - c * shift_cos[k] + s * shift_sin[k]
            rest += left * left
        # z - i q (turn z - mirror conj z): the film's motion between the frames taken out (see `motion`)
        q = slope[p]
        u = turn.real * c - turn.imag * s - mirror.real * c - mirror.imag * s
        v = turn.real * s + turn.imag * c - mirror.imag * c + mirror.real * s
        c, s = c + q * v, s - q * u
        wrapped = arctan2(s, c)
        reference[p] = wrapped + 2 * math.pi * math.floor((reference[p] - wrapped) / (2 * math.pi) + 0.5)
        swing = math.sqrt(c * c + s * s)
        out[0, p] = -swing if top >= limit else swing
        out[1, p] = math.sqrt(rest)


def pixel_phases(
    frames: Frames,
    shifts_rad: FloatArray,
    combined: StepCombination,
    index: NDArray[np.int64],
    sensitivity_rad_per_um: FloatArray,
    reference_rad: FloatArray,
    full_scale_adu: int,
) -> PixelPhases:
    """Phases of one axis.

    Parameters
    ----------
    frames : (N, height, width) array
        The axis' usable sinusoids.
    shifts_rad : (N,) array
        Their steps.
    combined : StepCombination
        Motion of the film between them (`motion.combine_steps` for bins of one pixel).
    index : (n,) int array
        Pixels, counted row by row.
    sensitivity_rad_per_um : (n,) array
        Change of phase per um of displacement; zeros if no motion is taken out.
    reference_rad : (n,) array
        Absolute phase to within half a period; left alone.
    """
    flat = frames.reshape(len(frames), -1)
    phase = reference_rad.copy()
    out = np.empty((2, index.size), np.float32)
    fixed = (step_weights(shifts_rad), np.cos(shifts_rad), np.sin(shifts_rad), combined.turn, combined.mirror)

    def run(start: int, stop: int) -> None:
        _phases(flat, index, *fixed, sensitivity_rad_per_um, phase, float(full_scale_adu), out, start, stop)

    split(run, index.size)
    return PixelPhases(phase, np.abs(out[0]), out[1], np.signbit(out[0]))
