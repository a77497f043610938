"""Parts of the page: the holds of a fleet, the runs with their reports and timelines, the newest tuning session."""

import asyncio
import math
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from nicegui import ui

from membrane_ctrl.model import errors
from membrane_ctrl.review import catalogue
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.sessions.live_log import LiveReader
from membrane_ctrl.web.access import WebUser, outranks
from membrane_ctrl.web.feed import HoldFeed
from membrane_ctrl.web.figures import sparkline

_POINTS = 80
_MOST = 200  # runs in the table, newest first
REPORT = "report.html"
_LOOK_S = 1.0


def alarms_of(status: Mapping[str, Any]) -> str:
    """The fault, the maintenance notices and what the recording lacks, in one line."""
    fault = status.get("fault")
    lines = [f"FAULT {fault['code']} {fault['name']}: {fault['cause']}; {fault['remedy']}"] if fault else []
    lines += [str(each) for part in ("maintenance", "recording") for each in status.get(part, {}).values()]
    return "; ".join(lines)


def fleet_rows(feeds: Mapping[str, HoldFeed]) -> list[dict[str, object]]:
    """A row of the fleet's table for each hold."""
    rows: list[dict[str, object]] = []
    for name, feed in feeds.items():
        seen = feed.seen
        if seen.silent:
            rows.append({"hold": name, "state": "no contact", "error": None, "says": seen.silent})
            continue
        error_um = (seen.status.get("row") or {}).get("error_um")
        says = alarms_of(seen.status) or seen.status.get("why") or "as it should be"
        error = None if error_um is None else round(error_um, 2)
        rows.append({"hold": name, "state": seen.status.get("state"), "error": error, "says": says})
    return rows


def fleet_panel(feeds: Mapping[str, HoldFeed]) -> None:
    """The table of all holds; a click on a name opens its page."""
    labels = {"hold": "mirror", "state": "state", "error": "error, um", "says": "alarms, or why"}
    columns = [{"name": key, "label": label, "field": key, "align": "left"} for key, label in labels.items()]
    table = ui.table(columns=columns, rows=fleet_rows(feeds), row_key="hold").classes("w-full").props("dense")
    link = '<a class="underline" :href="\'/?hold=\' + encodeURIComponent(props.value)">{{ props.value }}</a>'
    table.add_slot("body-cell-hold", f'<q-td :props="props">{link}</q-td>')

    def look() -> None:
        rows = fleet_rows(feeds)
        if rows != table.rows:
            table.rows = rows
            table.update()

    ui.timer(_LOOK_S, look)


@dataclass(frozen=True, slots=True)
class RunLine:
    """A run's line of the table."""

    entry: catalogue.RunEntry
    picture: str  # its error over time, as SVG


def run_lines(logs: Path) -> list[RunLine]:
    """The runs of a folder, newest first."""
    if not logs.is_dir():
        return []
    entries = sorted(catalogue.entries(logs), key=lambda entry: entry.started_utc, reverse=True)[:_MOST]
    return [RunLine(entry, _picture(entry.folder, entry.exit != "open" and entry.duration_s)) for entry in entries]


@lru_cache(maxsize=4 * _MOST)
def _picture(folder: Path, ended: float | bool) -> str:
    """The error over the run; kept for runs that have ended, which no longer change."""
    try:
        level = open_run(folder).level(60.0, names=("mean_error_um",))
    except (OSError, ValueError):
        return ""
    values = level["mean_error_um"]
    if values.size > _POINTS:
        values = np.array([part.mean() for part in np.array_split(values, _POINTS)])
    return sparkline(values)


def run_folder(logs: Path, name: str) -> Path | None:
    """The folder of a run in `logs`; None for what is not a name: it comes from a browser."""
    return logs / name if name and name == Path(name).name and not name.startswith(".") else None


def report_problem(folder: Path, user: WebUser) -> str:
    """Write the run's report if there is none; returns why there is none, or an empty text."""
    if (folder / REPORT).exists():
        return ""
    if not outranks(user.role, "operate"):
        return f"{folder.name}: no report yet; writing one needs the role operate"
    return _command("report", str(folder))


def runs_panel(logs: Path, hold: str, user: WebUser, utc: Callable[[], bool]) -> None:
    """Fill the tab."""
    columns = [
        {"name": name, "label": label, "field": name, "sortable": True, "align": "left"}
        for name, label in (
            ("run", "run"), ("started", "started"), ("hours", "h"), ("std", "std, um"), ("faults", "faults"),
            ("exit", "end"), ("marks", "marks"), ("error", "error"),
        )
    ]  # fmt: skip
    table = ui.table(columns=columns, rows=[], row_key="run", selection="single", pagination=20).classes("w-full")
    table.add_slot("body-cell-error", '<q-td :props="props"><span v-html="props.value"></span></q-td>')

    async def load() -> None:
        table.rows = [_cells(line, utc()) for line in await asyncio.to_thread(run_lines, logs)]
        table.update()

    def chosen() -> Path | None:
        if not table.selected:
            ui.notify("Select a run first.")
            return None
        return run_folder(logs, str(table.selected[0]["run"]))

    async def report() -> None:
        folder = chosen()
        if folder is None:
            return
        if not (folder / REPORT).exists():
            ui.notify("Writing the report.")
        if said := await asyncio.to_thread(report_problem, folder, user):
            ui.notify(said, type="negative", timeout=10_000)
            return
        ui.navigate.to(f"/report/{folder.name}?hold={quote(hold)}", new_tab=True)

    async def review() -> None:
        folder = chosen()
        if folder is not None:
            ui.clipboard.write(f"membrane-ctrl review {folder}")
            ui.notify("Copied the command that opens this run in Rerun; run it on your desktop.")

    with ui.row():
        ui.button("Refresh", icon="refresh", on_click=load).props("flat")
        ui.button("Report", icon="description", on_click=report).props("flat")
        ui.button("Open in Rerun", icon="timeline", on_click=review).props("flat")
    ui.timer(0.1, load, once=True)


def _cells(line: RunLine, utc: bool) -> dict[str, object]:
    entry = line.entry
    started = entry.started_utc if utc else entry.started_utc.astimezone()
    return {
        "run": entry.name,
        "started": f"{started:%Y-%m-%d %H:%M}",
        "hours": _rounded(entry.duration_s / 3600, 2),
        "std": _rounded(entry.std_um, 3),
        "faults": entry.faults,
        "exit": entry.exit,
        "marks": entry.marks,
        "error": line.picture,
    }


def _rounded(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _command(*arguments: str) -> str:
    """Run one of our own commands; returns its last line if it failed."""
    done = subprocess.run(
        [sys.executable, "-m", "membrane_ctrl", *arguments], capture_output=True, text=True, check=False
    )
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["it failed"])[-1]


def tuning_panel(logs: Path) -> None:
    """Fill the tab."""
    head = ui.label("No tuning session in this folder.").classes("text-subtitle1")
    steps = ui.row()
    said = ui.log(max_lines=200).classes("w-full h-64")
    known: dict[str, object] = {"path": None, "reader": None, "said": 0, "step": ""}

    def look() -> None:
        newest = _newest(logs)
        if newest is None:
            return
        if known["path"] != newest.path:
            known.update(path=newest.path, reader=LiveReader(newest.path), said=0)
            said.clear()
        reader = known["reader"]
        assert isinstance(reader, LiveReader)
        reader.read()
        progress = reader.progress
        done = {step for step in folders.STEPS if newest.done(step)}
        head.set_text(
            f"{newest.path.name}: {progress.step or 'begun'}"
            + (f", asks on its terminal: {progress.asks}" if progress.asks else "")
            + (f", ended: {progress.ended}" if progress.ended else "")
        )
        for line in progress.said[int(str(known["said"])) :]:
            said.push(line)
        known["said"] = len(progress.said)
        shown = f"{progress.step} {sorted(done)}"
        if shown != known["step"]:
            known["step"] = shown
            steps.clear()
            with steps:
                for step in folders.STEPS:
                    colour = "positive" if step in done else "info" if step == progress.step else "grey"
                    ui.badge(step, color=colour)

    ui.timer(_LOOK_S, look)


def _newest(logs: Path) -> folders.SessionFolder | None:
    try:
        return folders.newest_session(logs)
    except (errors.CommandError, OSError):
        return None
