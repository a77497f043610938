"""The tab of the runs, with their reports and timelines."""

import math
import subprocess
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from urllib.parse import quote

from nicegui import ui

from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.sparkline import render_sparkline
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.service.ended_run import REPORT_NAME
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import REPORTS, RUN_LISTS
from membrane_ctrl.web.messages import show_message

WRITES: Role = "operate"  # reports
_MOST = 200  # runs in the table, newest first
_CARD = """<div class="q-pa-xs col-12"><q-card flat bordered class="q-pa-sm">
<q-checkbox dense v-model="props.selected" :label="props.row.run" />
<div class="row justify-between q-mt-xs">
<span v-for="col in props.cols.filter(c => !['run', 'error'].includes(c.name))">
<span class="text-caption">{{ col.label }}</span> {{ col.value ?? '-' }}</span></div>
<span v-html="props.row.error"></span></q-card></div>"""  # a run on a phone, which has no room for the table  # noqa: E501


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
    """The folder of a run in `logs`.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    name : str
        From a browser: may be anything.

    Returns
    -------
    Path or None
        None for what is not a plain name, such as `../x` or a hidden folder. The folder itself need
        not exist.
    """
    return logs / name if name and name == Path(name).name and not name.startswith(".") else None


def report_problem(folder: Path, user: WebUser) -> str:
    """Write the run's report if there is none; returns why there is none, or an empty text.

    Takes seconds: called on the pool `REPORTS`.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    user : WebUser
        All may read a report; writing one needs the role `WRITES`.
    """
    if (folder / REPORT_NAME).exists():
        return ""
    if not role_includes(user.role, WRITES):
        return f"{folder.name}: no report yet; writing one needs the role {WRITES}"
    return _command("report", str(folder))


async def open_report(folder: Path, hold: str, user: WebUser) -> None:
    """Open a run's report in a new tab of the viewer; write it before if there is none.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    hold : str
        Name of the hold on the page: its folder of runs is looked up again for the address.
    user : WebUser
        Decides whether a missing report may be written.
    """
    if not (folder / REPORT_NAME).exists() and role_includes(user.role, WRITES):
        show_message("Writing the report.")
    try:
        problem = await REPORTS.run(report_problem, folder, user)
    except PoolFullError as error:
        problem = str(error)
    if problem:
        show_message(problem, good=False)
        return
    ui.navigate.to(f"/report/{folder.name}?hold={quote(hold)}", new_tab=True)


def runs_panel(
    logs: Path, hold: str, user: WebUser, utc: Callable[[], bool]
) -> Callable[[], Awaitable[None]]:
    """Fill the tab; returns the function that lists the runs again.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    hold : str
        Name of the hold on the page, for the addresses of the reports.
    user : WebUser
        Decides whether a missing report may be written.
    utc : callable
        Whether this viewer reads times in UTC; else in the time zone of the service.
    """
    # A table of runs; a narrow window shows each run as a card.
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
    table.add_slot(
        "body-selection", '<q-checkbox v-model="props.selected" :aria-label="props.row.run" />'
    )
    table.add_slot("item", _CARD)
    table.add_slot("no-data", '<span class="q-pa-sm">{{ props.message }}</span>')

    async def load() -> None:
        table.rows = [_cells(line, utc()) for line in await RUN_LISTS.run(run_lines, logs)]
        table.props('no-data-label="no runs in this folder"')
        table.update()

    def chosen() -> Path | None:
        if not table.selected:
            show_message("Select a run first.")
            return None
        return run_folder(logs, str(table.selected[0]["run"]))

    async def report() -> None:
        folder = chosen()
        if folder is not None:
            await open_report(folder, hold, user)

    async def review() -> None:
        folder = chosen()
        if folder is not None:
            ui.clipboard.write(f"membrane-ctrl review {folder}")
            show_message("Copied the command that opens this run in Rerun; run it on your desktop.")

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
        "hours": _round_finite(entry.duration_s / 3600, 2),
        "std": _round_finite(entry.std_um, 3),
        "faults": entry.faults,
        "exit": entry.exit,
        "marks": entry.marks,
        "error": line.picture,
    }


def _round_finite(value: float, digits: int) -> float | None:
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
