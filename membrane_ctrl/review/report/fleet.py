"""The report of many runs, `report --fleet`: a page with a line for each, and each run's own report
beside it.
"""

import math
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from membrane_ctrl.model import (
    errors,
    events,
    files,
    plain_json,
    port_events,
    program,
    terminal,
)
from membrane_ctrl.processes.worker_pool import run_jobs
from membrane_ctrl.report_pages.blocks import PageSection, PageTable, PageText, ReportPage
from membrane_ctrl.report_pages.render import render_page
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.formatting import format_number, format_span, format_time_beside
from membrane_ctrl.review.report.command import write_report
from membrane_ctrl.review.report.json import make_timeline, report_table
from membrane_ctrl.review.report.pump_history import pump_history
from membrane_ctrl.review.report.run_page import MARKS, render_report
from membrane_ctrl.review.run_times import part_s
from membrane_ctrl.review.sparkline import render_sparkline
from membrane_ctrl.review.statistics.analysis import Analysis, analyse_run
from membrane_ctrl.run_files.run import open_run

SCHEMA = "membrane-fleet-report/1"
_SAME = (
    "run",
    "started_utc",
    "duration_s",
    "settled_s",
    "faults_s",
    "paused_s",
    "moving_s",
    "ticks_missed",
    "band_um",
    "verdict",
    "sentence",
    "exit",
)
_LINK = Markup("<a href='{address}'>{name}</a>")
_NOT_REPORTED = Markup("<b>not reported</b>")
_HEAD = (
    "run",
    "started, UTC",
    "error",
    "state",
    "held",
    "std µm",
    "mean µm",
    "in band",
    "faults",
    "alarms",
    "events",
    "ticks missed",
    "check",
)


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """Options of the command."""

    runs: Sequence[Path]  # runs, or folders of runs
    out: Path
    start: str | None
    end: str | None
    workers: int | None
    scheduler: str | None
    as_json: bool


@dataclass(frozen=True, slots=True)
class RunReport:
    """A run's own report, and its line of the fleet's page."""

    entry: dict[str, Any]  # with a `problem` instead of figures, if it cannot be reported
    text: str = ""  # report.json
    page: str = ""  # report.html
    curve: str = ""  # the error as a small SVG line


def run_report(start: str | None, end: str | None, folder: Path) -> RunReport:
    """Analyse one run of a fleet; a job of the worker pool.

    Parameters
    ----------
    start, end : str or None
        Part of the run, as a person writes times (`run_times.moment_s`); None: unlimited.
    folder : Path
        The run.

    Returns
    -------
    RunReport
        If the run cannot be reported, for whatever reason, its entry has only `problem`.
    """
    try:
        run = open_run(folder)
        analysis = analyse_run(run, *part_s(run.origin_utc, start, end))
        history = pump_history(folder)
        table = report_table(analysis) | {"pump_over_runs": [asdict(seen) for seen in history]}
        text = plain_json.dumps(table, indent=1)
        curve = render_sparkline(analysis.level["mean_error_um"])
        return RunReport(
            _make_fleet_entry(analysis, table),
            text,
            render_report(analysis, history=history),
            curve,
        )
    except errors.CommandError as error:
        return RunReport({"problem": "; ".join(error.lines).removeprefix(f"{folder}: ")})
    except Exception as error:  # one strange folder must not end the reports of the others
        return RunReport({"problem": f"cannot be reported: {type(error).__name__}: {error}"})


def _make_fleet_entry(analysis: Analysis, table: dict[str, Any]) -> dict[str, Any]:
    """The figures of the run's own report that the fleet's page shows, and the names in its event
    log.
    """
    series = table["true"] or table["reading"]
    seconds = series["windows"][0] if series else {}
    log = [each.event for each in analysis.run.log]
    states = [event.state for event in log if isinstance(event, events.StateEntered)]
    alarms = {
        event.alarm
        for event in log
        if isinstance(event, port_events.AlarmSent) and event.what == "raised"
    }
    timeline = [each.event for each in make_timeline(analysis)]
    return {
        **{name: table[name] for name in _SAME},
        **{name: seconds.get(name) for name in ("mean_um", "std_um", "in_band")},
        "of": "true centre" if table["true"] else "reading",
        "state": states[-1] if states else "",
        "faults": [event.name for event in timeline if isinstance(event, events.Fault)],
        "alarms": sorted(alarms),
        "found": len(table["found"]),
        "anomalies": [anomaly["name"] for anomaly in table["anomalies"]],
    }


def list_fleet_folders(given: Sequence[Path]) -> list[Path]:
    """The runs that are named, or lie in a named folder, each once; a folder without a run
    is listed itself.
    """
    found: list[Path] = []
    for each in given:
        folder = catalogue.resolve_run(each).resolve()
        inside = []
        if folder.is_dir() and not catalogue.may_be_run(folder):
            with suppress(OSError):  # its line will show it
                inside = catalogue.list_run_folders(folder)
        found += inside or [folder]
    return list(dict.fromkeys(found))


def fleet_command(options: FleetOptions) -> int:
    """Write the fleet's page, its figures as JSON, and each run's report; see `membrane-ctrl report
    --help`.
    """
    folders = list_fleet_folders(options.runs)
    out = options.out.resolve()
    # Runs are named by their path below the folder that all have in common.
    common = Path(os.path.commonpath([folder.parent for folder in folders]))
    workers = options.workers or min(os.cpu_count() or 1, len(folders))
    job = partial(run_report, options.start, options.end)
    rows = []
    entries = []
    # Runs are reported in parallel; one that cannot be is an entry with its problem.
    with (
        errors.convert_write_errors(out, errors.DeviceError, "; choose another folder with --out"),
        run_jobs(job, folders, workers, options.scheduler) as results,
    ):
        counted = terminal.track_progress(results, "runs", len(folders))
        for folder, report in zip(folders, counted, strict=True):
            name = folder.relative_to(common)
            entry = {"name": str(name), "mirror": folder.parent.name} | report.entry
            if "problem" not in entry:
                entry["report"] = str(name / "report.html")
                write_report(out / name, report.text, report.page)
            entries.append(entry)
            rows.append(_make_row(entry, report.curve))
        # Refuse only if no run could be reported.
        if all("problem" in entry for entry in entries):
            raise errors.FindingsError(
                [f"{entry['name']}: {entry['problem']}" for entry in entries]
            )
        text = plain_json.dumps({**program.file_origin(SCHEMA), "runs": entries}, indent=1)
        files.make_folder(out)
        files.write_text_atomic(out / "fleet.json", text + "\n")
        files.write_text_atomic(out / "fleet.html", _make_page(entries, rows))
    if options.as_json:
        print(text)
    else:
        for entry in entries:
            print(
                terminal.one_line(f"{entry['name']}: {entry.get('sentence') or entry['problem']}")
            )
        print(out / "fleet.html")
    return errors.Exit.DONE


def _make_row(entry: dict[str, Any], curve: str) -> list[str]:
    """Return the cells of a run's line, in the order of `_HEAD`."""
    if "problem" in entry:
        cells = [entry["name"], "", "", _NOT_REPORTED, entry["problem"]]
        return cells + [""] * (len(_HEAD) - len(cells))
    # How long the mirror was held, and what the rest of the time was.
    in_band = "–"
    if entry["in_band"] is not None and math.isfinite(entry["in_band"]):
        in_band = f"{100 * entry['in_band']:.4g} %"
    held = f"{format_span(entry['settled_s'])} of {format_span(entry['duration_s'])}"
    not_held = format_time_beside(
        entry["faults_s"], entry["paused_s"], entry["moving_s"], entry["duration_s"]
    )
    if not_held:
        held += f" ({', '.join(not_held)})"
    faults = "0"
    if entry["faults"]:
        names = ", ".join(dict.fromkeys(entry["faults"]))
        faults = f"{len(entry['faults'])}: {names}"
    return [
        _LINK.format(address=quote(entry["report"]), name=entry["name"]),
        f"{datetime.fromisoformat(entry['started_utc']):%Y-%m-%d %H:%M}",
        Markup(curve),
        f"{entry['state']}, {entry['exit'] or 'open'}",
        held,
        format_number(entry["std_um"]),
        format_number(entry["mean_um"]),
        in_band,
        faults,
        ", ".join(entry["alarms"]) or "none",
        str(entry["found"]),
        str(entry["ticks_missed"]),
        ", ".join(dict.fromkeys(entry["anomalies"])) or "nothing unusual",
    ]


def _make_page(entries: Sequence[dict[str, Any]], rows: Sequence[Sequence[str]]) -> str:
    failed = sum("problem" in entry for entry in entries)
    unusual = sum(entry.get("verdict") in ("look", "bad") for entry in entries)
    word = "good"
    if unusual:
        word = "look"
    if failed:
        word = "bad"
    sentence = f"{len(entries)} runs: {unusual} to look at, {failed} cannot be reported."
    section = PageSection("", [PageText(sentence, MARKS[word]), PageTable(_HEAD, rows)])
    return render_page(ReportPage("Fleet", [section], wide=True))
