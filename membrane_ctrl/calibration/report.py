"""Results of a calibration as a table for JSON; `report_text` makes lines of it."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from membrane_ctrl.metrology.calibration import (
    advice,
    artefact_advice,
    figure_uncertainty,
    model_tests,
    screen_advice,
    solver,
    verdict,
    weak_combinations,
)
from membrane_ctrl.metrology.rays import bench_parameters
from membrane_ctrl.model import program


def calibration_report(
    solution: solver.Solution | None,
    findings: Sequence[verdict.CalibrationFinding],
    analysis_radius_mm: float,
) -> dict[str, Any]:
    """The report, schema membrane-calibration/1; without a solution only the findings.

    Parameters
    ----------
    solution : Solution or None
        None if the sets were rejected before a solution.
    findings : sequence of CalibrationFinding
        What the tests of the solution found.
    analysis_radius_mm : float
        The figure's errors are stated within this radius.
    """
    table: dict[str, Any] = {
        **program.file_origin("membrane-calibration/1"),
        "verdict": "rejected" if any(finding.fatal for finding in findings) else "ok",
        "findings": [
            {"fatal": finding.fatal, "description": finding.description} for finding in findings
        ],
    }
    if solution is None or not solution.converged:
        return table

    # What the calibration claims, and what to measure next, for the middle set.
    middle = solution.problem.middle_film_set
    claim = figure_uncertainty.propagate_to_figure(solution, middle, analysis_radius_mm)
    scale = model_tests.laser_scale(solution)
    number = advice.advise_number(solution, middle)
    artefact = artefact_advice.advise_sphere(solution, middle)
    return table | {
        "iterations": len(solution.changes),
        "condition": weak_combinations.condition_number(solution),
        "parameters": [_parameter_row(solution, name) for name in solution.free_names],
        "not_determined": [
            {
                "sigma_left": each.left,
                "height_um": each.height_um,
                "figure_um": each.figure_um,
                "description": each.words,
            }
            for each in weak_combinations.weak_combinations(solution, middle, analysis_radius_mm)
        ],
        "uncertainty": {
            "height_rms_um": claim.height_rms_um,
            "figure_rms_um": claim.figure_rms_um,
            "sag_um": claim.sag_um,
            "zernike_um": claim.zernike_um.tolist(),
        },
        "advice": None if number is None else asdict(number),
        "artefact_advice": None if artefact is None else asdict(artefact),
        "screen_advice": [
            asdict(each) for each in screen_advice.advise_screen_sets(solution, middle)
        ],
        "film": solution.problem.references.film,
        "rim": solution.problem.rim is not None,
        "laser": {"scale": scale.value, "sigma": scale.sigma},
        "sets": _set_rows(solution),
    }


def _parameter_row(solution: solver.Solution, name: str) -> dict[str, Any]:
    """One free parameter: its value, and its sigma after and before the calibration."""
    k = bench_parameters.NAMES.index(name)
    return {
        "name": name,
        "value": float(solution.values[k]),
        "sigma": float(solution.sigmas[k]),
        "sigma_before": float(solution.problem.sigmas[k]),
    }


def _set_rows(solution: solver.Solution) -> list[dict[str, Any]]:
    """Per set: its noise relative to the camera's, its residuals, and the test against the other
    sets.
    """
    rows = []
    for k, (phases, state, linear, out) in enumerate(
        zip(
            solution.problem.sets,
            solution.states,
            solution.equations,
            model_tests.compare_left_out_sets(solution),
            strict=True,
        )
    ):
        has_reading = np.isfinite(phases.displacement_um)
        rows.append(
            {
                "name": phases.name,
                "surface": "film" if phases.artefact is None else phases.artefact.name,
                "displacement_um": phases.displacement_um if has_reading else None,
                "sag_mm": state.surface.sag_mm,
                "noise_ratio": float(np.sqrt(linear.variance)),
                "screen_residual_um": 1e3 * linear.residual_rms_mm,
                "left_out_fall": out.fall,
                "left_out_freedom": out.freedom,
                "turned": _turn_row(solution, k),
            }
        )
    return rows


def _turn_row(solution: solver.Solution, index: int) -> dict[str, float] | None:
    """Stated and fitted angle of a turned mirror, and the fitted place of its axis."""
    turned = solution.problem.sets[index].turned
    if turned is None:
        return None
    x_mm, y_mm, more_rad = solution.states[index].seat
    sigmas = figure_uncertainty.seat_sigmas(solution, index)
    return {
        "angle_deg": turned.angle_deg,
        "found_deg": turned.angle_deg + float(np.degrees(more_rad)),
        "sigma_deg": float(np.degrees(sigmas[2])),
        "x_mm": x_mm,
        "y_mm": y_mm,
        "seat_sigma_mm": float(np.max(sigmas[:2])),
    }
