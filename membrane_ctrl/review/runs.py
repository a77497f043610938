"""The commands `membrane-ctrl runs`: list, show and prune runs."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.table import Table

from membrane_ctrl.model import errors, events, plain_json, terminal
from membrane_ctrl.model.run_events import Ended, Mark
from membrane_ctrl.review import catalogue, prune
from membrane_ctrl.review.formatting import format_number, format_span, format_time_beside, one_line
from membrane_ctrl.run_files.held_error import HeldError, format_in_band, format_std_um
from membrane_ctrl.run_files.run import open_run


def list_command(
    logs: Sequence[Path], wanted: catalogue.Filter, since: str | None, until: str | None, json: bool
) -> int:
    """Print the table of runs, oldest first.

    Parameters
    ----------
    logs : sequence of Path
        Folders of runs.
    wanted : Filter
        Criteria of the runs to list; its times are replaced by `since` and `until`.
    since, until : str or None
        A run starts at or after the first and before the second: dates or times in ISO 8601, in UTC
        unless they state a zone; None: unlimited.
    json : bool
        Print a list of objects instead of a table.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    InputError
        A folder does not exist, or a text is no date.
    """
    wanted = replace(wanted, since_utc=_parse_day(since), until_utc=_parse_day(until))
    folders = {folder.resolve(): folder for folder in logs}  # each once
    found = [
        entry for folder in folders.values() for entry in catalogue.list_entries(folder, wanted)
    ]
    found.sort(key=lambda entry: entry.name)  # which begins with its start
    if json:
        print(plain_json.dumps([catalogue.as_dict(entry) for entry in found], indent=1))
    else:
        _make_console().print(_make_table(found))
    return 0


def show_command(run: Path, logs: Path, json: bool) -> int:
    """Print one run: its line of the catalogue, its states and faults, its missing parts.

    Parameters
    ----------
    run : Path
        A run's folder, its name or a part of it, or `last`.
    logs : Path
        Folder of the runs, below which a name is searched.
    json : bool
        Print one object instead of lines of text.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    InputError
        No run, or more than one, matches.
    """
    opened = open_run(catalogue.resolve_run(run, logs))
    opened.read_all_parts()
    entry = catalogue.read_entry(opened.folder)
    if json:
        table = catalogue.as_dict(entry) | {
            "recorded_by": opened.recorded_by,
            "notes": opened.notes,
            "summary": opened.summary,
        }
        print(plain_json.dumps(table, indent=1))
        return 0
    _make_console().print(_make_table([entry]))
    held = HeldError.from_table((opened.summary or {}).get("held") or {})
    if held.seconds:
        print(f"  {held.name}, 1 s means: {held.figures_text}; {held.in_band_text} in the band")
    if besides := format_time_beside(
        entry.faults_s, entry.paused_s, entry.moving_s, entry.duration_s
    ):
        print(f"  not counted as held: {', '.join(besides)}")
    if opened.recorded_by:
        print(f"  recorded by {one_line(opened.recorded_by)}")
    for each in opened.log:
        match each.event:
            case (
                events.StateEntered(state=words)
                | events.Fault(name=words)
                | Mark(text=words)
                | Ended(exit=words)
            ):
                print(
                    f"  {opened.utc(each.mono_s):%H:%M:%S}  {each.event.kind:6} {one_line(words)}"
                )
    for note in opened.notes:
        print(f"  note: {note}")
    return 0


def prune_command(
    logs: Path, keep_days: float | None, keep_gb: float | None, delete: bool, json: bool
) -> int:
    """List the runs that the retention rule would delete, or delete them.

    Parameters
    ----------
    logs : Path
        Folder of the runs.
    keep_days : float or None
        Largest age of a run; None: no limit.
    keep_gb : float or None
        Disk space of all runs, in 1e9 bytes; None: no limit.
    delete : bool
        Delete them; a run that cannot be deleted is named on stderr.
    json : bool
        Print one object instead of lines of text.

    Returns
    -------
    int
        `Exit.DEVICE_FAILED` if a run could not be deleted, else 0.

    Raises
    ------
    InputError
        There is no such folder, or neither limit.
    """
    expired = prune.to_prune(logs, datetime.now(UTC), keep_days, keep_gb)
    stay = prune.prune_runs([run for run, _ in expired]) if delete else {}
    expired = [(run, why) for run, why in expired if run.folder not in stay]
    if json:
        table = [
            {"name": run.folder.name, "size_bytes": run.size_bytes, "why": why}
            for run, why in expired
        ]
        print(plain_json.dumps({"deleted": delete, "runs": table}, indent=1))
    else:
        action = "deleted" if delete else "would delete"
        for run, why in expired:
            print(f"{action} {run.folder.name}, {run.size_bytes / 1e6:.0f} MB: {why}")
        freed_mb = sum(run.size_bytes for run, _ in expired) / 1e6
        hint = ""
        if expired and not delete:
            hint = "; --delete deletes them"
        print(f"{len(expired)} runs, {freed_mb:.0f} MB{hint}")
    for folder, why in stay.items():
        print(f"{folder}: cannot be deleted ({why}); check its permissions", file=sys.stderr)
    return errors.Exit.DEVICE_FAILED if stay else 0


def _parse_day(text: str | None) -> datetime | None:
    """A date or a time, in UTC."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise errors.InputError(f"date {text!r}: write 2026-11-21 or 2026-11-21T03:00") from None
    if moment.tzinfo:
        return moment
    return moment.replace(tzinfo=UTC)


def _make_console() -> Console:
    """A console as wide as the terminal or, for a file or pipe, the table."""
    return terminal.table_console(width=None if sys.stdout.isatty() else 170)


def _make_table(found: list[catalogue.RunEntry]) -> Table:
    """The table; runs of several folders have names from where these part."""
    common = ""
    if found:
        common = os.path.commonpath([entry.folder.parent for entry in found])
    table = Table(box=None, header_style="bold", pad_edge=False)
    text_columns = {"run", "started, UTC", "configuration", "end"}
    numbers = ("length", "held", "std µm", "in band", "faults", "Kp", "Ti")
    for title in ("run", "started, UTC", *numbers, "configuration", "MB", "end"):
        table.add_column(title, justify="left" if title in text_columns else "right")
    for entry in found:
        table.add_row(
            one_line(str(entry.folder.relative_to(common))),
            f"{entry.started_utc:%Y-%m-%d %H:%M}",
            format_span(entry.duration_s),
            format_span(entry.held_s),
            format_std_um(entry.std_um),
            format_in_band(entry.in_band),
            str(entry.faults),
            format_number(entry.kp_per_s),
            format_number(entry.ti_s),
            entry.configuration,
            f"{entry.size_mb:.1f}",
            _describe_end(entry),
        )
    return table


def _describe_end(entry: catalogue.RunEntry) -> str:
    """How a run ended, and what people noted of it."""
    end = one_line(entry.exit)
    if entry.ended_in:
        end += f" ({one_line(entry.ended_in)})"
    if entry.marks:
        end += f", {entry.marks} marked"
    if entry.kept:
        end += ", kept"
    return end
