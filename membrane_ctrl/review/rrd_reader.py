"""Telemetry and shapes out of Rerun segments: for runs without tables, and for a killed run's last minute.

Slow against the tables (a chunk an entity a second), but everything is in there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rerun.chunk import Chunk

from membrane_ctrl.recording.streams import (
    LATENCY,
    MODULATION,
    QUALITY,
    RESIDUAL,
    SAG,
    SHAPE_STREAMS,
    STREAMS,
    ZERNIKE,
)
from membrane_ctrl.review.column_reader import add_note
from membrane_ctrl.review.possible_times import possible_times
from membrane_ctrl.review.rrd_salvage import FAULTS, read_chunks, salvage

Column = NDArray[np.float64]
REPAIRED = "repaired"  # below the run: what `repair` made of damaged files
_VALUES = "Scalars:scalars"
_TIME = "run_time"


def segments(folder: Path) -> list[Path]:
    """The run's Rerun segments in their order."""
    return sorted(folder.glob("*.rrd"))


def read_ticks(path: Path, names: Sequence[str], notes: list[str]) -> dict[str, Column]:
    """Columns of telemetry from one segment, on the ticks of `/tick/record`; NaN where a stream has no row.

    Parameters
    ----------
    path : Path
        Segment.
    names : sequence of str
        Fields of `TelemetryRow`, `mono_s` among them.
    notes : list
        Gets a line when the segment is damaged.
    """
    wanted = {stream.path: stream for stream in STREAMS if any(line.field in names for line in stream.lines)}
    found = _scalars(path, {*wanted, "/tick/record"}, notes)
    if "/tick/record" not in found:
        return {name: np.empty(0) for name in names}
    clock_ns = found["/tick/record"][0]
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
    """Shape estimates of one segment: `time_s`, `coeffs_um` (n, 36), changes of sag and laser, quality."""
    found = _scalars(path, {stream.path for stream in SHAPE_STREAMS}, notes)
    if ZERNIKE.path not in found:
        return {}
    clock_ns, coeffs_um = found[ZERNIKE.path]

    def at(entity: str, place: int) -> Column:
        values = np.full(clock_ns.size, np.nan)
        times, rows = found.get(entity, (clock_ns[:0], np.empty((0, place + 1))))
        _, here, there = np.intersect1d(clock_ns, times, return_indices=True)
        values[here] = rows[there, place]
        return values

    sag_um = at(SAG.path, 0)
    return {
        "time_s": _seconds(clock_ns),
        "coeffs_um": coeffs_um,
        "sag_um": sag_um,
        "sag_sigma_um": at(SAG.path, 1) - sag_um,
        "displacement_um": at(SAG.path, 3),
        "slope_residual_urad": at(RESIDUAL.path, 0),
        "valid_fraction": at(QUALITY.path, 0),
        "saturated_fraction": at(QUALITY.path, 1),
        "modulation_median_adu": at(MODULATION.path, 0),
        "latency_s": at(LATENCY.path, 0) * 1e-3,
    }


def _seconds(clock_ns: NDArray[np.int64]) -> Column:
    return np.asarray(clock_ns * 1e-9, dtype=np.float64)


def _scalars(path: Path, entities: set[str], notes: list[str]) -> dict[str, tuple[NDArray[np.int64], Column]]:
    """(times in ns, (n, m) values) of each entity with scalars, sorted by time."""
    parts: dict[str, list[tuple[NDArray[np.int64], Column]]] = {}
    for entity, times, values in _chunks(path, entities, notes):
        parts.setdefault(entity, []).append((times, values))
    joined = {}
    for entity, chunks in parts.items():
        times = np.concatenate([chunk[0] for chunk in chunks])
        values = np.concatenate([chunk[1] for chunk in chunks])
        possible = possible_times(_seconds(times))
        if not possible.all():
            add_note(notes, f"{path.name}: rows with impossible times are left out")
            times, values = times[possible], values[possible]
        order = np.argsort(times, kind="stable")
        joined[entity] = (times[order], values[order])
    return joined


def _chunks(path: Path, entities: set[str], notes: list[str]) -> Iterator[tuple[str, NDArray[np.int64], Column]]:
    for chunk in _readable(path, entities, notes):
        batch = chunk.to_record_batch()
        if _VALUES not in batch.schema.names or _TIME not in batch.schema.names:
            continue
        cells = batch.column(_VALUES)
        values = cells.flatten().to_numpy(zero_copy_only=False).reshape(batch.num_rows, -1)
        yield chunk.entity_path, batch.column(_TIME).cast("int64").to_numpy(), values


def _readable(path: Path, entities: set[str], notes: list[str]) -> list[Chunk]:
    try:
        return read_chunks(path, entities)
    except FAULTS as error:
        why = str(error).splitlines()[0].removeprefix(f"Failed to read RRD file at {path}: ")[:120]
    try:
        chunks = read_chunks(path.parent / REPAIRED / path.name, entities)
    except FAULTS:
        pass
    else:
        add_note(notes, f"{path.name}: damaged or cut short, read from its copy in {REPAIRED}/ ({why})")
        return chunks
    try:
        chunks, lost_bytes = salvage(path, entities)
    except OSError as error:
        why, chunks, lost_bytes = error.strerror or str(error), [], 0
    what = f"{lost_bytes / 1e3:.1f} kB of it are left out" if chunks else "nothing of it can be read"
    add_note(notes, f"{path.name}: damaged or cut short, {what} ({why})")
    return chunks
