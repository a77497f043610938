"""Rerun segments back to telemetry rows, for a repair and for a replay that differs."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from membrane_ctrl.recording.rows import COLUMN, Rows
from membrane_ctrl.recording.segment_bounds import panics_are_faults, require_bounded
from membrane_ctrl.recording.sink import RUN_TIME
from membrane_ctrl.recording.streams import STREAMS
from membrane_ctrl.telemetry import FIELDS

_SCALARS = "Scalars:scalars"


def read_rows(path: Path) -> Rows:
    """Telemetry rows of a segment, by time; fields that were left out are NaN.

    Parameters
    ----------
    path : Path
        A segment, closed or not. What lies behind damage is not read.

    Returns
    -------
    (n, len(FIELDS)) array
        `mono_s` is the recording's time, in whole nanoseconds.

    Raises
    ------
    RuntimeError, ValueError, OSError
        Rerun's ways to say that nothing can be read.
    """
    where = {stream.path: [COLUMN[line.field] for line in stream.lines] for stream in STREAMS}
    found: dict[str, tuple[list[NDArray[np.int64]], list[Rows]]] = {path: ([], []) for path in where}
    require_bounded(path)
    with warnings.catch_warnings(), panics_are_faults():
        warnings.simplefilter("ignore")  # a segment without its footer is what this is for
        for chunk in RrdReader(path).stream():
            if chunk.entity_path not in where:
                continue
            batch = chunk.to_record_batch()
            if _SCALARS in batch.schema.names and RUN_TIME in batch.schema.names:
                times, values = found[chunk.entity_path]
                times.append(np.asarray(batch.column(RUN_TIME).cast("int64")))
                flat = np.asarray(batch.column(_SCALARS).flatten())
                values.append(flat.reshape(-1, len(where[chunk.entity_path])))
    every = [times for times, _ in found.values() if times]
    if not every:
        return np.empty((0, len(FIELDS)))
    axis_ns = np.unique(np.concatenate([np.concatenate(times) for times in every]))
    rows = np.full((len(axis_ns), len(FIELDS)), np.nan)
    rows[:, COLUMN["mono_s"]] = axis_ns * 1e-9
    for entity, (times, values) in found.items():
        if times:
            places = np.searchsorted(axis_ns, np.concatenate(times))
            rows[places[:, np.newaxis], where[entity]] = np.concatenate(values)
    return rows
