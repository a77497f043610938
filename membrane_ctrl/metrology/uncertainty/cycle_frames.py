"""Light of each frame of a live cycle and the film's place at it, from points of known phase."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# Columns of the model of a frame, see `estimate_frame_errors`.
_LEVEL, _SWING, _STEP, _FILM, _SECOND, _THIRD = range(6)
_COLUMNS = 6
# The columns whose amplitudes differ from frame to frame; the phase step is known.
_DIFFERS = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
_REGULAR = 1e-9  # added to the diagonal of the scaled normal matrix
_TINY = 1e-30  # instead of a division by zero
_LEAST_AMPLITUDE = 1e-9


@dataclass(frozen=True)
class FrameErrors:
    """Light and film of the 2 N frames of a cycle, x frames first, each about the mean of its axis.

    Attributes
    ----------
    level : (2 N,) array
        Relative change of the light.
    swing : (2 N,) array
        Relative change of the fringes' amplitude.
    corrected_um : (2 N,) array
        Place of the film that the phases were corrected for.
    moved_um : (2 N,) array
        Motion of the film beyond that.
    harmonics : (2, 2) array
        Second and third harmonic of x and of y over the amplitude: the display's response.
    waves_rad : (2, n) array
        What all these errors add to the phases of the points.
    """

    level: FloatArray
    swing: FloatArray
    corrected_um: FloatArray
    moved_um: FloatArray
    harmonics: FloatArray
    waves_rad: FloatArray


def estimate_frame_errors(
    means: FloatArray,
    shifts_rad: FloatArray,
    weights: FloatArray,
    phase_rad: FloatArray,
    corrected_um: FloatArray,
    sensitivity_rad_per_um: FloatArray,
) -> FrameErrors:
    """Estimate light and film of each frame from points whose phases no single frame determines.

    A frame is fitted by its level A, its swing B cos psi, a phase step -B sin psi, the motion of
    the film and two harmonics, with psi the phase of the fitted surface plus the step (as in
    `frame_checks.frame_evidence`).

    Parameters
    ----------
    means : (2, N, n) array
        What the N frames of each axis show at the n points.
    shifts_rad : (2, N) array
        Phase steps.
    weights : (2, 3, N) array
        Their `phase_steps.step_weights`.
    phase_rad : (2, n) array
        Phases of the fitted surface at the points, the film at its mean place.
    corrected_um : (2, N) array
        Place of the film about its mean that the phases were corrected for.
    sensitivity_rad_per_um : (2, n) array
        Change of phase per µm of displacement.

    Returns
    -------
    FrameErrors
    """
    scenes = weights @ means
    of_axes = []
    waves_rad = []
    for axis, frames in enumerate(means):
        # Level and swing are those of the other axis: uneven light leaves waves in the mean of its
        # own frames, which would hide half of it.
        level, cosine, sine = scenes[1 - axis]
        swing = np.hypot(cosine, sine)
        slope = sensitivity_rad_per_um[axis]
        known_um = corrected_um[axis][:, None]
        psi = shifts_rad[axis][:, None] + phase_rad[axis] + known_um * slope
        wave = np.exp(1j * psi)
        second = wave * wave
        third = second * wave

        # Columns of the model at each point, and the frame itself as the last one.
        table = np.empty((len(frames), _COLUMNS + 1, level.size))
        table[:, _LEVEL] = level
        table[:, _SWING] = swing * wave.real
        table[:, _STEP] = swing * wave.imag
        table[:, _FILM] = (slope.mean() - slope) * table[:, _STEP]
        table[:, _SECOND] = swing * second.real
        table[:, _THIRD] = swing * third.real
        table[:, _COLUMNS] = frames
        amplitudes = _solve_amplitudes(table)

        # Amplitudes of the fringes, and film and harmonics over them.
        amplitude = np.hypot(amplitudes[:, _SWING], amplitudes[:, _STEP])
        least = np.maximum(amplitude, _LEAST_AMPLITUDE)
        relative = amplitudes[:, _FILM:] / least[:, None]
        of_axes.append(np.stack([amplitudes[:, _LEVEL], amplitude, *relative.T]))

        # What these errors add to the frames: what differs from frame to frame, and the harmonics,
        # which move with the film.
        differs = (amplitudes - amplitudes.mean(axis=0)) * _DIFFERS
        share_2, share_3 = relative[:, 1:].mean(axis=0)
        by_phase = -(2 * share_2 * second.imag + 3 * share_3 * third.imag) * swing
        harmonics_slope = by_phase * slope
        errors = np.einsum("kp,kpn->kn", differs, table[:, :-1]) + known_um * harmonics_slope

        # And thereby to the phases, by the weights of the steps.
        added = weights[axis, 1:] @ errors
        unit = np.exp(1j * phase_rad[axis])
        turned = added[1] * unit.real - added[0] * unit.imag
        waves_rad.append(turned / (swing * abs(amplitudes[:, _SWING].mean())))

    # Rows: level, swing, film, second and third harmonic; each about its mean over the axis.
    shown = np.stack(of_axes, axis=1)
    mean_of_axis = shown.mean(axis=2)
    about = shown[:3] - mean_of_axis[:3, :, None]
    about[:2] /= mean_of_axis[:2, :, None]
    level, swing, moved_um = about.reshape(3, -1)
    return FrameErrors(
        level=level,
        swing=swing,
        corrected_um=corrected_um.ravel(),
        moved_um=moved_um,
        harmonics=mean_of_axis[3:].T,
        waves_rad=np.stack(waves_rad),
    )


def _solve_amplitudes(table: FloatArray) -> FloatArray:
    """Least squares (frames, columns) for the amplitudes of the columns in each frame.

    `table` (frames, columns + 1, n) are the columns, and the frame itself.
    """
    # Products of the columns with each other and with the frame (the last row), scaled to a unit
    # diagonal.
    gram = table @ table.transpose(0, 2, 1)
    scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), _TINY))
    gram = gram / (scale[:, :, None] * scale[:, None, :])

    # Normal equations, kept regular; and the scale undone.
    normal = gram[:, :-1, :-1] + _REGULAR * np.eye(_COLUMNS)
    solved = np.linalg.solve(normal, gram[:, :-1, -1:])[:, :, 0]
    return np.asarray(solved * scale[:, -1:] / scale[:, :-1])
