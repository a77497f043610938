"""Small good folders for the fuzzer to spoil: a run of some seconds with every kind of file, and capture sets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from membrane_ctrl.cli import run
from membrane_ctrl.config.toml_file import dump
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.plain_json import dumps_checked, with_comment
from membrane_ctrl.model.telemetry import unpack
from membrane_ctrl.recorder.rerun_streams import TelemetryStreams
from membrane_ctrl.recorder.sink import LAYOUT, Recording
from membrane_ctrl.run_files.summary import Summary
from membrane_ctrl.run_files.tables import ColumnTables
from tests.support.synthetic_run import shape_of
from tests.support.virtual_record import CONFIG, kept_ticks, memory_at, write_record

RUN = "20261121T010203Z-night"
_SECONDS = 4.0
# large enough for a figure to come out, small enough for a hundred sets a minute
_SET = ("--shrink", "16")


def good_run(logs: Path) -> Path:
    """A run with configuration, inputs, events, a mark, tables with figures, a Rerun segment and a summary."""
    folder = logs / RUN
    folder.mkdir(parents=True)
    ticks = kept_ticks(_SECONDS)
    write_record(folder, ticks, memories={101: memory_at(ticks, 101)})
    (folder / "config.toml").write_text(with_comment(dump(CONFIG)))
    rows = unpack([outputs.row.pack() for _, outputs in ticks])
    tables, summary = ColumnTables(folder), Summary(CONFIG)
    tables.add_rows(rows)
    summary.add_rows(rows)
    for cycle in range(4):
        tables.add_shape(shape_of(float(cycle), cycle))
    tables.close()
    _write_segment(folder, rows)
    lines = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    stamped = [{"time_utc": "2026-11-21T01:02:03+00:00", **line} for line in lines]
    stamped.append({"time_utc": "2026-11-21T01:02:05+00:00", "mono_s": 2.0, "kind": "fault", "name": "laser_lost"})
    (folder / "events.jsonl").write_text("".join(f"{dumps_checked(line)}\n" for line in stamped))
    for event in stamped:
        summary.add_event(event)
    counts = {"segments": 1, "tables": tables.files}
    (folder / "summary.json").write_text(dumps_checked(summary.as_dict({}, counts), indent=2))
    mark = {"mono_s": 1.0, "kind": "mark", "text": "door", "who": "me", "time_utc": "2026-11-21T01:02:04+00:00"}
    (folder / "annotations.jsonl").write_text(json.dumps(mark) + "\n")
    return folder


def _write_segment(folder: Path, rows: object) -> None:
    recording = Recording(folder, "night", RunClock.start(), CONFIG)
    streams = TelemetryStreams(recording, CONFIG)
    recording.next_segment()
    streams.start_segment()
    streams.send(rows)  # type: ignore[arg-type]
    recording.close()
    (folder / LAYOUT).unlink(missing_ok=True)


def good_sets(folder: Path) -> Path:
    """A full set `0000` and a fringes set `0001` that it anchors."""
    made = folder / "made"
    assert run(["simulate", str(made), *_SET, "--sets", "2"]) == 0
    for extra in made.glob("*/truth.*"):
        extra.unlink()
    return Path(shutil.move(made, folder / "sets"))
