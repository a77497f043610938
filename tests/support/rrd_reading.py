"""Reads a recording back."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from membrane_ctrl.model.telemetry import COLUMN, FIELDS
from membrane_ctrl.run_files.streams import STREAMS


def scalars(
    path: Path, entity: str, component: str = "Scalars:scalars"
) -> tuple[np.ndarray, np.ndarray]:
    """Times in s of the run (n,) and values (n, m) of one entity, sorted by time."""
    times, values = [], []
    for chunk in reader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component in batch.schema.names and "run_time" in batch.schema.names:
            times += nanoseconds(batch)
            values += batch.column(component).to_pylist()
    order = np.argsort(np.array(times, dtype=np.int64), kind="stable")
    return np.array(times, dtype=np.int64)[order] * 1e-9, np.array(values)[order]


def nanoseconds(batch: object) -> list[int]:
    """Ticks of the run's time axis."""
    return batch.column("run_time").cast("int64").to_pylist()  # type: ignore[attr-defined]


def strings(path: Path, entity: str, component: str) -> list[tuple[float, str]]:
    """(time in s, text) of a text component, sorted by time."""
    found = []
    for chunk in reader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component in batch.schema.names and "run_time" in batch.schema.names:
            texts = [cell[0] for cell in batch.column(component).to_pylist()]
            found += list(zip((tick * 1e-9 for tick in nanoseconds(batch)), texts, strict=True))
    return sorted(found)


def entities(path: Path) -> set[str]:
    """Paths of all entities with data."""
    return {chunk.entity_path for chunk in reader(path).stream()}


def reader(path: Path) -> RrdReader:
    """A reader that accepts a file without footer silently."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return RrdReader(path)


def has_footer(path: Path) -> bool:
    """Whether the file was closed properly."""
    try:
        reader(path).store()
    except (RuntimeError, ValueError):
        return False
    return True


def recorded_rows(path: Path) -> np.ndarray:
    """(n, len(FIELDS)) telemetry rows of a segment, by time; fields not recorded are NaN."""
    found = {stream.path: scalars(path, stream.path) for stream in STREAMS}
    axis_s = np.unique(np.concatenate([times for times, _ in found.values()]))
    rows = np.full((len(axis_s), len(FIELDS)), np.nan)
    rows[:, COLUMN["mono_s"]] = axis_s
    for stream in STREAMS:
        times, values = found[stream.path]
        if len(times):
            places = np.searchsorted(axis_s, times)
            rows[places[:, np.newaxis], [COLUMN[line.field] for line in stream.lines]] = values
    return rows
