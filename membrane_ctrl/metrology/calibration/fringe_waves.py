"""Errors of a set's phases that repeat with its fringes, found in its residuals and removed.

Light that differs between frames makes them: errors of a phase that depend on the phase alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.calibration.robust_weights import RobustWeights, across_px
from membrane_ctrl.metrology.calibration.set_state import SetState
from membrane_ctrl.metrology.rays import bench_poses, forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray

# Waves per fringe: light that differs between frames makes one and two, gamma with four steps four.
_WAVES = range(1, 5)
# Least size of waves that are removed, over a point's noise and over the usual set's waves: smaller
# ones are part of the scatter.
_LEAST_SIZE = 0.5
_LEAST_RATIO = 2.0
_SMOOTH_ORDER = 3  # of the polynomials in the picture that are fitted with the waves


def remove_fringe_waves(
    bench: bench_poses.BenchGeometry,
    sets: Sequence[set_phases.SetPhases],
    states: Sequence[SetState],
) -> tuple[set_phases.SetPhases, ...]:
    """Remove errors that repeat with the fringes from sets in which they are outstanding.

    With them, a set would look like one of another bench.

    Parameters
    ----------
    bench : BenchGeometry
        The calibrated bench.
    sets : sequence of SetPhases
        All sets.
    states : sequence of SetState
        Their unknowns at the solution.

    Returns
    -------
    tuple of SetPhases
    """
    # Waves of each set, in units of its noise.
    waves_mm = [
        _fit_waves_mm(bench, phases, state) for phases, state in zip(sets, states, strict=True)
    ]
    sizes = np.array(
        [
            np.std(of_set) / np.mean(phases.sigma_mm)
            for of_set, phases in zip(waves_mm, sets, strict=True)
        ]
    )
    # Sets whose waves are far above those of the others.
    is_strong = sizes > np.maximum(_LEAST_SIZE, _LEAST_RATIO * np.median(sizes))
    cleaned = list(sets)
    for k, phases in enumerate(sets):
        if is_strong[k]:
            cleaned[k] = replace(phases, screen_mm=phases.screen_mm - waves_mm[k])
    return tuple(cleaned)


def _fit_waves_mm(
    bench: bench_poses.BenchGeometry, phases: set_phases.SetPhases, state: SetState
) -> FloatArray:
    """The part of a set's residuals (2, n) that repeats with its fringes; 0 if their period is
    unknown.
    """
    out = np.zeros_like(phases.screen_mm)
    if not phases.period_mm:
        return out
    # Residuals, with the weights that outliers have lost.
    left_mm = forward_model.residual_mm(
        bench, phases, state.surface, state.vertex_z_mm, state.moved_screens
    )
    root = np.sqrt(RobustWeights.from_residual(phases, left_mm).weights) / phases.sigma_mm
    rad_per_mm = 2 * np.pi / phases.period_mm

    # For each place of the screen and each axis, waves of the fringes, whose amplitudes change
    # linearly over the picture, are fitted together with smooth changes.
    places = 1
    if phases.screen is not None:
        places = len(phases.moved_screens) + 1
    for place in range(places):
        some = phases.select_screen(place)
        if not some.any():
            continue
        column = phases.column_px[some] / across_px(phases)
        row = phases.row_px[some] / across_px(phases)
        orders = range(_SMOOTH_ORDER + 1)
        powers = [(p, q) for p in orders for q in range(_SMOOTH_ORDER + 1 - p)]
        smooth = [column**p * row**q for p, q in powers]
        for axis in range(2):
            # Cosine and sine of each harmonic, even over the picture and growing along its sides.
            phase_rad = rad_per_mm * phases.screen_mm[axis, some]
            waves = []
            for k in _WAVES:
                for wave in (np.cos(k * phase_rad), np.sin(k * phase_rad)):
                    waves += [wave * 1.0, wave * column, wave * row]
            # Weighted least squares; only the waves are kept.
            design = np.stack([*waves, *smooth], axis=1) * root[some, None]
            right = left_mm[axis, some] * root[some]
            amplitudes = np.linalg.lstsq(design, right, rcond=None)[0]
            out[axis, some] = amplitudes[: len(waves)] @ np.stack(waves)
    return out
