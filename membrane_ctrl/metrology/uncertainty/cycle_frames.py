"""Light of each frame of a live cycle and the film's place at it, from points of known phase."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_COLUMNS = 6  # of a frame, see `frames_seen`
_DIFFERS = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])  # of these columns, all but the phase step


@dataclass(frozen=True)
class FrameErrors:
    """Light and film of the 2 N frames of a cycle, x frames first,
    each about the mean of its axis.
    """

    level: FloatArray  # (2 N,): relative
    swing: FloatArray  # (2 N,): relative
    told_um: FloatArray  # (2 N,): the film, as the phases were corrected for
    moved_um: FloatArray  # (2 N,): the film beyond that
    # (2, 2): second and third of x and of y over the amplitude: the display's response
    harmonics: FloatArray
    waves_rad: FloatArray  # (2, n): what all that adds to the phases of the points


def estimate_frame_errors(
    means: FloatArray,
    shifts_rad: FloatArray,
    weights: FloatArray,
    phase_rad: FloatArray,
    told_um: FloatArray,
    sensitivity_rad_per_um: FloatArray,
) -> FrameErrors:
    """Light and film of each frame from points whose phases are known without any single frame.

    Parameters
    ----------
    means : (2, N, n) array
        What the frames of each axis show at the points.
    shifts_rad : (2, N) array
        Phase steps; `weights` (2, 3, N) are their `phase.step_weights`.
    phase_rad : (2, n) array
        Phases of the fitted surface at the points, film at its mean place.
    told_um : (2, N) array
        Place of the film about its mean, as the phases were corrected for.
    sensitivity_rad_per_um : (2, n) array
        Change of phase per µm of displacement.
    """
    scenes, out, waves = weights @ means, [], []
    for axis, frames in enumerate(means):
        # of the other axis: uneven light leaves waves in the scene of its own frames, which would
        # hide half of it
        level, cosine, sine = scenes[1 - axis]
        swing, slope = np.hypot(cosine, sine), sensitivity_rad_per_um[axis]
        wave = np.exp(
            1j * (shifts_rad[axis][:, None] + phase_rad[axis] + told_um[axis][:, None] * slope)
        )
        # level, swing, step, film, the display's harmonics (`frame_checks.frame_evidence`), and
        # the frame
        table = np.empty((len(frames), _COLUMNS + 1, level.size))
        table[:, 0], table[:, 1], table[:, 2] = level, swing * wave.real, swing * wave.imag
        table[:, 3] = (slope.mean() - slope) * table[:, 2]
        square = wave * wave
        table[:, 4], table[:, 5] = swing * square.real, swing * (square * wave).real
        table[:, 6] = frames
        gram = table @ table.transpose(0, 2, 1)
        scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-30))
        gram = gram / (scale[:, :, None] * scale[:, None, :])
        solved = np.linalg.solve(gram[:, :-1, :-1] + 1e-9 * np.eye(_COLUMNS), gram[:, :-1, -1:])[
            :, :, 0
        ]
        found = solved * scale[:, -1:] / scale[:, :-1]
        # of errors of light and place alone: what differs from frame to frame
        differs = (found - found.mean(axis=0)) * _DIFFERS
        amplitude = np.hypot(found[:, 1], found[:, 2])
        relative = found[:, 3:] / np.maximum(amplitude, 1e-9)[:, None]
        # and of the harmonics, which move with the film as well
        second, third = relative[:, 1:].mean(axis=0)
        display = -(2 * second * square.imag + 3 * third * (square * wave).imag) * swing * slope
        errors = np.einsum("kp,kpn->kn", differs, table[:, :-1]) + told_um[axis][:, None] * display
        added = weights[axis, 1:] @ errors
        unit = np.exp(1j * phase_rad[axis])
        waves.append(
            (added[1] * unit.real - added[0] * unit.imag) / (swing * abs(found[:, 1].mean()))
        )
        out.append(np.stack([found[:, 0], amplitude, *relative.T]))
    shown = np.stack(out, axis=1)  # (5, 2, N): level, swing, film, harmonics
    means = shown.mean(axis=2)
    about = shown[:3] - means[:3, :, None]
    about[:2] /= means[:2, :, None]
    level, swing, moved_um = about.reshape(3, -1)
    return FrameErrors(level, swing, told_um.ravel(), moved_um, means[3:].T, np.stack(waves))
