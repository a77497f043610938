"""`membrane-ctrl report RUN`: the page, the JSON beside it, and the verdict on the terminal."""

import sys
import time
from dataclasses import asdict
from pathlib import Path

from membrane_ctrl.model import errors, plain_json
from membrane_ctrl.model.files import make_folder, write_text_atomic
from membrane_ctrl.review import catalogue, words
from membrane_ctrl.review.report.html import render
from membrane_ctrl.review.report.json import report_table, verdict
from membrane_ctrl.review.statistics.analysis import Analysis, analyse
from membrane_ctrl.review.statistics.compare import compare
from membrane_ctrl.run_files.run import Run, open_run

# A terminal shows no more at once; the page has all of them.
_LINES_MOST = 20


def report_command(
    run: Path,
    out: Path | None,
    compare_with: Path | None,
    start: str | None,
    end: str | None,
    json: bool,
) -> int:
    """Write `report.html` and `report.json`; see `membrane-ctrl report --help`."""
    began_s = time.monotonic()
    opened = open_run(catalogue.resolve(run))
    analysis = analyse(opened, *words.part_s(opened, start, end))
    other = None if compare_with is None else _other(open_run(catalogue.resolve(compare_with)), start, end)
    differences = [] if other is None else compare(analysis, other)
    table = report_table(analysis)
    if other is not None:
        table["compared_with"] = {
            "run": other.run.name,
            "whole_run": not other.is_part,
            "report": report_table(other),
            "differences": [asdict(difference) | {"said": difference.said} for difference in differences],
        }
    folder = out.resolve() if out else opened.folder / "report"  # a link that a person names is meant
    text = plain_json.dumps(table, indent=1)
    _write(folder, {"report.json": text + "\n", "report.html": render(analysis, other, differences)})
    if json:
        print(text)
    else:
        _say(analysis, other, folder, time.monotonic() - began_s)
    return 0


def _other(run: Run, start: str | None, end: str | None) -> Analysis:
    """The run to compare with: its same part if that counts from the start, else all, for times of day differ."""
    from_start = all(text is None or text.strip().startswith("+") for text in (start, end))
    return analyse(run, *words.part_s(run, start, end)) if from_start else analyse(run)


def _write(folder: Path, files: dict[str, str]) -> None:
    with errors.writing(folder, errors.DeviceError, "; choose another folder with --out"):
        make_folder(folder)
        for name, text in files.items():
            write_text_atomic(folder / name, text)


def _say(analysis: Analysis, other: Analysis | None, folder: Path, took_s: float) -> None:
    for note in analysis.run.notes:
        print(f"note: {note}", file=sys.stderr)
    print(verdict(analysis)[1])
    for event in analysis.found[:_LINES_MOST]:
        print(f"  {analysis.run.utc(event.time_s):%Y-%m-%d %H:%M:%S}  {event.kind}, {event.size:.3g} {event.unit}")
    if len(analysis.found) > _LINES_MOST:
        print(f"  and {len(analysis.found) - _LINES_MOST} more in the report")
    if other is not None:
        part = "" if not analysis.is_part else ", same part" if other.is_part else ", all of it"
        print(f"against {other.run.name}{part}: {verdict(other)[1]}")
    print(f"{folder / 'report.html'} ({took_s:.1f} s)")
