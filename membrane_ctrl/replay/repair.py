"""`repair RUN`: repairs a run after a crash. Originals stay untouched unless a person asks otherwise."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.model import errors, files, plain_json, telemetry
from membrane_ctrl.model.arrays import IntArray
from membrane_ctrl.recorder import housekeeping
from membrane_ctrl.run_files import column_reader, inputs_file, run, run_folder, streams, tables
from membrane_ctrl.run_files.rrd_reader import REPAIRED
from membrane_ctrl.run_files.segment_process import is_whole, read_parts
from membrane_ctrl.run_files.segments import require_bounded
from membrane_ctrl.run_files.summary import Summary

# Rerun segments back to telemetry rows, for repairs and for replays that differ.


_SCALARS = "Scalars:scalars"


def read_rows(path: Path) -> telemetry.Rows:
    """(n, len(FIELDS)) telemetry rows of a segment, by time in whole nanoseconds; fields not recorded are NaN.

    Stops at damage. Raises RuntimeError, ValueError or OSError (Rerun uses all three) if nothing can be
    read.
    """
    where = {stream.path: [telemetry.COLUMN[line.field] for line in stream.lines] for stream in streams.STREAMS}
    found: dict[str, tuple[list[IntArray], list[telemetry.Rows]]] = {path: ([], []) for path in where}
    for part in read_parts(path, set(where)):
        if part.component == _SCALARS and part.values.shape[1] == len(where[part.entity]):
            times, values = found[part.entity]
            times.append(part.times_ns)
            values.append(part.values)
    every = [times for times, _ in found.values() if times]
    if not every:
        return np.empty((0, len(telemetry.FIELDS)))
    axis_ns = np.unique(np.concatenate([np.concatenate(times) for times in every]))
    rows = np.full((len(axis_ns), len(telemetry.FIELDS)), np.nan)
    rows[:, telemetry.COLUMN["mono_s"]] = axis_ns * 1e-9
    for entity, (times, values) in found.items():
        if times:
            places = np.searchsorted(axis_ns, np.concatenate(times))
            rows[places[:, np.newaxis], where[entity]] = np.concatenate(values)
    return rows


# A recorder writes every second: a run changed more recently is still in progress.
_STILL_RUNNING_S = 5.0
_SEGMENT_TIMEOUT_S = 3600.0


@dataclass(frozen=True, slots=True)
class FileFinding:
    """One file of the run: its state, and the repair made."""

    file: str
    state: str
    action: str


def repair_command(run_dir: Path, in_place: bool, as_json: bool) -> int:
    """Repair and report; exit 0 also if nothing was wrong.

    Raises InputError if it is not a run folder, or the run is still in progress.
    """
    findings = repair(run_dir, in_place)
    if as_json:
        rows = [{"file": f.file, "state": f.state, "action": f.action} for f in findings]
        print(json.dumps({"run": run_dir.resolve().name, "files": rows}))
    else:
        for finding in findings:
            print(f"{finding.file:28} {finding.state}{': ' if finding.action else ''}{finding.action}")
    if not in_place and (run_dir / REPAIRED).exists():
        print(f"repaired files: {run_dir / REPAIRED}; --in-place replaces the originals", file=sys.stderr)
    return int(errors.Exit.DONE)


def repair(run_dir: Path, in_place: bool = False) -> list[FileFinding]:
    """Repair every file of a run that a crash may have torn.

    Repaired files go to `repaired/` or replace the originals; the part cut off the event log stays beside it as
    `.torn`. A missing summary is always written in place.
    """
    if not (run_dir / "config.toml").is_file():
        raise errors.InputError(f"{run_dir}: not a run folder (no config.toml)")
    _refuse_running(run_dir)
    segments = sorted(run_dir.glob("*.rrd"))
    findings = [_repair_segment(path, in_place) for path in segments]
    findings += _repair_events(run_dir, in_place)
    findings += _look_at_inputs(run_dir)
    findings += _look_at_config(run_dir)
    return [*findings, _repair_summary(run_dir, in_place)]


def _refuse_running(run_dir: Path) -> None:
    state = run_dir / ".recorder-state"
    if state.exists():
        age_s = _now_s(run_dir) - state.stat().st_mtime
        if 0 <= age_s < _STILL_RUNNING_S:
            raise errors.InputError(f"{run_dir}: this run is still being recorded; stop it first")


def _now_s(folder: Path) -> float:
    """The file system's own time, which may differ from ours on a network disk."""
    probe = folder / ".probe"
    try:
        with files.fresh_file(probe) as file:
            now_s = os.fstat(file.fileno()).st_mtime
        files.remove(probe)
    except OSError as error:
        raise errors.InputError(f"{folder}: cannot be written ({error.strerror}); copy the run first") from None
    return now_s


def _target(path: Path, in_place: bool) -> Path:
    if in_place:
        return path
    return files.make_folder(path.parent / REPAIRED) / path.name


def _repair_segment(path: Path, in_place: bool) -> FileFinding:
    try:
        require_bounded(path)
    except OSError as error:
        return FileFinding(path.name, "torn", f"nothing could be recovered ({error.strerror})")
    if is_whole(path):
        return FileFinding(path.name, "whole", "")
    with files.scratch_folder(path.parent, ".repair-") as folder:
        part = folder / path.name
        done = subprocess.run(
            housekeeping.optimize_command(path, part, "--continue-on-error"),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=housekeeping.quiet_environment(),
            timeout=_SEGMENT_TIMEOUT_S,
            check=False,
        )
        if not part.exists() or not is_whole(part):
            why = done.stderr.decode(errors="replace").strip().splitlines()
            return FileFinding(
                path.name, "torn", f"nothing could be recovered ({why[-1] if why else 'no data in it'})"
            )
        target = _target(path, in_place)
        files.move(part, target)
    return FileFinding(path.name, "torn", f"recovered to {target.relative_to(path.parent)}")


def _repair_events(run_dir: Path, in_place: bool) -> list[FileFinding]:
    path = run_dir / "events.jsonl"
    if not path.exists():
        return [FileFinding(path.name, "missing", "the run had no events, or the log was lost")]
    data = files.read_bytes(path, run_folder.EVENTS_BYTES_MAX)
    good, torn = _split_events(data)
    if not torn:
        return [FileFinding(path.name, "whole", "")]
    target = _target(path, in_place)
    files.write_bytes_atomic(target.with_name(f"{path.name}.torn"), torn)
    files.write_bytes_atomic(target, good)
    where = target.relative_to(run_dir)
    return [FileFinding(path.name, "torn", f"{len(torn)} bytes cut to {where}.torn, the rest in {where}")]


def _split_events(data: bytes) -> tuple[bytes, bytes]:
    """Split into whole lines and the rest: a torn tail, or a block of zeros left by a power cut."""
    good: list[bytes] = []
    torn: list[bytes] = []
    for line in data.splitlines(keepends=True):
        whole = line.endswith(b"\n") and run_folder.event_of(line.decode(errors="replace")) is not None
        (good if whole else torn).append(line)
    return b"".join(good), b"".join(torn)


def _is_whole_object(data: bytes) -> bool:
    try:
        table = plain_json.loads(data.decode())
    except ValueError:
        return False
    return isinstance(table, dict) and plain_json.take_checksum(table)


def _look_at_inputs(run_dir: Path) -> list[FileFinding]:
    """Report only: a replay reads whatever is intact."""
    reader = inputs_file.InputsReader(run_dir)
    ticks = sum(len(frame.records) for frame in reader)
    name = f"inputs ({len(reader.paths)} files)"
    if reader.damage:
        return [FileFinding(name, "torn", f"{ticks} ticks are readable; {'; '.join(reader.damage)}")]
    return [FileFinding(name, "whole", f"{ticks} ticks")] if reader.paths else []


def _look_at_config(run_dir: Path) -> list[FileFinding]:
    """Report only: a rebuilt summary uses defaults for settings that cannot be read."""
    notes: list[str] = []
    run_folder.read_config(run_dir, notes)
    return [FileFinding("config.toml", "damaged", "; ".join(notes))] if notes else []


def _repair_summary(run_dir: Path, in_place: bool) -> FileFinding:
    path = run_dir / "summary.json"
    there = path.is_symlink() or path.exists()
    if there and _is_whole_object(files.read_bytes(path, files.SMALL_BYTES)):
        return FileFinding(path.name, "whole", "")
    table = rebuild_summary(run_dir)
    target = _target(path, in_place or not there)
    files.write_text_atomic(target, plain_json.dumps(table, indent=2) + "\n")
    state = "unreadable" if there else "missing"
    return FileFinding(path.name, state, f"rebuilt from {table['ticks']} ticks: {target.relative_to(run_dir)}")


def rebuild_summary(run_dir: Path) -> dict[str, Any]:
    """Rebuild `summary.json` from the files on disk, marked `"rebuilt": true`.

    Without tables, the statistics lack the ticks that Rerun does not record (in quiet times).
    """
    summary = Summary(run_folder.read_config(run_dir, []))
    path = run_dir / "events.jsonl"
    last_s = -np.inf
    for rows in _all_rows(run_dir):
        new = rows[telemetry.column(rows, "mono_s") > last_s]
        if len(new):
            last_s = float(new[-1, telemetry.COLUMN["mono_s"]])
            summary.add_rows(new[np.isfinite(telemetry.column(new, "state"))])
    ticks = 0
    for frame in inputs_file.InputsReader(run_dir):
        ticks += len(frame.records)
        for estimate in frame.estimates.values():
            summary.add_shape(estimate)
    good, _ = _split_events(files.read_bytes(path, run_folder.EVENTS_BYTES_MAX)) if path.exists() else (b"", b"")
    for line in good.splitlines():
        summary.add_event(run_folder.event_of(line.decode()) or {})
    table = summary.as_dict({}, {"segments": len(_segments(run_dir))})
    table["ticks"] = max(table["ticks"], ticks)
    return {**table, "exit": table["exit"] or "crashed", "rebuilt": True}


def _segments(run_dir: Path) -> Sequence[Path]:
    """Each segment once, in its repaired form if there is one."""
    repaired = run_dir / REPAIRED
    paths = sorted(run_dir.glob("*.rrd"))
    return [repaired / path.name if (repaired / path.name).exists() else path for path in paths]


def _all_rows(run_dir: Path) -> Iterator[telemetry.Rows]:
    """Every tick of the tables; without tables, the rows of all readable segments."""
    if column_reader.column_files(run_dir, tables.TICKS):
        for block in run.open_run(run_dir).tick_blocks(telemetry.FIELDS):
            yield np.column_stack([block[name] for name in telemetry.FIELDS])
        return
    for path in _segments(run_dir):
        try:
            yield read_rows(path)
        except (RuntimeError, ValueError, OSError):  # Rerun raises any of these for an unreadable file
            continue
