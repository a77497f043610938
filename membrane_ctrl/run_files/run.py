"""A run folder as data: `open_run(path)`, then columns, levels, shapes, events. Nothing here writes."""

import json
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import events, run_events
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.run_files import column_reader, rrd_reader, run_folder, shapes, streams, tables
from membrane_ctrl.run_files.column_file import SUFFIX
from membrane_ctrl.run_files.segments import ending
from membrane_ctrl.run_files.shapes import Shapes

Block = dict[str, Column]
# Rerun rounds the time of a tick to a nanosecond; the next tick is milliseconds away
_SAME_TICK_S = 1e-6
# From the last tick to the end of a run, and the part of a killed run that only the segments have.
_WAY_DOWN_S = 60.0
# A batch of a level spans minutes; shorter gaps had nothing to record.
_HOLE_S = 30.0
_FILES_MAX = 100_000  # ten years of hours
# Damaged lines may hold impossible times, and dates have a limit.
_YEARS = range(1970, 2200)
_RUN_MAX_S = 1e9
TABLES = (
    tables.TICKS, tables.RARE, *(tables.level_table(window_s) for window_s in tables.WINDOWS_S), tables.SHAPES,
)  # fmt: skip
_STAND_IN = "Rerun segments replace ticks missing from the tables, not all of them, and without checksums"


@dataclass(frozen=True, slots=True)
class _Reach:
    """How far a table reaches: the last row returned of a part, and the last known row, perhaps later; -inf: none."""

    given_s: float
    known_s: float


@dataclass(frozen=True, slots=True)
class Run:
    """A run, opened for reading.

    Attributes
    ----------
    folder : Path
    config : Config
        As run; from another version, the readable keys, with defaults for the rest.
    log : tuple of LoggedEvent
        `events.jsonl` and later annotations, in order of time.
    summary : dict or None
        `summary.json`; None during the run, or if its recorder was killed.
    origin_utc : datetime
        UTC at 0 s of the run.
    notes : list of str
        Missing and damaged parts, one line each; reading may add more.
    """

    folder: Path
    config: Config
    log: tuple[run_folder.LoggedEvent, ...]
    summary: dict[str, Any] | None
    origin_utc: datetime
    notes: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.name

    @property
    def events(self) -> tuple[events.EventLine, ...]:
        """The lines of the log, as in their files."""
        return tuple(each.line for each in self.log)

    def utc(self, mono_s: float) -> datetime:
        """UTC of a time of the run; an impossible time, as in damaged tables, gives the start."""
        return self.origin_utc + timedelta(seconds=mono_s if abs(mono_s) < _RUN_MAX_S else 0.0)

    def log_between(self, start_s: float, end_s: float) -> tuple[run_folder.LoggedEvent, ...]:
        """The log of a part of the run."""
        return tuple(each for each in self.log if start_s <= each.mono_s < end_s)

    def ticks(self, names: Sequence[str] | None = None, start_s: float = -np.inf, end_s: float = np.inf) -> pa.Table:
        """Telemetry, one row per tick.

        Parameters
        ----------
        names : sequence of str, optional
            Fields of `telemetry.TelemetryRow`; all by default.
        start_s, end_s : float
            Part of the run to read.

        Returns
        -------
        pyarrow.Table
            `time_s` (seconds of the run), `time_utc` and the fields; codes are names, absent values null.
        """
        wanted = _with_time([name for name in names or FIELDS if name not in streams.TIMES])
        blocks = list(self.tick_blocks(wanted, start_s, end_s)) or [{name: np.empty(0) for name in wanted}]
        parts = [streams.named_table(block, self.origin_utc) for block in blocks]
        return pa.concat_tables(parts, promote_options="permissive").unify_dictionaries()

    def overview(
        self, window_s: float = 10.0, start_s: float = -np.inf, end_s: float = np.inf, names: Sequence[str] = ()
    ) -> pa.Table:
        """Minimum, mean and maximum of each signal in windows of 1, 10 or 60 s, all by default: quick for a month.

        A table like that of `ticks`: `time_s` is the start of a window, `rows` the number of its ticks, `state` the
        state at its end, `mean_error_um` the mean of a signal.
        """
        level = self.level(window_s, start_s, end_s, names or tables.NAMES)
        return streams.named_table(level, self.origin_utc)

    def cycles(self, start_s: float = -np.inf, end_s: float = np.inf) -> pa.Table:
        """The measured figure, one row per cycle: times, `z1_um` and all other terms, sag, quality, verdict."""
        found = self.shapes()
        wanted = (found.time_s >= start_s) & (found.time_s < end_s)
        return streams.named_table(found.select(wanted).columns(), self.origin_utc)

    def tick_blocks(self, names: Sequence[str], start_s: float = -np.inf, end_s: float = np.inf) -> Iterator[Block]:
        """Telemetry as arrays, codes as numbers, in blocks of hours: a month needs no more memory than a night."""
        wanted = _with_time(names)
        table = yield from self._table_blocks(tables.TICKS, "mono_s", wanted, start_s, end_s)
        # a part that lies in a gap of the table, which the time after its end is not
        hole = table.given_s == -np.inf and start_s < table.known_s
        if not hole and (table.known_s >= end_s or self._reaches_end(table.known_s)):
            return
        last_s = -np.inf if hole else table.known_s
        begin_s = max(start_s, last_s + _SAME_TICK_S)
        for block in rrd_reader.segment_blocks(self.folder, wanted, begin_s, end_s, self.notes):
            if block["mono_s"][-1] - last_s > _WAY_DOWN_S:
                column_reader.add_note(self.notes, _STAND_IN)
            yield block

    def _reaches_end(self, until_s: float) -> bool:
        """Whether a table that ends here is complete: a run without a summary may have more."""
        if self.summary is None or until_s == -np.inf:
            return False
        duration_s = self.summary.get("duration_s")
        return not isinstance(duration_s, (int, float)) or until_s > duration_s - _WAY_DOWN_S

    def level(
        self, window_s: float, start_s: float = -np.inf, end_s: float = np.inf, names: Sequence[str] = tables.NAMES
    ) -> Block:
        """What `overview` shows, as arrays for computing: codes are numbers, absent values NaN.

        Windows missing from the level's table are computed from the next finer one, ultimately from the ticks.
        """
        names = tuple(dict.fromkeys(("time_s", "rows", *names)))
        if window_s not in tables.WINDOWS_S:
            raise ValueError(f"levels are {', '.join(f'{w:g}' for w in tables.WINDOWS_S)} s, not {window_s:g}")
        blocks, table = _listed(self._table_blocks(tables.level_table(window_s), "time_s", names, start_s, end_s))
        time_s = np.concatenate([block["time_s"] for block in blocks] or [np.empty(0)])
        missing = _holes(time_s, window_s, start_s)
        until_s = float(time_s[-1]) + window_s if time_s.size else start_s
        within = table.known_s >= end_s  # the table continues after the part
        if not time_s.size or (end_s - until_s > _HOLE_S if within else not self._reaches_end(until_s)):
            missing.append((until_s, end_s))
        for begins_s, ends_s in missing:
            blocks += self._made_level(window_s, begins_s, ends_s, names) if begins_s < ends_s else []
        if not blocks:
            return {name: np.empty(0) for name in names}
        level = {name: np.concatenate([block[name] for block in blocks]) for name in names}
        order = np.argsort(level["time_s"], kind="stable") if missing else slice(None)
        return {name: values[order] for name, values in level.items()}

    def _made_level(self, window_s: float, start_s: float, end_s: float, names: Sequence[str]) -> list[Block]:
        """Compute a part of a level from the next finer one or from the ticks."""
        finer = {coarse: fine for fine, coarse in pairwise(tables.WINDOWS_S)}
        if window_s in finer:
            return [tables.coarser_level(self.level(finer[window_s], start_s, end_s, names), window_s)]
        return [tables.first_level(block) for block in self.tick_blocks(tables.TICK_FIELDS, start_s, end_s)]

    def shapes(self) -> Shapes:
        """Every shape estimate of the run, as arrays."""
        files = column_reader.column_files(self.folder, tables.SHAPES)
        parts = (part for path in files for part in self._parts(path, files[-1], shapes.TABLE_COLUMNS))
        found = [shapes.from_table(table) for table in parts if table.num_rows]
        if not found and not self._measured_nothing():
            columns = [rrd_reader.read_shapes(path, self.notes) for path in rrd_reader.segments(self.folder)]
            found = [shapes.from_columns(part) for part in columns if part]
        return shapes.joined(found)

    def _measured_nothing(self) -> bool:
        """Whether there were no shape estimates: the segments need not be searched for them."""
        return self.summary is not None and self.summary.get("cycles") == 0

    def check_segments(self, limit_s: float) -> None:
        """Decode the Rerun segments to find damage, for `limit_s` at most; `notes` names the damaged ones."""
        rrd_reader.check_segments(self.folder, limit_s, self.notes)

    def look_through(self) -> None:
        """Check every table and segment, so that `notes` names all damage.

        A segment with consecutive messages is not decoded: that would take minutes for a month.
        """
        for table in TABLES:
            files = column_reader.column_files(self.folder, table)
            for path in files:
                for _ in self._parts(path, files[-1], ["mono_s" if table == tables.TICKS else "time_s"]):
                    pass
        for path in rrd_reader.segments(self.folder):
            if not _is_closed(path):
                rrd_reader.read_ticks(path, ["mono_s"], self.notes)

    def _parts(self, path: Path, last: Path, names: Sequence[str]) -> Iterator[pa.Table]:
        """Columns of a file; the last file of a closed run has an end mark."""
        closed = self.summary is not None and not self.summary.get("rebuilt")
        return column_reader.read_parts(path, names, self.notes, closed and path == last)

    def _table_blocks(
        self, table: str, time_name: str, names: Sequence[str], start_s: float, end_s: float
    ) -> Generator[Block, None, _Reach]:
        """Yield blocks of a table's part; returns how far the table reaches."""
        files = column_reader.column_files(self.folder, table)
        limited = np.isfinite(start_s) or np.isfinite(end_s)
        starts = [column_reader.first_s(path, time_name) if limited else None for path in files]
        last_s = known_s = -np.inf
        for place, path in enumerate(files):
            begins, ends = starts[place], next((s for s in starts[place + 1 :] if s is not None), None)
            known_s = max(known_s, -np.inf if begins is None else begins)
            if (begins is not None and begins >= end_s) or (ends is not None and ends <= start_s):
                continue
            for read in self._parts(path, files[-1], names):
                if time_name not in read.column_names:
                    continue
                block = {name: _array(read, name) for name in names}
                known_s = max(known_s, block[time_name][-1] if block[time_name].size else -np.inf)
                # a journal may repeat rows that the recorder wrote just before it was killed
                block = rrd_reader.cut(block, time_name, max(start_s, np.nextafter(last_s, np.inf)), end_s)
                if block[time_name].size:
                    last_s = float(block[time_name][-1])
                    yield block
        return _Reach(last_s, float(known_s))


def _listed(blocks: Generator[Block, None, _Reach]) -> tuple[list[Block], _Reach]:
    """All blocks, and the generator's return value."""
    found: list[Block] = []
    while True:
        try:
            found.append(next(blocks))
        except StopIteration as end:
            return found, end.value


def open_run(path: str | Path) -> Run:
    """Open a run folder, or that of a file in it, even of a run that is in progress, was killed, or lacks parts.

    Raises InputError if there is no such folder, or it contains nothing of a run.
    """
    folder = run_folder.find_folder(Path(path))
    notes: list[str] = []
    log = run_folder.read_events(folder, notes)
    summary = run_folder.read_summary(folder, notes)
    if summary and summary.get("exit") and not any(isinstance(each.event, run_events.Ended) for each in log):
        notes.append("events.jsonl: at least the last line is missing: the run has ended without an end event")
    notes += _missing(folder, summary)
    config = column_reader.at_recorded_rate(run_folder.read_config(folder, notes), folder, notes)
    return Run(folder, config, log, summary, origin_of(folder, log), notes)


def _is_closed(path: Path) -> bool:
    try:
        return ending(path)[0]
    except OSError:
        return False


def _missing(folder: Path, summary: dict[str, Any] | None) -> list[str]:
    """Missing tables and segments, found by their numbers and by the summary's count."""
    account = (summary or {}).get("recorder")
    counts = account if isinstance(account, dict) else {}
    counted = counts.get("tables")
    notes = []
    for table in TABLES:
        count = _count(counted.get(table) if isinstance(counted, dict) else 0)
        gone = column_reader.missing_files(column_reader.column_files(folder, table), f"{table}-000{SUFFIX}", count)
        notes += [f"{name}: missing; its data are left out" for name in gone]
    segments = rrd_reader.segments(folder)
    ticks = bool(column_reader.column_files(folder, tables.TICKS))
    if not ticks and segments:
        notes.append("the tables of ticks are missing; Rerun segments replace them, without every tick")
    count = _count(counts.get("segments"))
    gone = column_reader.missing_files(
        segments, segments[0].name if segments else f"{folder.name[17:]}-000.rrd", count
    )
    held = "its ticks are in the tables" if ticks else "its data are left out"
    return notes + [f"{name}: missing; {held}" for name in gone]


def _count(value: object) -> int:
    """Number of files according to the summary, if plausible."""
    return value if isinstance(value, int) and value <= _FILES_MAX else 0


def origin_of(folder: Path, log: Sequence[run_folder.LoggedEvent]) -> datetime:
    """UTC at 0 s of a run: from its first event with both times, else from the folder's name or age."""
    for each in log:
        try:
            moment = datetime.fromisoformat(each.line["time_utc"])
            began = moment.astimezone(UTC) - timedelta(seconds=float(each.line["mono_s"]))
        except (KeyError, TypeError, ValueError, OverflowError):
            continue
        if began.year in _YEARS:
            return began
    try:
        began = datetime.strptime(folder.name[:16], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
        if began.year in _YEARS:
            return began
    except ValueError:
        pass
    return datetime.fromtimestamp(folder.stat().st_mtime, UTC)


def _holes(time_s: Column, window_s: float, start_s: float) -> list[tuple[float, float]]:
    """Gaps before and between a level's windows, left by damaged batches."""
    if not time_s.size:
        return []
    least_s = window_s + _HOLE_S
    ends = np.flatnonzero(np.diff(time_s) > least_s)
    holes = [(float(time_s[row]) + window_s, float(time_s[row + 1])) for row in ends]
    begins = [(start_s, float(time_s[0]))] if time_s[0] - max(start_s, 0.0) > least_s else []
    return begins + holes


def _with_time(names: Sequence[str]) -> tuple[str, ...]:
    unknown = sorted(set(names) - set(FIELDS))
    if unknown:
        raise ValueError(f"no such column: {', '.join(unknown)}; known: {json.dumps(FIELDS)}")
    return tuple(dict.fromkeys(("mono_s", *names)))


def _array(table: pa.Table, name: str) -> Column:
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(table.column(name).to_numpy())
