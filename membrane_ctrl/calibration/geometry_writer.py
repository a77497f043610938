"""Writes the result of a calibration as `geometry.toml`."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import tomli_w

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.calibration import geometry_tables, solver, verdict, weak_combinations
from membrane_ctrl.metrology.cycle import geometry_monitors
from membrane_ctrl.metrology.rays import set_phases
from membrane_ctrl.model import errors
from membrane_ctrl.model.files import resolve_user_path, write_text_atomic


def write_geometry(
    path: Path,
    solution: solver.Solution,
    problem: solver.Problem,
    optics: OpticsConfig,
    findings: Sequence[verdict.CalibrationFinding],
) -> str:
    """Write `geometry.toml`.

    Parameters
    ----------
    path : Path
        The file.
    solution : Solution
        The solved bench, with its covariance.
    problem : Problem
        The sets.
    optics : OpticsConfig
        The stated bench.
    findings : sequence of CalibrationFinding
        What the verdict has found.

    Returns
    -------
    str
        Its hash.

    Raises
    ------
    InputError
        It cannot be written.
    """
    films = [(solution.states[k], problem.sets[k]) for k in problem.film_sets]

    # Residual of the slopes, and what the noise of the screen points makes of it.
    slopes = [_slope_residual(solution, problem.sets[k], k) for k in problem.film_sets]
    noises = [
        geometry_monitors.noise_urad(
            solution.bench.geometry, state.surface, float(np.sqrt(np.mean(phases.sigma_mm**2)))
        )
        for state, phases in films
    ]

    # Where the geometry comes from.
    origin = geometry_tables.Origin(
        date_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        sets=tuple(phases.name for phases in problem.sets),
        screen_residual_um=1e3
        * float(np.median([each.residual_rms_mm for each in solution.equations])),
        slope_residual_urad=1e6 * float(np.median(slopes)),
        slope_noise_urad=float(np.median(noises)),
        condition=weak_combinations.condition_number(solution),
        notes=tuple(finding.description for finding in findings),
    )
    tables = geometry_tables.make_geometry_tables(solution, optics, origin)
    with errors.convert_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(resolve_user_path(path), tomli_w.dumps(tables))  # never half a geometry
    return str(tables["calibration"]["hash"])


def _slope_residual(solution: solver.Solution, phases: set_phases.SetPhases, index: int) -> float:
    """RMS of measured minus fitted slopes of one set's bins on the calibrated bench, as a live
    cycle states it.
    """
    fit = solver.fit_on(
        solution.bench, phases, solution.problem.radius_mm, solution.states[index].vertex_z_mm
    )
    return float(np.hypot(fit.residual_x, fit.residual_y) / np.sqrt(2))
