"""Small good folders for the fuzzer to spoil: a run of some seconds with every kind of file, and
capture sets.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from membrane_ctrl.cli import run
from membrane_ctrl.config.toml_file import dump_toml
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.file_checksums import add_checksum_comment, dumps_checked
from membrane_ctrl.model.program import file_origin
from membrane_ctrl.model.telemetry import unpack_rows
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.recorder.rerun_recording import LAYOUT, Recording
from membrane_ctrl.recorder.rerun_telemetry import TelemetryStreams
from membrane_ctrl.run_files.summary import Summary
from tests.worlds.virtual_record import CONFIG, kept_ticks, snapshot_at, write_record

RUN = "20261121T010203Z-night"
TUNING = "20261121T010203Z-session"
_SECONDS = 4.0
# large enough for a figure to come out, small enough for a hundred sets a minute
_SET = ("--shrink", "16")


def good_run(logs: Path) -> Path:
    """A run with configuration, events, a mark, tables with inputs and figures, a Rerun segment and
    a summary.
    """
    folder = logs / RUN
    folder.mkdir(parents=True)
    ticks = kept_ticks(_SECONDS)
    write_record(folder, ticks, snapshots={101: snapshot_at(ticks, 101)})
    (folder / "config.toml").write_text(add_checksum_comment(dump_toml(CONFIG)))
    rows = unpack_rows([outputs.row.pack() for _, outputs in ticks])
    summary = Summary.for_config(CONFIG)
    summary.add_rows(rows)
    _write_segment(folder, rows)
    lines = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    stamped = [{"time_utc": "2026-11-21T01:02:03+00:00", **line} for line in lines]
    stamped.append(
        {
            "time_utc": "2026-11-21T01:02:05+00:00",
            "mono_s": 2.0,
            "kind": "fault",
            "name": "laser_lost",
        }
    )
    (folder / "events.jsonl").write_text("".join(f"{dumps_checked(line)}\n" for line in stamped))
    for event in stamped:
        summary.add_event(event)
    files = [path.parent.name for path in folder.glob("*/*.parquet")]
    counts = {"segments": 1, "tables": {table: files.count(table) for table in files}}
    (folder / "summary.json").write_text(dumps_checked(summary.as_dict({}, counts), indent=2))
    mark = {
        "mono_s": 1.0,
        "kind": "mark",
        "text": "door",
        "who": "me",
        "time_utc": "2026-11-21T01:02:04+00:00",
    }
    (folder / "annotations.jsonl").write_text(json.dumps(mark) + "\n")
    return folder


def _write_segment(folder: Path, rows: object) -> None:
    recording = Recording(folder, "night", RunClock.start(), CONFIG)
    streams = TelemetryStreams(recording, CONFIG)
    recording.next_segment()
    streams.start_segment()
    streams.send_rows(rows)  # type: ignore[arg-type]
    recording.close()
    (folder / LAYOUT).unlink(missing_ok=True)


def good_sofast(folder: Path) -> None:
    """A SOFAST measurement `m.h5` of a few pixels."""
    import h5py

    folder.mkdir()
    ramp = np.arange(32, dtype=np.uint8)
    items = {
        "fringe_images": 6 * ramp * np.ones((12, 16, 1), np.uint8),
        "mask_images": np.array([1, 200], np.uint8) * np.ones((12, 16, 1), np.uint8),
        "fringe_periods_x": [0.9, 3.9, 15.9, 63.9],
        "fringe_periods_y": [0.9, 3.9, 15.9, 63.9],
        "dist_optic_screen": np.array([10.5]),
    }
    with h5py.File(folder / "m.h5", "w") as file:
        for name, value in items.items():
            file[f"MeasurementSofastFringe/{name}"] = value


def good_tuning(folder: Path) -> None:
    """Run folders with the journal of a tuning session, all steps of it done on the twin: 30 s of
    computing.
    """
    times = ("--observe", "5m", "--verify", "5m")
    assert run(["tune", "run", "--twin", "--yes", "--logs", str(folder), *times]) in (0, 3)
    (session,) = (folder / "tuning").glob("2*")
    session.rename(session.with_name(TUNING))


def good_track(folder: Path) -> None:
    """A tracking set `track` with its reference `full`, and half a minute of figures in
    `track.npz`.
    """
    assert run(["simulate", str(folder), "--shrink", "12", "--track", "6"]) == 0
    for extra in folder.glob("*/truth.*"):
        extra.unlink()
    figures_um = 1e-3 * np.random.default_rng(1).normal(size=(600, ZERNIKE_TERMS))
    np.savez(folder / "track.npz", time_s=np.arange(600) / 20, coeffs_um=figures_um)


def good_live(folder: Path, sets: Path) -> None:
    """A session of `calibrate --live` that has all its sets."""
    (folder / "sets").mkdir(parents=True)
    for number in (0, 1):
        shutil.copytree(sets / f"{number:04d}", folder / "sets" / f"set-{number + 1}")
    head = {
        **file_origin("membrane-live-calibration/1"),
        "source": "night",
        "created_utc": "2026-11-21T01:02:03+00:00",
        "start_um": 0.0,
        "shape_on": True,
        "setpoints_um": [0.0, 0.0],
    }
    (folder / "session.json").write_text(json.dumps(head))
    (folder / "config.toml").write_text(dump_toml(CONFIG))


def good_sets(folder: Path) -> Path:
    """A full set `0000` and a fringes set `0001` that it anchors."""
    made = folder / "made"
    assert run(["simulate", str(made), *_SET, "--sets", "2"]) == 0
    for extra in made.glob("*/truth.*"):
        extra.unlink()
    return Path(shutil.move(made, folder / "sets"))
