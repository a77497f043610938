"""Phase and modulation of every pixel: the pass over all frames of a measurement."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel, compile_step
from membrane_ctrl.metrology.numerics.threads import split_over_threads
from membrane_ctrl.metrology.phase.clip_levels import ClipLevels
from membrane_ctrl.metrology.phase.phase_change import StepCombination
from membrane_ctrl.metrology.phase.phasor_kernels import branchless_arctan2, remove_phasor_motion
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, IntArray, Singles


@dataclass(frozen=True)
class PixelPhases:
    """Phases of one axis at n pixels.

    Attributes
    ----------
    phase_rad : (n,) array
        Absolute phase, the period nearest to the reference.
    swing_adu : (n,) array
        Fringe amplitude.
    saturated : (n,) bool array
        Whether a frame is clipped there, at white or at black.
    """

    phase_rad: FloatArray
    swing_adu: Singles
    saturated: BoolArray


@compile_step
def _correct_light(frames, previous, rise, fall, k, place, fade):  # type: ignore[no-untyped-def]
    """Light of a pixel in frame k: without that of the previous picture, and without bands.

    Where the pixel is brighter than before, `rise` of the change is missing, else `fall` of it.
    """
    value = float(frames[k, place])
    more = value - float(previous[k, place])
    share = fall
    if more > 0:
        share = rise
    return (value + share * more) * fade


@compile_kernel
def _compute_phases(  # type: ignore[no-untyped-def]
    frames,
    previous,
    rise,
    fall,
    index,
    fade,
    weights,
    turn,
    mirror,
    slope,
    reference,
    white,
    black,
    out,
    start,
    stop,
):
    """The swing into `out` (n,), negative where clipped; the phase in place of `reference` (n,).

    `fade` (N, height) is 1 / gain of the rows; other arguments are those of `pixel_phases`.
    """
    steps, height = fade.shape
    for p in range(start, stop):
        place = index[p]
        row = place // (frames.shape[1] // height)

        # Phasor c + i s by least squares (section 1 of the derivation; eq. 1 of the paper for four
        # steps); and the extreme values, which may be clipped.
        c = 0.0
        s = 0.0
        top = 0.0
        bottom = white
        for k in range(steps):
            value = float(frames[k, place])
            top = max(top, value)
            bottom = min(bottom, value)
            light = _correct_light(frames, previous, rise, fall, k, place, fade[k, row])
            c += weights[1, k] * light
            s += weights[2, k] * light

        # The phase without the film's motion, in the period nearest to the reference.
        c, s = remove_phasor_motion(c, s, slope[p], turn, mirror)
        wrapped = branchless_arctan2(s, c)
        period = math.floor((reference[p] - wrapped) / (2 * math.pi) + 0.5)
        reference[p] = wrapped + 2 * math.pi * period

        # The swing, with a negative sign where a frame is clipped.
        swing = math.sqrt(c * c + s * s)
        if top >= white or bottom <= black:
            swing = -swing
        out[p] = swing


def pixel_phases(
    frames: Image,
    design: FloatArray,
    combined: StepCombination,
    index: IntArray,
    sensitivity_rad_per_um: FloatArray,
    reference_rad: FloatArray,
    clip: ClipLevels,
    gain: FloatArray | None = None,
    previous: Image | None = None,
    lag_shares: tuple[float, float] = (0.0, 0.0),
) -> PixelPhases:
    """Phases of one axis at n pixels (eq. 1, by least squares).

    Parameters
    ----------
    frames : (N, height, width) array
        The axis' usable sinusoids.
    design : (N, 3) array
        Their steps and light (`phase_steps.step_design`).
    combined : StepCombination
        Motion of the film between them (`film_motion.combine_steps`, for bins of one pixel).
    index : (n,) int array
        Pixels, counted row by row.
    sensitivity_rad_per_um : (n,) array
        Change of phase per µm of displacement; zeros if no motion is corrected.
    reference_rad : (n,) array
        Absolute phase to within half a period; not changed.
    clip : ClipLevels
        Levels at which the camera clips.
    gain : (N, height) array, optional
        Of the light of the rows of each frame.
    previous : (N, height, width) array, optional
        The frames taken before each.
    lag_shares : two floats
        Shares of those that the frames still show, where they are brighter and where darker.

    Returns
    -------
    PixelPhases
    """
    flat = frames.reshape(len(frames), -1)
    phase = reference_rad.copy()
    out = np.empty(index.size, np.float32)

    # Without bands the gain is 1; without image lag a frame is its own predecessor.
    fade = np.ones(frames.shape[:2])
    if gain is not None:
        fade = 1 / gain
    before = flat
    if previous is not None:
        before = previous.reshape(flat.shape)
    rise, fall = (share / (1 - share) for share in lag_shares)
    fixed = (fade, np.linalg.pinv(design), combined.turn, combined.mirror)

    def run(start: int, stop: int) -> None:
        _compute_phases(
            flat,
            before,
            rise,
            fall,
            index,
            *fixed,
            sensitivity_rad_per_um,
            phase,
            float(clip.white_adu),
            float(clip.black_adu),
            out,
            start,
            stop,
        )

    split_over_threads(run, index.size)
    return PixelPhases(phase, np.abs(out), np.signbit(out))
