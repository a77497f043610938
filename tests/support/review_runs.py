"""Run folders for the review's tests, written by the recorder's own code."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import Rows
from membrane_ctrl.recorder.rerun_recording import Recording
from membrane_ctrl.recorder.rerun_telemetry import TelemetryStreams
from membrane_ctrl.run_files.run_tables import RunTables
from tests.worlds.nights import CONFIG, Planted, batch_of, night, write_run

NAME = "20261121T180000Z-night"
_SYNC_ROWS = 120


def written(
    logs: Path, hours: float, events: list[Planted] | None = None, seed: int = 1, name: str = NAME
) -> Path:
    """A finished run of so many hours."""
    folder = logs / name
    write_run(folder, iter([night(seed, hours, "typical", events or [])]))
    return folder


def set_summary(folder: Path, **changes: object) -> None:
    """Change keys of `summary.json`."""
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def segment(folder: Path, rows: Rows) -> Path:
    """A Rerun segment of telemetry in the folder, as the recorder writes it, a block a second and
    every tick.
    """
    every = CONFIG.recording.model_copy(update={"quiet_hz": CONFIG.loop.rate_hz})
    config = CONFIG.model_copy(update={"recording": every})
    recording = Recording(folder, "night", RunClock.start(), config)
    recording.next_segment()
    streams = TelemetryStreams(recording, config)
    for first in range(0, len(rows), 10):
        streams.send_rows(rows[first : first + 10])
    recording.close()
    return folder / "night-000.rrd"


def tables(folder: Path, rows: Rows, shapes: list[ShapeEstimate], close: bool = True) -> None:
    """The tables of a run; without `close` as a killed recorder leaves them."""
    made = RunTables(folder)
    for first in range(0, len(rows), 10):
        if first % _SYNC_ROWS == 0:
            made.sync_tables()
        made.add_ticks(batch_of(rows[first : first + 10]))
    for estimate in shapes:
        made.add_shape(estimate)
    made.sync_tables()
    if close:
        made.close()


def same(a: np.ndarray, b: np.ndarray, atol: float) -> bool:
    """Equal within a tolerance, NaN where the other is NaN."""
    return bool(np.allclose(a, b, rtol=1e-6, atol=atol, equal_nan=True))
