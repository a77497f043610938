"""A run folder as data: `open_run(path)`, then columns, levels, shapes, events. Nothing here
writes.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import events, run_events
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.run_files import (
    event_log,
    labelled,
    levels,
    named_tables,
    run_config,
    run_head,
    run_lookup,
    shapes,
    summary_file,
    table_specs,
)
from membrane_ctrl.run_files.recorded_rate import at_recorded_rate
from membrane_ctrl.run_files.shapes import Shapes
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import TableSpec

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Block = dict[str, Column]
# From the last tick to the end of a run.
_WAY_DOWN_S = 60.0
# Shorter gaps of a level had nothing to record.
_HOLE_S = 30.0
_PARTS_MAX = 100_000  # ten years of hours
_PLACE_OF_THUMBNAIL = ("number", "time_s", "pattern")
# Damaged lines may hold impossible times, and dates have a limit.
_YEARS = range(1970, 2200)
_RUN_MAX_S = 1e9


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
    recorded_by : str
        Program, version and commit that made the folder; empty if unknown.
    """

    folder: Path
    config: Config
    log: tuple[event_log.LoggedEvent, ...]
    summary: dict[str, Any] | None
    origin_utc: datetime
    notes: list[str] = field(default_factory=list)
    recorded_by: str = ""

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

    def log_between(self, start_s: float, end_s: float) -> tuple[event_log.LoggedEvent, ...]:
        """The log of a part of the run.

        Parameters
        ----------
        start_s, end_s : float
            Seconds of the run; the end does not belong to the part.
        """
        return tuple(each for each in self.log if start_s <= each.mono_s < end_s)

    def ticks(
        self, names: Sequence[str] | None = None, start_s: float = -np.inf, end_s: float = np.inf
    ) -> pa.Table:
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
            `time_s` (seconds of the run), `time_utc` and the fields; codes are names, absent values
            null.
        """
        wanted = _with_time([name for name in names or FIELDS if name not in named_tables.TIMES])
        blocks = list(self.tick_blocks(wanted, start_s, end_s)) or [
            {name: np.empty(0) for name in wanted}
        ]
        parts = [named_tables.named_table(block, self.origin_utc) for block in blocks]
        return pa.concat_tables(parts, promote_options="permissive").unify_dictionaries()

    def overview(
        self,
        window_s: float = 10.0,
        start_s: float = -np.inf,
        end_s: float = np.inf,
        names: Sequence[str] = (),
    ) -> pa.Table:
        """Minimum, mean and maximum of each signal in windows: quick for a month.

        A table like that of `ticks`: `time_s` is the start of a window, `rows` the number of its
        ticks, `state` the state at its end, `mean_error_um` the mean of a signal.

        Parameters
        ----------
        window_s : float
            1, 10 or 60.
        start_s, end_s : float
            Part of the run; by default all of it.
        names : sequence of str
            Columns of the table; by default all.
        """
        level = self.level(window_s, start_s, end_s, names or levels.NAMES)
        return named_tables.named_table(level, self.origin_utc)

    def cycles(self, start_s: float = -np.inf, end_s: float = np.inf) -> pa.Table:
        """Return the measured figures, one row per cycle.

        Parameters
        ----------
        start_s, end_s : float
            The part of the run.

        Returns
        -------
        Table
            Times, `z1_um` and all other terms, sag, quality, verdict.
        """
        found = self.shapes()
        wanted = (found.time_s >= start_s) & (found.time_s < end_s)
        return named_tables.named_table(found.select_cycles(wanted).make_columns(), self.origin_utc)

    def to_pandas(
        self,
        table: labelled.LabelledTable = "ticks",
        names: Sequence[str] | None = None,
        start_s: float = -np.inf,
        end_s: float = np.inf,
        window_s: float = 10.0,
    ) -> "pd.DataFrame":
        """A table as a frame with its UTC as index; codes are categories of names, a missing number
        is NaN.

        Parameters
        ----------
        table : {"ticks", "overview", "cycles"}
            Which of the methods of these names gives the rows.
        names : sequence of str, optional
            Columns of `ticks` or `overview`; all by default.
        start_s, end_s : float
            Part of the run to read.
        window_s : float
            Of `overview`.

        Raises
        ------
        InputError
            If pandas is missing.
        """
        return labelled.make_frame(self._make_named_table(table, names, start_s, end_s, window_s))

    def to_xarray(
        self,
        table: labelled.LabelledTable = "ticks",
        names: Sequence[str] | None = None,
        start_s: float = -np.inf,
        end_s: float = np.inf,
        window_s: float = 10.0,
    ) -> "xr.Dataset":
        """A table as a dataset along `time` (UTC), each variable with `units` and `long_name`.

        Of `cycles`, `coeffs_um` is an array along `time` and `noll`, and there are the recorded
        covariances.

        Parameters
        ----------
        table : str
            `ticks`, `cycles` or `overview`.
        names : sequence of str, optional
            Columns; by default all.
        start_s, end_s : float
            Part of the run.
        window_s : float
            Window of the overview.

        Raises
        ------
        InputError
            xarray is missing.
        """
        about = {
            "run": self.name,
            "started_utc": self.origin_utc.isoformat(),
            "recorded_by": self.recorded_by,
        }
        if table == "cycles":
            return labelled.make_cycles_dataset(
                self.shapes(), (start_s, end_s), self.origin_utc, about
            )
        if table == "ticks":
            spec = table_specs.TICKS
        else:
            spec = table_specs.LEVELS[window_s]
        named = self._make_named_table(table, names, start_s, end_s, window_s)
        return labelled.make_dataset(named, labelled.labels_of(spec), about)

    def _make_named_table(
        self,
        table: labelled.LabelledTable,
        names: Sequence[str] | None,
        start_s: float,
        end_s: float,
        window_s: float,
    ) -> pa.Table:
        """A table for people. Raises ValueError for an unknown name."""
        match table:
            case "ticks":
                return self.ticks(names, start_s, end_s)
            case "overview":
                return self.overview(window_s, start_s, end_s, names or ())
            case "cycles":
                return self.cycles(start_s, end_s)
        raise ValueError(f"no such table: {table}; known: ticks, overview, cycles")

    def tick_blocks(
        self, names: Sequence[str], start_s: float = -np.inf, end_s: float = np.inf
    ) -> Iterator[Block]:
        """Read telemetry in blocks: a month needs no more memory than a night.

        Parameters
        ----------
        names : sequence of str
            Columns; the time is read as well.
        start_s, end_s : float
            The part of the run.

        Returns
        -------
        iterator of Block
            Arrays by name, codes as numbers.
        """
        wanted = _with_time(names)
        return self._iterate_blocks(table_specs.TICKS, wanted, start_s, end_s)

    def _iterate_blocks(
        self, spec: TableSpec, names: Sequence[str], start_s: float, end_s: float
    ) -> Iterator[Block]:
        for table in self._open_table(spec).iterate_tables(names, start_s, end_s):
            yield {name: _to_array(table, name) for name in names}

    def _open_table(self, spec: TableSpec) -> TableReader:
        return TableReader(self.folder, spec, self.notes)

    def _reaches_end(self, until_s: float) -> bool:
        """Whether a table that ends here is complete: a run without a summary may have more."""
        if self.summary is None or until_s == -np.inf:
            return False
        duration_s = self.summary.get("duration_s")
        return not isinstance(duration_s, (int, float)) or until_s > duration_s - _WAY_DOWN_S

    def level(
        self,
        window_s: float,
        start_s: float = -np.inf,
        end_s: float = np.inf,
        names: Sequence[str] = levels.NAMES,
    ) -> Block:
        """What `overview` shows, as arrays for computing: codes are numbers, absent values NaN.

        Windows missing from the level's table are computed from the next finer one, ultimately from
        the ticks.

        Parameters
        ----------
        window_s : float
            1, 10 or 60.
        start_s, end_s : float
            Part of the run.
        names : sequence of str
            Columns; `time_s` and `rows` are there in any case.

        Returns
        -------
        dict of str to (windows,) array

        Raises
        ------
        ValueError
            There is no level of these windows.
        """
        names = tuple(dict.fromkeys(("time_s", "rows", *names)))
        if window_s not in table_specs.LEVELS:
            known = ", ".join(f"{each:g}" for each in levels.WINDOWS_S)
            raise ValueError(f"levels are {known} s, not {window_s:g}")
        spec = table_specs.LEVELS[window_s]
        blocks = list(self._iterate_blocks(spec, names, start_s, end_s))
        # Windows that the table lacks: between its rows, and after the last of them
        time_s = np.concatenate([block["time_s"] for block in blocks] or [np.empty(0)])
        missing = _find_gaps(time_s, window_s, start_s)
        # Does the table reach the end? A run in progress, or a killed one, has ticks whose windows
        # no recorder has finished
        until_s = start_s
        if time_s.size:
            until_s = float(time_s[-1]) + window_s
        continues = self._open_table(spec).known_until_s >= end_s
        if not time_s.size:
            lacks_end = True
        elif continues:
            lacks_end = end_s - until_s > _HOLE_S
        else:
            lacks_end = not self._reaches_end(until_s)
        if lacks_end:
            missing.append((until_s, end_s))
        # These are computed, and put into their places
        for begins_s, ends_s in missing:
            if begins_s < ends_s:
                blocks += self._made_level(window_s, begins_s, ends_s, names)
        if not blocks:
            return {name: np.empty(0) for name in names}
        level = {name: np.concatenate([block[name] for block in blocks]) for name in names}
        if not missing:
            return level
        order = np.argsort(level["time_s"], kind="stable")
        return {name: values[order] for name, values in level.items()}

    def _made_level(
        self, window_s: float, start_s: float, end_s: float, names: Sequence[str]
    ) -> list[Block]:
        """Compute a part of a level from the next finer one or from the ticks."""
        # The standard deviation of a longer window needs the means of its parts.
        means = [name.replace("std_", "mean_", 1) for name in names if name.startswith("std_")]
        names = tuple(dict.fromkeys((*names, *means)))
        finer = {coarse: fine for fine, coarse in pairwise(levels.WINDOWS_S)}
        if window_s in finer:
            return [
                levels.coarser_level(self.level(finer[window_s], start_s, end_s, names), window_s)
            ]
        parts = [
            levels.first_level(block)
            for block in self.tick_blocks(levels.TICK_FIELDS, start_s, end_s)
        ]
        if not parts:
            return []
        joined = {name: np.concatenate([part[name] for part in parts]) for name in levels.NAMES}
        # a window may lie in two blocks
        return [levels.coarser_level(joined, window_s)]

    def shapes(self) -> Shapes:
        """Every shape estimate of the run, cycles and tracked frames, as arrays."""
        figures = chain.from_iterable(
            self._open_table(spec).iterate_tables(shapes.TABLE_COLUMNS)
            for spec in (table_specs.SHAPES, table_specs.TRACKED)
        )
        return shapes.from_tables(
            figures, self._open_table(table_specs.COVARIANCES).iterate_tables()
        )

    def thumbnails(
        self, most: int, start_s: float = -np.inf, end_s: float = np.inf
    ) -> list[dict[str, Any]]:
        """Pictures of camera frames, evenly spaced.

        Parameters
        ----------
        most : int
            Of each pattern.
        start_s, end_s : float
            Part of the run to read.

        Returns
        -------
        list of dict
            `time_s`, `pattern` and `jpeg` of each, in order.
        """
        # First only times and patterns, which are small; then the pictures that are chosen.
        places = list(self._open_table(table_specs.THUMBNAILS).iterate_tables(_PLACE_OF_THUMBNAIL))
        whole = [table for table in places if table.column_names == list(_PLACE_OF_THUMBNAIL)]
        if not whole:
            return []
        joined = pa.concat_tables(whole)
        time_s = joined["time_s"].to_numpy()
        patterns = joined["pattern"].to_numpy()
        all_numbers = joined["number"].to_numpy()
        within = (time_s >= start_s) & (time_s < end_s) & (np.abs(time_s) < _RUN_MAX_S)
        numbers: list[int] = []
        for pattern in dict.fromkeys(patterns[within].tolist()):
            of_pattern = all_numbers[within & (patterns == pattern)]
            every = max(1, math.ceil(of_pattern.size / most))
            numbers += of_pattern[::every].tolist()
        return list(self._read_pictures(numbers))

    def _read_pictures(self, numbers: Sequence[int]) -> Iterator[dict[str, Any]]:
        """Rows of the table of thumbnails by their numbers, without damaged ones."""
        if not numbers:
            return
        names = (*_PLACE_OF_THUMBNAIL, "jpeg")
        wanted = pa.array(sorted(numbers))
        reader = self._open_table(table_specs.THUMBNAILS)
        for table in reader.iterate_tables(names, float(min(numbers)), float(max(numbers)) + 1):
            if table.column_names == list(names):
                chosen = table.filter(pa.compute.is_in(table["number"], wanted)).drop_null()
                yield from chosen.select(names[1:]).to_pylist()

    def read_all_parts(self) -> None:
        """Check every file of every table, so that `notes` names all damage."""
        for spec in table_specs.ALL:
            table = self._open_table(spec)
            table.check_all()
            for _ in table.iterate_tables([spec.time_name]):
                pass


def open_run(path: str | Path) -> Run:
    """Open a run folder, or that of a file in it, even of a run that is in progress, was killed, or
    lacks parts.

    Raises InputError if there is no such folder, or it contains nothing of a run.
    """
    folder = run_lookup.find_folder(Path(path))
    notes: list[str] = []
    head = run_head.read_run_head(folder, notes)
    log = event_log.read_events(folder, notes)
    summary = summary_file.read_summary(folder, notes)
    if (
        summary
        and summary.get("exit")
        and not any(isinstance(each.event, run_events.Ended) for each in log)
    ):
        notes.append(
            "events.jsonl: at least the last line is missing: the run has ended without an "
            "end event"
        )
    notes += _find_missing_parts(folder, summary)
    config = at_recorded_rate(run_config.read_config(folder, notes), folder, notes)
    return Run(folder, config, log, summary, origin_of(folder, log), notes, head.recorded_by)


def _find_missing_parts(folder: Path, summary: dict[str, Any] | None) -> list[str]:
    """Missing parts of tables, found by their numbers, their manifests and the summary's count."""
    account = (summary or {}).get("recorder")
    counted = account.get("tables") if isinstance(account, dict) else None
    notes: list[str] = []
    for spec in table_specs.ALL:
        table = TableReader(folder, spec, notes)
        table.note_missing(
            _plausible_count(counted.get(spec.name) if isinstance(counted, dict) else 0)
        )
        if spec is table_specs.TICKS and not table.exists:
            notes.append("the table of ticks is missing")
    return notes


def _plausible_count(value: object) -> int:
    """Number of parts according to the summary, if plausible."""
    if isinstance(value, int) and 0 <= value <= _PARTS_MAX:
        return value
    return 0


def origin_of(folder: Path, log: Sequence[event_log.LoggedEvent]) -> datetime:
    """UTC at 0 s of a run: from its first event with both times, else from the folder's name or
    age.

    Parameters
    ----------
    folder : Path
        Folder of the run; its name begins with the start, to a second, if it was not renamed.
    log : sequence of LoggedEvent
        Events of the run; times that no run can have are passed over.
    """
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


def _find_gaps(time_s: Column, window_s: float, start_s: float) -> list[tuple[float, float]]:
    """Gaps before and between a level's windows, left by damaged batches."""
    if not time_s.size:
        return []
    least_s = window_s + _HOLE_S
    ends = np.flatnonzero(np.diff(time_s) > least_s)
    holes = [(float(time_s[row]) + window_s, float(time_s[row + 1])) for row in ends]
    begins = []
    if time_s[0] - max(start_s, 0.0) > least_s:
        begins = [(start_s, float(time_s[0]))]
    return begins + holes


def _with_time(names: Sequence[str]) -> tuple[str, ...]:
    unknown = sorted(set(names) - set(FIELDS))
    if unknown:
        raise ValueError(f"no such column: {', '.join(unknown)}; known: {json.dumps(FIELDS)}")
    return tuple(dict.fromkeys(("mono_s", *names)))


def _to_array(table: pa.Table, name: str) -> Column:
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    values = np.asarray(table.column(name).to_numpy())
    if values.dtype.kind == "f":
        return values
    return values.astype(np.float64)
