"""Reads the tables beside a recording (`column_file`); reports damage and returns the rest."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.model.files import open_plain, read_bytes
from membrane_ctrl.model.zernike_terms import COVARIANCE_UPPER_SIZE, ZERNIKE_TERMS
from membrane_ctrl.run_files import column_codec, sealed_stream, tables
from membrane_ctrl.run_files.column_file import FOLDER, SUFFIX

# Impossible times of rows: a flipped byte can make a time in the year 30 000 000, and a run that long.


# A file of a table holds six hours, a segment at most a day (the limit of `recording.segment_s`).
_FILE_MAX_S = 86_400.0


def possible_times(time_s: FloatArray) -> BoolArray:
    """Which of a file's (n,) times are finite and within a day of most others."""
    finite = np.isfinite(time_s)
    if not finite.any():
        return finite
    return np.asarray(finite & (np.abs(time_s - np.median(time_s[finite])) <= _FILE_MAX_S))


# The time column: of ticks, and of the other tables.
_TIMES = ("mono_s", "time_s")
_LOOK_BYTES = 1 << 20  # covers the header and a first batch
# Columns of `shapes` that are not numbers.
_WORDS = frozenset({"kind", "verdict", "reason"})
_PLAIN = {"data": pa.binary(), "tracking_lost": pa.bool_()}
_LISTS = {"coeffs_um": ZERNIKE_TERMS, "covariance_um2": ZERNIKE_TERMS**2, "upper_um2": COVARIANCE_UPPER_SIZE}
# Limit on memory at a time, whatever the file: numbers of eight bytes, and a batch's other content.
_PART_CELLS = 24_000_000
_PART_BYTES = 200_000_000


def column_files(folder: Path, table: str) -> list[Path]:
    """The files of a table, in order."""
    return sorted((folder / FOLDER).glob(f"{table}-*{SUFFIX}"))


def missing_files(files: Sequence[Path], first: str, count: int = 0) -> list[str]:
    """Names of missing files of a table or recording with numbered files.

    Parameters
    ----------
    files : sequence of Path
        The existing ones.
    first : str
        Name of file 0: `ticks-000.arrows`.
    count : int
        Number of files expected, if known.
    """
    pattern = re.fullmatch(r"(.*-)(\d+)(\.\w+)", first)
    if pattern is None:  # a file of another origin
        return []
    stem, number, suffix = pattern.groups()
    there = {int(found[1]) for path in files if (found := re.search(r"-(\d+)\.\w+$", path.name))}
    every = range(max(max(there, default=-1) + 1, count))
    return [f"{stem}{n:0{len(number)}d}{suffix}" for n in every if n not in there]


def read_file(path: Path, names: Sequence[str] | None, notes: list[str], over: bool = False) -> pa.Table | None:
    """Read one file's columns into one table, as `read_parts`; None if nothing is readable."""
    parts = read_parts(path, names, notes, over)
    found = list(itertools.islice(parts, 1))
    if not found:
        return None
    if next(parts, None) is not None:
        add_note(notes, f"{path.name}: more rows than a recorder writes: the rest is left out")
    return found[0]


def read_parts(
    path: Path, names: Sequence[str] | None, notes: list[str], over: bool = False, cells: int = _PART_CELLS
) -> Iterator[pa.Table]:
    """Read one file's columns, in parts of at most `cells` cells; none if nothing is readable.

    Parameters
    ----------
    path : Path
        An Arrow stream.
    names : sequence of str or None
        Columns to read (omitting those the file lacks); None: all.
    notes : list
        Gets a line if the file is damaged, or of a version without a wanted column.
    over : bool
        The file should have an end mark: it is its table's last one, and the run was closed.
    cells : int
        Largest size of a part of several batches.
    """
    try:
        # a plain read: a mapped file's pages would count as our memory
        content = sealed_stream.unseal(read_bytes(path, sealed_stream.FILE_BYTES_MAX))
        if not content.data:
            add_note(notes, f"{path.name}: cannot be read ({'its header is damaged' if content.damage else 'empty'})")
            return
        sealed_stream.require_bounded(content.data)
        for table in _parts(path, content, names, notes, over, cells):
            yield table if content.sealed else _possible(path, table, notes)
    except (pa.ArrowException, OSError, ValueError) as error:
        add_note(notes, f"{path.name}: cannot be read ({_first_line(error)})")


def _parts(
    path: Path, content: sealed_stream.Unsealed, names: Sequence[str] | None, notes: list[str], over: bool, cells: int
) -> Iterator[pa.Table]:
    schema = pa.ipc.open_stream(content.data).schema
    known = {name for name in schema.names if _is_ours(schema, name)}
    wanted = [name for name in (schema.names if names is None else names) if name in known]
    absent = sorted(set(names or ()) - set(wanted))
    if absent:
        add_note(notes, f"{path.name}: written by another version, without {', '.join(absent)}")
    if not wanted:
        return
    waiting: list[pa.RecordBatch] = []
    spans: list[_Span] = []
    rows_max = cells // max(len(wanted), len(names or ()))
    rows = size_bytes = 0  # of what waits
    error: Exception | None = None
    try:
        for batch in sealed_stream.decoded_batches(content.data, wanted):
            if batch.num_rows > _PART_CELLS // len(wanted) or any(column.null_count for column in batch.columns):
                raise pa.ArrowInvalid("a batch that no recorder writes")
            rows, size_bytes = rows + batch.num_rows, size_bytes + batch.nbytes
            if waiting and (rows > rows_max or size_bytes > _PART_BYTES):
                yield pa.Table.from_batches(waiting)
                waiting, rows, size_bytes = [], batch.num_rows, batch.nbytes
            waiting.append(batch)
            spans.append(_span(batch))
    except (pa.ArrowException, OSError, ValueError) as found:
        error = found
    _note_damage(path, content, spans, notes, over, error)
    if waiting:
        yield pa.Table.from_batches(waiting)


def _note_damage(
    path: Path,
    content: sealed_stream.Unsealed,
    spans: Sequence[_Span],
    notes: list[str],
    over: bool,
    error: Exception | None,
) -> None:
    if error is not None:
        add_note(notes, f"{path.name}: damaged or truncated after batch {len(spans)} ({_first_line(error)})")
    if not content.sealed:
        add_note(notes, "tables of an earlier version, without checksums: flipped bytes would go unnoticed")
    for damage in content.damage:
        size_kb = damage.size_bytes / 1e3
        what = "truncated" if damage.at_end and not content.ended else "damaged"
        add_note(notes, f"{path.name}: {what}, {size_kb:.1f} kB: {_rows_lost(spans, damage)} left out")
    if content.sealed and over and not content.ended and not content.damage:
        lost = _rows_lost(spans, sealed_stream.Damage(len(spans), 0, True))
        add_note(notes, f"{path.name}: without its end mark: {lost} missing, if any")


def _is_ours(schema: pa.Schema, name: str) -> bool:
    """Whether a column has the kind that a recorder writes under its name, and is unique."""
    places = schema.get_all_field_indices(name)
    kind = schema.field(places[0]).type
    stored = column_codec.kind_of(schema.field(places[0]))
    if name in _WORDS:
        right = pa.types.is_string(kind)
    elif name in _PLAIN:
        right = stored is None and kind == _PLAIN[name]
    elif name in _LISTS:
        listed = isinstance(kind, (pa.ListType, pa.FixedSizeListType)) and pa.types.is_floating(kind.value_type)
        right = listed if stored is None else stored[0] == _LISTS[name] and stored[1].kind == "f"
    else:
        plain = pa.types.is_floating(kind) or pa.types.is_integer(kind)
        right = plain if stored is None else stored[0] == 1
    return len(places) == 1 and right


def _possible(path: Path, table: pa.Table, notes: list[str]) -> pa.Table:
    """Rows with possible times: without a checksum they may be any number."""
    name = next((name for name in _TIMES if name in table.schema.names), None)
    if name is None:
        return table
    mask = possible_times(table.column(name).to_numpy())
    if not mask.all():
        add_note(notes, f"{path.name}: {np.count_nonzero(~mask)} rows with impossible times are left out")
    return table.filter(pa.array(mask))


def first_s(path: Path, time_name: str) -> float | None:
    """Time of the first row; None if unreadable."""
    times_s = first_column(path, time_name)
    return float(times_s[0]) if times_s.size else None


def first_column(path: Path, name: str) -> FloatArray:
    """A column of the first batch; empty if unreadable."""
    try:
        with open_plain(path) as file:
            content = sealed_stream.unseal(file.read(_LOOK_BYTES))
        sealed_stream.require_bounded(content.data)
        schema = pa.ipc.open_stream(content.data).schema
        if name not in schema.names or not _is_ours(schema, name):
            return np.empty(0)
        batch = next(sealed_stream.decoded_batches(content.data, [name]))
        return np.asarray(batch.column(name).to_numpy(zero_copy_only=False), dtype=np.float64)
    except (pa.ArrowException, OSError, StopIteration, ValueError):
        return np.empty(0)


def written_by(path: Path) -> str:
    """The program that wrote a file; empty if not stated."""
    try:
        with open_plain(path) as file:
            schema = pa.ipc.open_stream(sealed_stream.unseal(file.read(_LOOK_BYTES)).data).schema
        return str((schema.metadata or {}).get(b"program", b"").decode(errors="replace"))
    except (pa.ArrowException, OSError, ValueError):
        return ""


@dataclass(frozen=True, slots=True)
class _Span:
    """Times of a batch's first and last row; None if unknown."""

    first_s: float | None
    last_s: float | None


def _span(batch: pa.RecordBatch) -> _Span:
    name = next((name for name in _TIMES if name in batch.schema.names), None)
    if name is None or not batch.num_rows:
        return _Span(None, None)
    column = batch.column(name)
    return _Span(float(column[0].as_py()), float(column[-1].as_py()))


def _rows_lost(spans: Sequence[_Span], damage: sealed_stream.Damage) -> str:
    """Describe the rows lost in a damaged stretch, by the times around it."""
    after = damage.batches
    last_s = spans[after - 1].last_s if 0 < after <= len(spans) else None
    next_s = spans[after].first_s if after < len(spans) else None
    if last_s is not None and next_s is not None:
        return f"rows between {last_s:.2f} s and {next_s:.2f} s are"
    if last_s is not None:
        return f"rows after {last_s:.2f} s are"
    return "all rows are" if next_s is None else f"rows before {next_s:.2f} s are"


def add_note(notes: list[str], text: str) -> None:
    """Add a line, once."""
    if text not in notes:
        notes.append(text)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


# The rate of a run's ticks: the record is more reliable than a configuration that lost a line.


# Rates in use differ by more.
_DIFFERS = 0.05
# Nobody sets 9.998 Hz; that is clock jitter.
_WHOLE = 0.005


def at_recorded_rate(config: Config, folder: Path, notes: list[str]) -> Config:
    """The configuration with the rate of the run's first minute, if that differs, and a note."""
    said_hz, found_hz = config.loop.rate_hz, recorded_rate_hz(folder)
    if found_hz is None or abs(found_hz / said_hz - 1) <= _DIFFERS:
        return config
    notes.append(
        f"config.toml: loop.rate_hz is {said_hz:g} Hz (or missing), but the record has ticks at "
        f"{found_hz:.4g} Hz, which is used"
    )
    return config.model_copy(update={"loop": config.loop.model_copy(update={"rate_hz": found_hz})})


def recorded_rate_hz(folder: Path) -> float | None:
    """Ticks per second in the tables; None if unknown."""
    for path in column_files(folder, tables.TICKS):
        spacing_s = _spacing_s(path)
        spacing_s = spacing_s[spacing_s > 0]
        if spacing_s.size:
            return _whole(1 / float(np.median(spacing_s)))
    for path in column_files(folder, tables.level_table(1.0)):
        rows = first_column(path, "rows")
        if rows.size:
            return _whole(float(np.median(rows)))
    return None


def _spacing_s(path: Path) -> FloatArray:
    """Time between the deadlines of a file's first ticks: `dt_s` is that plus the jitter of both."""
    dt_s, late_ms = (first_column(path, name) for name in ("dt_s", "lateness_ms"))
    return dt_s[1:] - 1e-3 * np.diff(np.nan_to_num(late_ms)) if late_ms.size == dt_s.size else dt_s


def _whole(rate_hz: float) -> float:
    whole_hz = float(round(rate_hz))
    return whole_hz if abs(rate_hz - whole_hz) <= _WHOLE * rate_hz else rate_hz
