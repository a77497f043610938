"""Parts of the page: the holds of a fleet, the runs with their reports and timelines, the newest tuning session."""  # noqa: E501

import math
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from nicegui import ui

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.status import alarm_lines
from membrane_ctrl.controller.commands import Role
from membrane_ctrl.model import errors
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.sparkline import render_sparkline
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.service.access import WebUser, outranks
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.work_pools import ANSWERS, REPORTS, RUN_LISTS, PoolFullError
from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.sessions.live_log import ANSWER, LiveReader, PageAnswer, Progressed, give_answer

_MOST = 200  # runs in the table, newest first
REPORT = "report.html"
_LOOK_S, _TAKES = 1.0, 5  # looks until a session that asks has taken an answer
_CARD = """<div class="q-pa-xs col-12"><q-card flat bordered class="q-pa-sm">
<q-checkbox dense v-model="props.selected" :label="props.row.run" />
<div class="row justify-between q-mt-xs">
<span v-for="col in props.cols.filter(c => !['run', 'error'].includes(c.name))">
<span class="text-caption">{{ col.label }}</span> {{ col.value ?? '-' }}</span></div>
<span v-html="props.row.error"></span></q-card></div>"""  # a run on a phone, which has no room for the table  # noqa: E501
CHOOSES: Role = "tune"  # as for `ctl gains`


def tell(text: str, good: bool | None = None) -> None:
    """Show the viewer a message for some seconds, away from the stop button."""
    kind: Literal["positive", "negative"] | None = (
        None if good is None else "positive" if good else "negative"
    )
    ui.notify(text, type=kind, position="top", timeout=5000 if good is None else 8000)


def fleet_rows(feeds: Mapping[str, HoldFeed]) -> list[dict[str, object]]:
    """A row of the fleet's table for each hold."""
    rows: list[dict[str, object]] = []
    for name, feed in feeds.items():
        seen = feed.seen
        if seen.silent:
            rows.append({"hold": name, "state": "no contact", "error": None, "says": seen.silent})
            continue
        error_um = (seen.status.get("row") or {}).get("error_um")
        says = "; ".join(alarm_lines(seen.status)) or seen.status.get("why") or "as it should be"
        error = None if error_um is None else round(error_um, 2)
        rows.append({"hold": name, "state": seen.status.get("state"), "error": error, "says": says})
    return rows


def fleet_panel(feeds: Mapping[str, HoldFeed]) -> None:
    """The table of all holds; a click on a name opens its page."""
    labels = {
        "hold": "mirror",
        "state": "state",
        "error": COLUMNS["error_um"].title,
        "says": "alarms, or why",
    }
    columns = [
        {"name": key, "label": label, "field": key, "align": "left"}
        for key, label in labels.items()
    ]
    table = (
        ui.table(columns=columns, rows=fleet_rows(feeds), row_key="hold")
        .classes("w-full")
        .props("dense")
    )
    link = '<a class="underline" :href="\'?hold=\' + encodeURIComponent(props.value)">{{ props.value }}</a>'  # noqa: E501
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
    entries = sorted(
        catalogue.list_entries(logs), key=lambda entry: entry.started_utc, reverse=True
    )[:_MOST]
    return [
        RunLine(entry, _picture(entry.folder, entry.exit != "open" and entry.duration_s))
        for entry in entries
    ]


@lru_cache(maxsize=4 * _MOST)
def _picture(folder: Path, ended: float | bool) -> str:
    """The error over the run; kept for runs that have ended, which no longer change."""
    with suppress(OSError, ValueError):
        return render_sparkline(
            open_run(folder).level(60.0, names=("mean_error_um",))["mean_error_um"]
        )
    return ""


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


def runs_panel(
    logs: Path, hold: str, user: WebUser, utc: Callable[[], bool]
) -> Callable[[], Awaitable[None]]:
    """Fill the tab; returns what reads the runs anew."""
    columns = [
        {"name": name, "label": label, "field": name, "sortable": True, "align": "left"}
        for name, label in (
            ("run", "run"),
            ("started", "started"),
            ("hours", "h"),
            ("std", "std, µm"),
            ("faults", "faults"),
            ("exit", "end"),
            ("marks", "marks"),
            ("error", "error"),
        )
    ]
    table = ui.table(
        columns=columns, rows=[], row_key="run", selection="single", pagination=20
    ).classes("w-full")
    table.props(':grid="window.innerWidth < 700" no-data-label="reading the runs"')
    table.add_slot(
        "body-cell-error", '<q-td :props="props"><span v-html="props.value"></span></q-td>'
    )
    table.add_slot("item", _CARD)
    table.add_slot("no-data", '<span class="q-pa-sm">{{ props.message }}</span>')

    async def load() -> None:
        table.rows = [_cells(line, utc()) for line in await RUN_LISTS.run(run_lines, logs)]
        table.props('no-data-label="no runs in this folder"')
        table.update()

    def chosen() -> Path | None:
        if not table.selected:
            tell("Select a run first.")
            return None
        return run_folder(logs, str(table.selected[0]["run"]))

    async def report() -> None:
        folder = chosen()
        if folder is None:
            return
        if not (folder / REPORT).exists():
            tell("Writing the report.")
        try:
            said = await REPORTS.run(report_problem, folder, user)
        except PoolFullError as error:
            said = str(error)
        if said:
            tell(said, good=False)
            return
        ui.navigate.to(f"/report/{folder.name}?hold={quote(hold)}", new_tab=True)

    async def review() -> None:
        folder = chosen()
        if folder is not None:
            ui.clipboard.write(f"membrane-ctrl review {folder}")
            tell("Copied the command that opens this run in Rerun; run it on your desktop.")

    with ui.row():
        ui.button("Refresh", icon="refresh", on_click=load, color=None).props("flat")
        ui.button("Report", icon="description", on_click=report, color=None).props("flat")
        ui.button("Open in Rerun", icon="timeline", on_click=review, color=None).props("flat")
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
        [sys.executable, "-m", "membrane_ctrl", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["it failed"])[-1]


@dataclass(frozen=True, slots=True)
class SessionSeen:
    """The newest tuning session at one moment."""

    path: Path
    done: frozenset[str]  # its steps
    progress: Progressed
    candidates: tuple[
        tuple[str, ...], ...
    ] = ()  # their table, its head first, while the session waits for a choice

    @property
    def head(self) -> str:
        """Where it is, in a line."""
        step, asks, ended = self.progress.step, self.progress.asks, self.progress.ended
        words = (step or "begun", asks and f"asks: {asks}", ended and f"ended: {ended}")
        return f"{self.path.name}: {', '.join(filter(None, words))}"


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
        self._reader.read_new()
        done = frozenset(step for step in folders.STEPS if newest.is_done(step))
        progress = self._reader.progress
        with suppress(errors.InputError):
            if progress.among:
                return SessionSeen(newest.path, done, progress, _table(newest.read_candidates()))
        return SessionSeen(newest.path, done, progress)


def _table(markdown: str) -> tuple[tuple[str, ...], ...]:
    """The cells of a Markdown table, without its rule."""
    head, _, *rows = (
        tuple(map(str.strip, line.strip("| ").split("|"))) for line in markdown.splitlines()
    )
    return head, *(row for row in rows if len(row) == len(head))


def answered(session: Path, question: str, given: PageAnswer) -> Outcome:
    """Give a session an answer; returns what became of it."""
    what = given.said or "none of them"
    try:
        give_answer(session, question, given)
    except OSError as error:
        return Outcome.failed(what, f"not given: {errors.os_reason(error)}")
    for _ in range(_TAKES):
        if not (session / ANSWER).exists():
            return Outcome.succeeded(what)
        time.sleep(_LOOK_S)
    with suppress(OSError):
        (session / ANSWER).unlink()
    return Outcome.failed(what, "not taken: the session no longer asks; see its terminal")


def fresh(old: tuple[str, ...], new: tuple[str, ...]) -> tuple[str, ...]:
    """The lines of `new` after those of `old`, the first of which may have been dropped meanwhile."""  # noqa: E501
    return next(
        new[len(old) - gone :]
        for gone in range(len(old) + 1)
        if old[gone:] == new[: len(old) - gone]
    )


class TuningPanel:
    """The tab of the tuning session: its steps, what it has found, and the choice it waits for.

    `look` returns the session now, `may` whether the viewer may choose.
    """

    def __init__(
        self,
        look: Callable[[], Awaitable[SessionSeen | None]],
        user: WebUser,
        may: Callable[[], bool],
    ) -> None:
        self._look, self._user, self._may = look, user, may
        self._head = (
            ui.label("No tuning session in this folder.")
            .classes("text-subtitle1")
            .props('role="status"')
        )
        self._steps = ui.row()
        self._choice = ui.column().classes("w-full")
        self._said = ui.log(max_lines=200).classes("w-full h-64").props('aria-label="results"')
        self._said.set_visibility(False)
        self._buttons: list[ui.button] = []
        self._seen: SessionSeen | None = None
        ui.timer(_LOOK_S, self._show)

    async def _show(self) -> None:
        seen, before = await self._look(), self._seen
        for button in self._buttons:
            if button.enabled != self._may():
                button.set_enabled(self._may())
        if seen is None or seen == before:
            return
        self._seen = seen
        self._head.set_text(seen.head)
        self._said.set_visibility(True)
        if before is None or before.path != seen.path:
            self._said.clear()
            before = SessionSeen(seen.path, frozenset(), Progressed())
            self._show_steps(seen)
        for line in fresh(before.progress.said, seen.progress.said):
            self._said.push(line)
        if (before.done, before.progress.step) != (seen.done, seen.progress.step):
            self._show_steps(seen)
        if (before.progress.asks, before.progress.among) != (
            seen.progress.asks,
            seen.progress.among,
        ):
            self._show_choice(seen)

    def _show_steps(self, seen: SessionSeen) -> None:
        self._steps.clear()
        with self._steps:
            for step in folders.STEPS:
                colour = (
                    "positive"
                    if step in seen.done
                    else "info"
                    if step == seen.progress.step
                    else "grey"
                )
                ui.badge(step, color=colour)

    def _show_choice(self, seen: SessionSeen) -> None:
        self._choice.clear()
        self._buttons.clear()
        if not seen.progress.among:
            return
        with self._choice:
            ui.label(f"The session waits, here and on its terminal: {seen.progress.asks}").classes(
                "text-bold"
            )
            if seen.candidates:
                head, *rows = seen.candidates
                columns = [
                    {"name": name, "label": name, "field": name, "align": "left"} for name in head
                ]
                cells = [dict(zip(head, row, strict=True)) for row in rows]
                ui.table(columns=columns, rows=cells, row_key=head[0]).classes("w-full").props(
                    "dense"
                )
            with ui.row():
                for name in (*seen.progress.among, ""):
                    button = ui.button(
                        name or "none", on_click=lambda _, said=name: self._answer(seen, said)
                    )
                    button.props("no-caps" if name else "no-caps flat").tooltip(
                        f"needs the role {CHOOSES}"
                    )
                    button.set_enabled(self._may())
                    self._buttons.append(button)

    async def _answer(self, seen: SessionSeen, said: str) -> None:
        """Ask for a confirmation, answer, and say what became of it."""
        with ui.dialog() as dialog, ui.card():
            ui.label(f"{seen.progress.asks} {said or 'none'}").classes("text-h6")
            with ui.row():
                ui.button("Do it", on_click=lambda: dialog.submit("yes")).props(
                    "color=primary autofocus"
                )
                ui.button("Cancel", on_click=lambda: dialog.submit(""), color=None).props("flat")
        sure = await dialog
        if not dialog.is_deleted:  # with the viewer
            dialog.delete()
        if not sure or not self._may():
            return
        given = PageAnswer(said, self._user.name)
        outcome = await ANSWERS.run(answered, seen.path, seen.progress.asks, given)
        with self._steps:  # the button that was pressed is gone once the session has its answer
            tell(outcome.text, outcome.done)
