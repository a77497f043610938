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

_WAVES = range(
    1, 5
)  # per fringe: light that differs between frames makes one and two, gamma in four steps four
_WAVES_SEEN, _OUTSTANDING = (
    0.5,
    2.0,
)  # of a point's noise, and of the usual set's: smaller ones are part of the scatter


def remove_fringe_waves(
    bench: bench_poses.BenchGeometry,
    sets: Sequence[set_phases.SetPhases],
    states: Sequence[SetState],
) -> tuple[set_phases.SetPhases, ...]:
    """The sets, those with outstanding errors that repeat with the fringes without these.

    Light that differs between frames makes them: errors of a phase that depend on the phase alone.
    They show in the residuals, beside what is smooth there. Such a set would count as one of
    another bench.
    """
    waves = [_waves_mm(bench, *pair) for pair in zip(sets, states, strict=True)]
    sizes = np.array(
        [np.std(of_set) / np.mean(each.sigma_mm) for of_set, each in zip(waves, sets, strict=True)]
    )
    strong = sizes > np.maximum(_WAVES_SEEN, _OUTSTANDING * np.median(sizes))
    return tuple(
        replace(each, screen_mm=each.screen_mm - of_set) if bad else each
        for each, of_set, bad in zip(sets, waves, strong, strict=True)
    )


def _waves_mm(
    bench: bench_poses.BenchGeometry, phases: set_phases.SetPhases, state: SetState
) -> FloatArray:
    """What of a set's residuals (2, n) repeats with its fringes; 0 if their period is unknown."""
    out = np.zeros_like(phases.screen_mm)
    if not phases.period_mm:
        return out
    left = forward_model.residual_mm(
        bench, phases, state.surface, state.vertex_z_mm, state.elsewhere
    )
    root, turn = (
        np.sqrt(RobustWeights.seen(phases, left).weights) / phases.sigma_mm,
        2 * np.pi / phases.period_mm,
    )
    for there in range(1 if phases.screen is None else len(phases.elsewhere) + 1):
        some = phases.seen_with(there)
        column, row = (
            place[some] / across_px(phases) for place in (phases.column_px, phases.row_px)
        )
        smooth = [column**p * row**q for p in range(4) for q in range(4 - p)]
        for axis in range(2 if some.any() else 0):
            phase_rad = turn * phases.screen_mm[axis, some]
            waves = [
                wave(k * phase_rad) * by
                for k in _WAVES
                for wave in (np.cos, np.sin)
                for by in (1.0, column, row)
            ]
            design = np.stack([*waves, *smooth], axis=1) * root[some, None]
            found = np.linalg.lstsq(design, left[axis, some] * root[some], rcond=None)[0][
                : len(waves)
            ]
            out[axis, some] = found @ np.stack(waves)
    return out
