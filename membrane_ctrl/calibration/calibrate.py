"""The `calibrate` command: one geometry, with its covariance, from capture sets at several
pressures.
"""

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from membrane_ctrl.calibration.calibrate_options import CalibrateOptions, parse_freed
from membrane_ctrl.calibration.geometry_writer import write_geometry
from membrane_ctrl.calibration.report import calibration_report
from membrane_ctrl.calibration.report_text import format_report
from membrane_ctrl.calibration.residual_picture import draw_residuals
from membrane_ctrl.calibration.sets import Bundle, read_sets, with_priors
from membrane_ctrl.calibration.stated_problem import problem_of
from membrane_ctrl.geometry import prior_file
from membrane_ctrl.metrology.calibration import verdict
from membrane_ctrl.metrology.calibration.film_waves import solve_any_film
from membrane_ctrl.model import errors


def _judge_sets(
    findings: Sequence[verdict.CalibrationFinding], bundle: Bundle
) -> tuple[verdict.CalibrationFinding, ...]:
    """The findings with the notes of the sets.

    If the sets may be of different benches, a refusal begins with that.
    """
    notes = list(bundle.notes)
    judged = list(findings)
    if bundle.bench_doubt and any(finding.fatal for finding in findings):
        doubt = f"{bundle.bench_doubt}; if it was not: "
        for k, finding in enumerate(findings):
            if finding.fatal:
                judged[k] = replace(finding, description=doubt + finding.description)
    elif bundle.bench_doubt:
        notes.insert(0, bundle.bench_doubt)
    return (*judged, *(verdict.CalibrationFinding(False, note) for note in notes))


def calibrate_command(options: CalibrateOptions) -> int:
    """Read, solve, judge, write. Returns the exit code; raises CommandError for invalid sets."""
    # Sigmas of auxiliary calibrations, and those of the command line.
    priors = [prior_file.read_prior(path) for path in options.priors]
    free: dict[str, float] = {}
    for prior in priors:
        free |= prior.content.sigmas
    free |= parse_freed(options.free)

    # The sets, and the solution unless they already exclude one.
    begin_s = time.perf_counter()
    sets = read_sets(options.folders, options.geometry, options.reference_um)
    bundle = with_priors(sets, priors)
    read_s = time.perf_counter()
    problem = problem_of(bundle, free, options)
    findings = verdict.check_before_solving(problem)
    solution = None
    if not findings:
        try:
            solution, judged = solve_any_film(problem, _make_progress_line())
        except ValueError as error:  # the equations have no solution, perhaps of mixed benches
            judged = (verdict.CalibrationFinding(True, str(error)),)
        findings = _judge_sets(judged, bundle)
    timing = {"read": read_s - begin_s, "solve": time.perf_counter() - read_s}

    # The geometry, if it is usable; the picture also of a refused solution, where it helps most.
    usable = False
    written = ""
    if solution is not None:
        usable = not any(finding.fatal for finding in findings)
        if usable:
            written = write_geometry(options.out, solution, problem, bundle.optics, findings)
        if options.pictures:
            path = options.out.with_name(f"{options.out.stem}-residuals.png")
            with errors.convert_write_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                draw_residuals(path, solution)

    # The report.
    report = calibration_report(solution, findings, bundle.optics.mirror.analysis_radius_mm)
    report |= {
        "out": str(options.out) if usable else None,
        "hash": written or None,
        "timing_s": timing,
    }
    print(json.dumps(report) if options.as_json else "\n".join(format_report(report)))
    if usable:
        return errors.Exit.DONE
    print(
        f"calibrate: rejected; {options.out} is not written, the old geometry remains in use",
        file=sys.stderr,
    )
    return errors.Exit.REJECTED


def _make_progress_line() -> Any:
    """A line that counts, on a terminal only."""
    if not sys.stderr.isatty():
        return None
    return lambda count, change: print(f"step {count}: {change:.2g} sigma", file=sys.stderr)
