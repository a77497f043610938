"""`membrane-ctrl report RUN`: the page, the JSON beside it, and the verdict on the terminal."""

import sys
import time
from dataclasses import asdict
from pathlib import Path

from membrane_ctrl.model import errors, files, plain_json
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.report.json import make_verdict, report_table
from membrane_ctrl.review.report.pump_history import explain_pump_change, pump_history
from membrane_ctrl.review.report.run_page import render_report
from membrane_ctrl.review.run_times import is_from_start, part_s
from membrane_ctrl.review.statistics import compare
from membrane_ctrl.review.statistics.analysis import Analysis, analyse_run
from membrane_ctrl.run_files.run import Run, open_run

# A terminal shows no more at once; the page has them all.
_SHOWN_MOST = 20


def report_command(
    run: Path,
    out: Path | None,
    compare_with: Path | None,
    start: str | None,
    end: str | None,
    json: bool,
) -> int:
    """Write `report.html` and `report.json` of a run, and print its main figures.

    Parameters
    ----------
    run : Path
        A run's folder, its name or a part of it, or `last`.
    out : Path or None
        Folder of the report; None: `report` in the run's folder.
    compare_with : Path or None
        Another run, given as `run` is, to list the differences from.
    start, end : str or None
        Part of the run, as a person writes times (`run_times.moment_s`); None: unlimited.
    json : bool
        Print the content of `report.json` instead.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    CommandError
        A run cannot be read or has no data in this part, or the report cannot be written.
    """
    began_s = time.monotonic()
    opened = open_run(catalogue.resolve_run(run))
    analysis = analyse_run(opened, *part_s(opened.origin_utc, start, end))
    other = None
    if compare_with is not None:
        other = _open_other(open_run(catalogue.resolve_run(compare_with)), start, end)
    differences = []
    if other is not None:
        differences = compare.compare_analyses(analysis, other)
    history = pump_history(opened.folder)
    table = report_table(analysis) | {"pump_over_runs": [asdict(seen) for seen in history]}
    if other is not None:
        table["compared_with"] = {
            "run": other.run.name,
            "whole_run": not other.is_part,
            "report": report_table(other),
            "differences": [
                asdict(difference) | {"verdict": difference.verdict_text}
                for difference in differences
            ],
        }
    folder = out.resolve() if out else opened.folder / "report"  # follow a link that the user names
    text = plain_json.dumps(table, indent=1)
    page = render_report(analysis, other, differences, history)
    with errors.convert_write_errors(
        folder, errors.DeviceError, "; choose another folder with --out"
    ):
        write_report(folder, text, page)
    if json:
        print(text)
        return 0
    _print_result(analysis, other, folder, time.monotonic() - began_s)
    if warning := explain_pump_change(history, opened.config.pump.change_max):
        print(f"note: {warning}", file=sys.stderr)
    return 0


def write_report(folder: Path, text: str, page: str) -> None:
    """Write a report into a folder, which is made if it does not exist.

    Parameters
    ----------
    folder : Path
        Of `report.json` and `report.html`; both are replaced.
    text : str
        JSON, without a line feed at its end.
    page : str
        The whole HTML page.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    files.make_folder(folder)
    files.write_text_atomic(folder / "report.json", text + "\n")
    files.write_text_atomic(folder / "report.html", page)


def _open_other(run: Run, start: str | None, end: str | None) -> Analysis:
    """The run to compare with: the same part if counted from the start, else all, as times of day
    differ.
    """
    if all(text is None or is_from_start(text) for text in (start, end)):
        return analyse_run(run, *part_s(run.origin_utc, start, end))
    return analyse_run(run)


def _print_result(analysis: Analysis, other: Analysis | None, folder: Path, took_s: float) -> None:
    for note in analysis.run.notes:
        print(f"note: {note}", file=sys.stderr)
    print(make_verdict(analysis)[1])
    for event in analysis.found[:_SHOWN_MOST]:
        print(
            f"  {analysis.run.utc(event.time_s):%Y-%m-%d %H:%M:%S}  {event.kind}, "
            f"{event.size:.3g} {event.unit}"
        )
    if len(analysis.found) > _SHOWN_MOST:
        print(f"  and {len(analysis.found) - _SHOWN_MOST} more in the report")
    if other is not None:
        part = ""
        if analysis.is_part:
            part = ", same part" if other.is_part else ", all of it"
        print(f"against {other.run.name}{part}: {make_verdict(other)[1]}")
    print(f"{folder / 'report.html'} ({took_s:.1f} s)")
