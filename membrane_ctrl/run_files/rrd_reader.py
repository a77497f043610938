"""Telemetry and shapes from Rerun segments: for runs without tables, and for a killed run's last minute.

Slow compared with the tables (a chunk per entity and second), but complete.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from membrane_ctrl.model.arrays import Column, IntArray
from membrane_ctrl.run_files import column_reader, streams
from membrane_ctrl.run_files.segment_process import SegmentPart, read_parts, require_decodable
from membrane_ctrl.run_files.segment_salvage import salvage
from membrane_ctrl.run_files.segments import FAULTS, ending

REPAIRED = "repaired"  # below the run: files repaired by `repair`
_CHECKED = "damaged"  # found by a check alone
_VARIANCES = "Measurements:variances"


def segments(folder: Path) -> list[Path]:
    """The run's Rerun segments, in order."""
    return sorted(folder.glob("*.rrd"))


def read_ticks(path: Path, names: Sequence[str], notes: list[str]) -> dict[str, Column]:
    """Read telemetry columns from one segment, on the ticks of `/tick/record`; NaN where a stream has no row.

    Parameters
    ----------
    path : Path
        Segment.
    names : sequence of str
        Fields of `TelemetryRow`, `mono_s` among them.
    notes : list
        Gets a line if the segment is damaged.
    """
    wanted = {stream.path: stream for stream in streams.STREAMS if any(line.field in names for line in stream.lines)}
    found = _scalars(path, {*wanted, "/tick/record"}, notes)
    if "/tick/record" not in found:
        return {name: np.empty(0) for name in names}
    clock_ns = found["/tick/record"][0]
    if not clock_ns.size:
        return {name: np.empty(0) for name in names}
    columns: dict[str, Column] = {"mono_s": _seconds(clock_ns)}
    for entity, stream in wanted.items():
        times, values = found.get(entity, (clock_ns[:0], np.empty((0, len(stream.lines)))))
        rows = np.searchsorted(clock_ns, times)
        there = (rows < clock_ns.size) & (clock_ns[np.minimum(rows, clock_ns.size - 1)] == times)
        for place, line in enumerate(stream.lines):
            column = np.full(clock_ns.size, np.nan)
            if place < values.shape[1]:
                column[rows[there]] = values[there, place]
            columns[line.field] = column
    return {name: columns.get(name, np.full(clock_ns.size, np.nan)) for name in names}


def read_shapes(path: Path, notes: list[str]) -> dict[str, Column]:
    """Read one segment's shape estimates: `time_s`, `coeffs_um` (n, terms), changes of sag and laser, quality."""
    found = _scalars(path, {stream.path for stream in (*streams.SHAPE_STREAMS, streams.SAG)}, notes)
    if streams.ZERNIKE.path not in found:
        return {}
    clock_ns, coeffs_um = found[streams.ZERNIKE.path]

    def at(entity: str, place: int) -> Column:
        values = np.full(clock_ns.size, np.nan)
        times, rows = found.get(entity, (clock_ns[:0], np.empty((0, place + 1))))
        _, here, there = np.intersect1d(clock_ns, times, return_indices=True)
        values[here] = rows[there, place]
        return values

    return {
        "time_s": _seconds(clock_ns),
        "coeffs_um": coeffs_um,
        "sag_um": at(streams.SAG.path, 0),
        "sag_sigma_um": np.sqrt(np.maximum(at(streams.SAG.path + _VARIANCES, 0), 0.0)),
        "displacement_um": at(streams.SAG.path, 1),
        "slope_residual_urad": at(streams.RESIDUAL.path, 0),
        "valid_fraction": at(streams.QUALITY.path, 0),
        "saturated_fraction": at(streams.QUALITY.path, 1),
        "modulation_median_adu": at(streams.MODULATION.path, 0),
        "latency_s": at(streams.LATENCY.path, 0) * 1e-3,
    }


def check_segments(folder: Path, limit_s: float, notes: list[str]) -> None:
    """Decode the run's segments to find damage in them, for `limit_s` at most; notes what it finds.

    A segment that is noted already is not read again.
    """
    until_s = time.monotonic() + limit_s
    paths = [path for path in segments(folder) if not any(note.startswith(f"{path.name}:") for note in notes)]
    for place, path in enumerate(paths):
        if time.monotonic() > until_s:
            notes.append(f"{path.name}: not checked for damage, as {len(paths) - place - 1} others, for lack of time")
            return
        try:
            require_decodable(path)
        except FAULTS as error:
            column_reader.add_note(notes, f"{path.name}: {_CHECKED} ({_one_line(error)})")


def _one_line(error: BaseException) -> str:
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0][:120]


def _seconds(clock_ns: IntArray) -> Column:
    return np.asarray(clock_ns * 1e-9, dtype=np.float64)


def _scalars(path: Path, entities: set[str], notes: list[str]) -> dict[str, tuple[IntArray, Column]]:
    """(times in ns, (n, m) values) of each scalar entity, sorted by time."""
    parts: dict[str, list[tuple[IntArray, Column]]] = {}
    for part in _readable(path, entities, notes):
        # variances are kept as those of another entity
        entity = part.entity + (part.component if part.component == _VARIANCES else "")
        parts.setdefault(entity, []).append((part.times_ns, part.values))
    joined = {}
    for entity, found in parts.items():
        width = _usual_width(found)
        fitting = [part for part in found if part[1].shape[1] == width]
        if len(fitting) < len(found):
            column_reader.add_note(notes, f"{path.name}: rows with another number of values are left out")
        times = np.concatenate([part[0] for part in fitting])
        values = np.concatenate([part[1] for part in fitting])
        possible = column_reader.possible_times(_seconds(times))
        if not possible.all():
            column_reader.add_note(notes, f"{path.name}: rows with impossible times are left out")
            times, values = times[possible], values[possible]
        order = np.argsort(times, kind="stable")
        joined[entity] = (times[order], values[order])
    return joined


def _usual_width(parts: list[tuple[IntArray, Column]]) -> int:
    """Values in a row of an entity: those of most rows."""
    rows: dict[int, int] = {}
    for times, values in parts:
        rows[values.shape[1]] = rows.get(values.shape[1], 0) + times.size
    return max(rows, key=lambda width: rows[width])


def _readable(path: Path, entities: set[str], notes: list[str]) -> list[SegmentPart]:
    whole = None
    try:
        parts = read_parts(path, entities)
        closed, rest = ending(path)
        if closed:
            return parts
        whole, why = (None, f"it ends {rest} bytes into a message") if rest else (parts, "it has no end")
    except FAULTS as error:
        why = _one_line(error)
    try:
        parts = read_parts(path.parent / REPAIRED / path.name, entities)
    except FAULTS:
        pass
    else:
        column_reader.add_note(notes, f"{path.name}: damaged or truncated, read from its copy in {REPAIRED}/ ({why})")
        return parts
    if whole is not None:
        column_reader.add_note(notes, f"{path.name}: has no end: still written, cut off, or its recorder killed")
        return whole
    try:
        parts, lost_bytes = salvage(path, entities)
    except OSError as error:
        why, parts, lost_bytes = error.strerror or str(error), [], 0
    readable = bool(parts) or 0 < lost_bytes < path.lstat().st_size
    notes[:] = [note for note in notes if not note.startswith(f"{path.name}: {_CHECKED} (")]  # this says more
    what = f"{lost_bytes / 1e3:.1f} kB of it are left out" if readable else "all of it unreadable"
    column_reader.add_note(notes, f"{path.name}: damaged or truncated, {what} ({why})")
    return parts


# Reads a part of a run's telemetry, opening only the Rerun segments that may hold some of it.


Block = dict[str, Column]


def segment_blocks(
    folder: Path, names: Sequence[str], start_s: float, end_s: float, notes: list[str]
) -> Iterator[Block]:
    """Telemetry of the segments from `start_s` up to `end_s`, one block each; notes damage."""
    paths = segments(folder)
    first = _last_begun(paths, start_s) if np.isfinite(start_s) else 0
    last = _last_begun(paths, end_s) if np.isfinite(end_s) else len(paths) - 1
    for path in paths[first : last + 1]:
        block = cut(read_ticks(path, names, notes), "mono_s", start_s, end_s)
        if block["mono_s"].size:
            yield block


def cut(block: Block, time_name: str, start_s: float, end_s: float) -> Block:
    """Rows of a block from `start_s` up to `end_s`."""
    time_s = block[time_name]
    first, last = np.searchsorted(time_s, [start_s, end_s])
    if first == 0 and last == time_s.size:
        return block
    return {name: values[first:last] for name, values in block.items()}


def _last_begun(paths: Sequence[Path], time_s: float) -> int:
    """Number of the last segment that starts before a time, or of the first one, by bisection."""
    low, high = 0, len(paths)
    while high - low > 1:
        middle = (low + high) // 2
        # a segment without a time has no rows: use the next one's time
        looks = ((place, _first_s(paths[place])) for place in range(middle, high))
        place, begins_s = next(((place, at_s) for place, at_s in looks if at_s is not None), (middle, np.inf))
        low, high = (place, high) if begins_s <= time_s else (low, middle)
    return low


def _first_s(path: Path) -> float | None:
    """Time of the first tick. Damage is not noted yet: it may be far from the part being read."""
    times_s = read_ticks(path, ["mono_s"], [])["mono_s"]
    return float(times_s[0]) if times_s.size else None
