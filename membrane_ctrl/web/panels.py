"""Parts of the page: the holds of a fleet, the runs with their reports and timelines, the newest tuning session."""

import asyncio
import gzip
import json
import math
import subprocess
import sys
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import ui

from membrane_ctrl.model import errors
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.catalogue import sparkline
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.sessions.live_log import LiveReader, Progressed
from membrane_ctrl.web import figures
from membrane_ctrl.web.access import WebUser, outranks
from membrane_ctrl.web.feed import SPANS_S, HoldFeed, history

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
    return sparkline(level["mean_error_um"])


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


def runs_panel(logs: Path, hold: str, user: WebUser, utc: Callable[[], bool]) -> Callable[[], Awaitable[None]]:
    """Fill the tab; returns what reads the runs anew."""
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
    return load


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


@dataclass(frozen=True, slots=True)
class SessionSeen:
    """The newest tuning session at one moment."""

    name: str
    done: frozenset[str]  # its steps
    progress: Progressed

    @property
    def head(self) -> str:
        """Where it is, in a line."""
        step, asks, ended = self.progress.step, self.progress.asks, self.progress.ended
        words = (step or "begun", asks and f"asks on its terminal: {asks}", ended and f"ended: {ended}")
        return f"{self.name}: {', '.join(filter(None, words))}"


class SessionWatch:
    """Follows the newest tuning session in a folder of runs, for all viewers."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._reader: LiveReader | None = None

    def look(self) -> SessionSeen | None:
        """The session now; None if there is none."""
        try:
            newest = folders.newest_session(self._logs)
        except (errors.CommandError, OSError):
            return None
        if self._reader is None or self._reader.session != newest.path:
            self._reader = LiveReader(newest.path)
        self._reader.read()
        done = frozenset(step for step in folders.STEPS if newest.done(step))
        return SessionSeen(newest.path.name, done, self._reader.progress)


class SharedViews:
    """What all viewers of a hold see alike, made once: charts, maps, the tuning session.

    Browsers fetch charts and maps when they are ready, so that none pile up for a slow one.
    """

    def __init__(self, feeds: Mapping[str, HoldFeed]) -> None:
        self._feeds = feeds
        self.charts = figures.Shared(self._chart, life_s=1.0)
        self.maps = figures.Shared(self._map, life_s=60.0)
        watches = {name: SessionWatch(feed.logs) for name, feed in feeds.items() if feed.logs is not None}
        self.sessions = figures.Shared(lambda hold: watches[hold].look(), life_s=_LOOK_S)

    def _chart(self, hold: str, signal: str, span: str, utc: bool) -> bytes:
        """Options of the history chart, as JSON in gzip."""
        feed, span_s = self._feeds[hold], SPANS_S[span]
        options = figures.chart(signal, history(feed, feed.logs, signal, span_s), utc, span_s)
        return gzip.compress(json.dumps(options).encode(), 1)

    def _map(self, hold: str, removed: str, _time_s: float) -> figures.MapPicture:
        """The newest figure less some terms; a figure of another time is another map."""
        seen = self._feeds[hold].seen
        assert seen.figure is not None
        return figures.map_picture(seen.figure, seen.reference, figures.REMOVED[removed])


def fresh(old: tuple[str, ...], new: tuple[str, ...]) -> tuple[str, ...]:
    """The lines of `new` after those of `old`, the first of which may have been dropped meanwhile."""
    return next(new[len(old) - gone :] for gone in range(len(old) + 1) if old[gone:] == new[: len(old) - gone])


def tuning_panel(look: Callable[[], Awaitable[SessionSeen | None]]) -> None:
    """Fill the tab."""
    head = ui.label("No tuning session in this folder.").classes("text-subtitle1")
    steps = ui.row()
    said = ui.log(max_lines=200).classes("w-full h-64")
    shown: SessionSeen | None = None

    async def show() -> None:
        nonlocal shown
        seen, before = await look(), shown
        if seen is None or seen == before:
            return
        shown = seen
        head.set_text(seen.head)
        if before is None or before.name != seen.name:
            said.clear()
            before = None
        for line in fresh(before.progress.said if before else (), seen.progress.said):
            said.push(line)
        if before is None or (before.done, before.progress.step) != (seen.done, seen.progress.step):
            steps.clear()
            with steps:
                for step in folders.STEPS:
                    colour = "positive" if step in seen.done else "info" if step == seen.progress.step else "grey"
                    ui.badge(step, color=colour)

    ui.timer(_LOOK_S, show)
