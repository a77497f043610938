"""Error of the figure by a camera, screen or mirror that moves as a body during the set.

The x frames are taken before the y frames. A body that moves steadily shifts the x phases against
the y phases, by amounts that differ over the mirror, which looks like a figure. The frames of each
axis show how fast their picture drifts (`PhaseShifts`). Several bodies may be the cause: each is
given the motion that explains both drifts, and the row is the mean over them. The mirror is none of
them: only the places of camera and screen relative to it count.
"""

import math

import numpy as np

from membrane_ctrl.metrology.frame_checks.phase_drift import PhaseShifts
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays.bench_motions import GROUPS, group_columns
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, moves_mm
from membrane_ctrl.model.arrays import FloatArray

_DESCRIPTION = "camera, screen or mirror that moves from the x to the y frames"
# Largest ratio of the two drifts that a unit of the two components of a body makes: one of them
# would need a motion without measure to explain a drift of the other axis.
_LARGEST_CONDITION = 10.0

# Square of the drift that others cause by chance, over their variance. Two sigma: with one, half of
# all benches at rest had a row of 0.02 to 0.08 µm, three to ten times their error in Z9 and Z10.
_CHANCE = 4.0

_TINY = 1e-30  # instead of a division by zero


def phase_drift_source(
    bench: TrialBench, changes_mm: FloatArray, shifts: tuple[PhaseShifts, PhaseShifts]
) -> Source:
    """The row for bodies that move steadily during the set.

    Parameters
    ----------
    bench : TrialBench
        n points of the set.
    changes_mm : (components, 2, n) array
        Change of the screen points by each motion (`bench_motions.screen_changes`).
    shifts : two PhaseShifts
        Of x and y.
    """
    scale = screen_scale.mm_per_rad(bench.optics.pattern)
    drift_mm = scale * np.array([of_axis.drift_rad for of_axis in shifts])
    times = np.array([of_axis.frames.mean() for of_axis in shifts])
    later = (times - times.mean())[:, None]
    # Each body that moves steadily in one way that its two shifts of the picture determine.
    nominal = bench.geometry()
    effects = [np.zeros_like(bench.surface.parameters)]
    for group, columns in zip(GROUPS, group_columns(), strict=True):
        if group.components == 1 or not group.allowance:
            continue
        seen = _shifts_of_picture(bench, changes_mm[columns])
        if np.linalg.cond(seen) > _LARGEST_CONDITION:
            continue
        rates = np.linalg.solve(seen, drift_mm)
        off_mm = later * np.einsum("c,can->an", rates, changes_mm[columns])
        solved = bench.solve(nominal, off_mm, linear=True)
        effects.append(solved - bench.surface.parameters)
    effects_mm = np.stack(effects, axis=1) / math.sqrt(max(len(effects) - 1, 1))

    # The share of the drift that a film in motion, and what the frames' models leave, would cause
    # as well by chance.
    by_film_mm = scale * np.array([of_axis.drift_by_film_rad for of_axis in shifts])
    by_rest_mm = scale * np.array([of_axis.drift_sigma_rad for of_axis in shifts])
    by_others_mm2 = float(np.sum(by_film_mm**2) + np.sum(by_rest_mm**2))
    share = min(_CHANCE * by_others_mm2 / max(float(np.sum(drift_mm**2)), _TINY), 1.0)
    noise_mm2 = share * float(np.sum(effects_mm**2))
    return Source(
        "phase_drift",
        _DESCRIPTION,
        math.nan,
        effects_mm,
        common=False,
        paired=False,
        noise_mm2=noise_mm2,
    )


def _shifts_of_picture(bench: TrialBench, changes_mm: FloatArray) -> FloatArray:
    """Shift (2, components) of the picture of each axis, as a frame shows it beside the film's
    motion.

    `changes_mm` (components, 2, n) are those of the screen points.
    """
    shifts = np.empty((2, len(changes_mm)))
    for axis, moves in enumerate(moves_mm(bench)):
        about_mean = moves - moves.mean()
        shape = np.stack([np.ones_like(moves), about_mean])
        shifts[axis] = changes_mm[:, axis] @ np.linalg.pinv(shape)[:, 0]
    return shifts
