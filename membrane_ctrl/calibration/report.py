"""What a calibration found, as a table for JSON and as lines for a person."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from membrane_ctrl.metrology.calibrate.determined import condition_number, weak_combinations
from membrane_ctrl.metrology.calibrate.diagnose import laser_scale, left_out
from membrane_ctrl.metrology.calibrate.parameters import ALL, NAMES
from membrane_ctrl.metrology.calibrate.propagate import propagate
from membrane_ctrl.metrology.calibrate.solve import Solution
from membrane_ctrl.metrology.calibrate.verdict import Finding

_SOME_LASER = 0.5  # sigma of the laser's scale without any reading: 1


def report_of(solution: Solution | None, findings: Sequence[Finding], analysis_radius_mm: float) -> dict[str, Any]:
    """The report, schema membrane-calibration/1; without a solution only what was found."""
    table: dict[str, Any] = {
        "schema": "membrane-calibration/1",
        "verdict": "rejected" if any(finding.fatal for finding in findings) else "ok",
        "findings": [{"fatal": finding.fatal, "says": finding.says} for finding in findings],
    }
    if solution is None or not solution.converged:
        return table
    middle = len(solution.states) // 2
    claim = propagate(solution, middle, analysis_radius_mm)
    scale = laser_scale(solution)
    return table | {
        "iterations": len(solution.changes),
        "condition": condition_number(solution),
        "parameters": [_parameter(solution, name) for name in solution.free],
        "not_determined": [
            {"sigma_left": each.left, "height_um": each.height_um, "figure_um": each.figure_um, "says": each.words}
            for each in weak_combinations(solution, middle, analysis_radius_mm)
        ],
        "uncertainty": {
            "height_rms_um": claim.height_rms_um,
            "figure_rms_um": claim.figure_rms_um,
            "sag_um": claim.sag_um,
            "zernike_um": claim.zernike_um.tolist(),
        },
        "laser": {"scale": scale.value, "sigma": scale.sigma},
        "sets": _sets(solution),
    }


def _parameter(solution: Solution, name: str) -> dict[str, Any]:
    k = NAMES.index(name)
    return {
        "name": name,
        "value": float(solution.values[k]),
        "sigma": float(solution.sigmas[k]),
        "sigma_before": float(solution.problem.sigmas[k]),
    }


def _sets(solution: Solution) -> list[dict[str, Any]]:
    """Each set: its noise against the camera's, what the model leaves, and the set against the others."""
    return [
        {
            "name": phases.name,
            "displacement_um": phases.displacement_um if np.isfinite(phases.displacement_um) else None,
            "sag_mm": state.surface.sag_mm,
            "noise_ratio": float(np.sqrt(linear.variance)),
            "screen_residual_um": 1e3 * linear.residual_rms_mm,
            "left_out_fall": out.fall,
            "left_out_freedom": out.freedom,
        }
        for phases, state, linear, out in zip(
            solution.problem.sets, solution.states, solution.equations, left_out(solution), strict=True
        )
    ]


def lines_of(report: dict[str, Any]) -> list[str]:
    """For a terminal."""
    lines = [f"verdict: {report['verdict']}"]
    lines += [("  ! " if finding["fatal"] else "  note: ") + finding["says"] for finding in report["findings"]]
    if "parameters" not in report:
        return lines
    lines.append("what           stated wrong by   +-        known before")
    for row in report["parameters"]:
        says = ALL[NAMES.index(row["name"])].says
        lines.append(
            f"{row['name']:<18}{row['value']:>+11.4f}  {row['sigma']:<9.4f} {row['sigma_before']:<8.4g} {says}"
        )
    lines.append("set                 reading um   sag mm    noise  residual um  against the others")
    for row in report["sets"]:
        reading = "-" if row["displacement_um"] is None else f"{row['displacement_um']:.1f}"
        lines.append(
            f"{row['name']:<18}{reading:>12}{row['sag_mm']:>10.4f}{row['noise_ratio']:>8.2f}"
            f"{row['screen_residual_um']:>12.2f}  {row['left_out_fall']:.0f} of {row['left_out_freedom']} expected"
        )
    claim = report["uncertainty"]
    lines.append(
        f"a figure made with it: sag +- {claim['sag_um']:.2f} um, figure +- {claim['figure_rms_um']:.2f} um RMS, "
        f"with its tilt +- {claim['height_rms_um']:.1f} um RMS"
    )
    if report["laser"]["sigma"] < _SOME_LASER:
        lines.append(f"laser against optics: {report['laser']['scale']:.5f} +- {report['laser']['sigma']:.5f}")
    lines.append(f"condition number {report['condition']:.2g}; not determined by the sets:")
    lines += [f"  {each['sigma_left']:.0%} left: {each['says']}" for each in report["not_determined"]] or [
        "  nothing"
    ]
    if report.get("out"):
        lines.append(f"written: {report['out']} (hash {report['hash']})")
    return lines
