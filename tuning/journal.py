"""`<logs>/tuning/journal.jsonl`: which gains were kept, reverted or rolled back."""

import json
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model import errors, files, plain_json, program, terminal
from membrane_ctrl.sessions import session_json
from tuning.identification import loop_figures

_FILE = "journal.jsonl"
_SCHEMA = "membrane-tuning-journal/1"
What = Literal["kept", "taken_back", "rolled_back", "saved"]


@dataclass(frozen=True, slots=True)
class Traded:
    """The name of a candidate, and the figures before and with it."""

    candidate: str
    before: loop_figures.LoopFigures
    after: loop_figures.LoopFigures

    @property
    def words(self) -> tuple[str, ...]:
        """Standard deviation in µm, load peak in µm, recovery in s, Ms: each before and after."""
        pairs = zip(astuple(self.before), astuple(self.after), (3, 2, 1, 2), strict=True)
        return tuple(
            f"{before:.{digits}f} -> {after:.{digits}f}" for before, after, digits in pairs
        )

    def __str__(self) -> str:
        std, peak, recovery, ms = self.words
        return f"std {std} µm, load peak {peak} µm, recovery {recovery} s, Ms {ms}"


@dataclass(frozen=True, slots=True)
class GainsEntry:
    """One line of the journal."""

    time_utc: str
    # "kept": verified; "taken_back": the verification failed; "rolled_back", "saved": by a person
    what: What
    session: str
    author: str
    reason: str
    before: LoopConfig  # gains before and with it; after "taken_back" the former are in use again
    after: LoopConfig
    traded: Traded | None = None
    # time constant of the shape loop before and after, if that was tried
    shape_s: tuple[float, float] | None = None


def make_entry(
    what: What,
    session: str,
    author: str,
    reason: str,
    before: LoopConfig,
    after: LoopConfig,
    traded: Traded | None = None,
    shape_s: tuple[float, float] | None = None,
) -> GainsEntry:
    """Return an entry stamped with the present time.

    Parameters
    ----------
    what : str
        What happened to the gains: kept, taken back, saved and so on.
    session : str
        Name of the session.
    author, reason : str
        Who did it, and why.
    before, after : LoopConfig
        The loop's settings.
    traded : Traded, optional
        What a choice gained and lost against the proposal.
    shape_s : (float, float), optional
        Time constant of the shape loop before and after.
    """
    now_utc = datetime.now(UTC).isoformat(timespec="seconds")
    return GainsEntry(now_utc, what, session, author, reason, before, after, traded, shape_s)


def append_entry(logs: Path, what: GainsEntry) -> None:
    """Append an entry to the journal; symbolic links are not followed.

    Parameters
    ----------
    logs : Path
        Folder of runs and sessions.
    what : GainsEntry
        The entry.

    Raises
    ------
    InputError
        It cannot be written.
    """
    path = logs / "tuning" / _FILE
    with errors.convert_write_errors(path):
        files.make_folder(path.parent)
        line = {**program.file_origin(_SCHEMA), **session_json.to_plain(what)}
        files.append_text(path, json.dumps(line, allow_nan=False) + "\n")
        files.sync_data(path)


def read_entries(logs: Path) -> list[GainsEntry]:
    """All entries, oldest first, without truncated lines. Raises InputError if it is not a regular
    file.
    """
    path = logs / "tuning" / _FILE
    try:
        text = files.read_text(path, errors="replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise errors.InputError(f"{path}: {errors.os_reason(error)}") from None
    found: list[GainsEntry] = []
    for line in text.splitlines():
        try:
            table = plain_json.loads(line)
            program.remove_origin(table, _SCHEMA)
            found.append(session_json.build_value(GainsEntry, table))
        except (ValueError, TypeError, KeyError, AttributeError):
            continue
    return found


def find_roll_back(logs: Path, gains_only: bool = False) -> GainsEntry:
    """Find the newest gains that were kept and not rolled back since.

    Parameters
    ----------
    logs : Path
        Folder of runs and sessions.
    gains_only : bool
        A time constant of the shape loop does not count.

    Returns
    -------
    GainsEntry

    Raises
    ------
    InputError
        There are none.
    """
    for found in _list_used_gains(logs):
        if found.shape_s is None or not gains_only:
            return found
    raise errors.InputError(f"{logs / 'tuning' / _FILE}: no kept gains")


def find_kept_shape_s(logs: Path, session: str = "") -> float | None:
    """The time constant of the shape loop that was kept last and not rolled back since, s.

    Parameters
    ----------
    logs : Path
        Folder of runs and sessions.
    session : str
        Name of a session's folder; empty: by any session.

    Returns
    -------
    float or None
        None if none was kept.
    """
    of_it = (line.shape_s for line in _list_used_gains(logs) if session in ("", line.session))
    return next((shape_s[1] for shape_s in of_it if shape_s is not None), None)


def _list_used_gains(logs: Path) -> Iterator[GainsEntry]:
    """What was kept and not rolled back since, newest first."""
    # Backwards through the journal: a roll-back undoes what the same session has kept before it,
    # gains or time constant.
    undone: set[tuple[str, bool]] = set()
    for found in reversed(read_entries(logs)):
        of = (found.session, found.shape_s is None)
        if found.what == "rolled_back":
            undone.add(of)
        elif found.what == "kept" and of not in undone:
            yield found


def format_history(found: list[GainsEntry]) -> str:
    """The journal as a Markdown table."""
    lines = [
        "| time | what | session | author | K 1/s | Ti s | filter s | candidate | std µm | load "
        "peak µm | recovery s | Ms | reason |",
        "|---|---|---|---|---:|---:|---:|---|---:|---:|---:|---:|---|",
    ]
    for line in found:
        # What is in use after the entry: a roll-back brings back what was there before.
        loop = line.after
        shape_s = line.shape_s
        if line.what == "rolled_back":
            loop = line.before
            if shape_s is not None:
                shape_s = shape_s[1], shape_s[0]
        traded: tuple[str, ...] = ("",) * 5
        if line.traded is not None:
            traded = (line.traded.candidate, *line.traded.words)
        reason = line.reason
        if shape_s is not None:
            reason = f"shape loop {shape_s[0]:.0f} -> {shape_s[1]:.0f} s: {reason}"
        gains = (f"{loop.kp_per_s:.3f}", f"{loop.ti_s:.2f}", f"{loop.measurement_filter_s:.2f}")
        cells = (line.time_utc, line.what, line.session, line.author, *gains, *traded, reason)
        lines.append(f"| {' | '.join(map(_format_cell, cells))} |")
    return "\n".join(lines)


def _format_cell(text: str) -> str:
    """Text that stays in its cell of a Markdown table: people type reasons with any character."""
    return terminal.one_line(text).replace("|", r"\|")
