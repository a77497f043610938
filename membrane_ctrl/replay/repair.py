"""`repair RUN`: repairs a run after a crash. Originals stay untouched unless a person asks
otherwise.
"""

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.model import errors, file_checksums, files, plain_json, telemetry
from membrane_ctrl.run_files import (
    event_log,
    inputs_file,
    run,
    run_config,
    run_lookup,
    table_specs,
)
from membrane_ctrl.run_files.summary import Summary
from membrane_ctrl.run_files.table_store.reader import TableReader
from membrane_ctrl.run_files.table_store.spec import JOURNAL_SUFFIX
from membrane_ctrl.run_files.table_store.writer import TableWriter

REPAIRED = "repaired"  # below the run: the repaired files
# A recorder writes every second: a run changed more recently is still in progress.
_STILL_RUNNING_S = 5.0


@dataclass(frozen=True, slots=True)
class FileFinding:
    """One file of the run: its state, and the repair made."""

    file: str
    state: str
    action: str


def repair_command(run_dir: Path, in_place: bool, as_json: bool) -> int:
    """Repair a run and print what was found; exit 0 also if nothing was wrong.

    Parameters
    ----------
    run_dir : Path
        Folder of the run.
    in_place : bool
        Replace the damaged files; else repaired ones go to `repaired/`.
    as_json : bool
        Print one JSON object instead of text.

    Raises
    ------
    InputError
        It is not a run folder, or the run is still in progress.
    """
    findings = repair_run(run_dir, in_place)
    if as_json:
        rows = [{"file": f.file, "state": f.state, "action": f.action} for f in findings]
        print(json.dumps({"run": run_dir.resolve().name, "files": rows}))
    else:
        for finding in findings:
            print(
                f"{finding.file:28} {finding.state}{': ' if finding.action else ''}{finding.action}"
            )
    if not in_place and (run_dir / REPAIRED).exists():
        print(
            f"repaired files: {run_dir / REPAIRED}; --in-place replaces the originals",
            file=sys.stderr,
        )
    return int(errors.Exit.DONE)


def repair_run(run_dir: Path, in_place: bool = False) -> list[FileFinding]:
    """Repair every file of a run that a crash may have torn.

    Repaired files go to `repaired/` or replace the originals; the part cut off the event log stays
    beside it as `.torn`. A missing summary is always written in place.

    Parameters
    ----------
    run_dir : Path
        The run.
    in_place : bool
        Replace the originals.

    Returns
    -------
    list of FileFinding
        A finding for each file.

    Raises
    ------
    InputError
        It is no run folder, or the run is still in progress.
    """
    if not (run_dir / "config.toml").is_file():
        raise errors.InputError(f"{run_dir}: not a run folder (no config.toml)")
    _refuse_running(run_dir)
    findings = _repair_events(run_dir, in_place)
    findings += _seal_journals(run_dir, in_place)
    findings += _check_tables(run_dir)
    findings += _check_inputs(run_dir)
    findings += _check_config(run_dir)
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
        files.remove_file(probe)
    except OSError as error:
        raise errors.InputError(
            f"{folder}: cannot be written ({error.strerror}); copy the run first"
        ) from None
    return now_s


def _make_target(path: Path, in_place: bool) -> Path:
    if in_place:
        return path
    return files.make_folder(path.parent / REPAIRED) / path.name


def _repair_events(run_dir: Path, in_place: bool) -> list[FileFinding]:
    """Cut lines that are torn or not intact out of the event log."""
    # What is cut off is kept beside the log: a person may read more from it than a program
    path = run_dir / "events.jsonl"
    if not path.exists():
        return [FileFinding(path.name, "missing", "the run had no events, or the log was lost")]
    data = files.read_bytes(path, event_log.EVENTS_BYTES_MAX)
    good, torn = _split_events(data)
    if not torn:
        return [FileFinding(path.name, "whole", "")]
    target = _make_target(path, in_place)
    files.write_bytes_atomic(target.with_name(f"{path.name}.torn"), torn)
    files.write_bytes_atomic(target, good)
    where = target.relative_to(run_dir)
    return [
        FileFinding(
            path.name, "torn", f"{len(torn)} bytes cut to {where}.torn, the rest in {where}"
        )
    ]


def _split_events(data: bytes) -> tuple[bytes, bytes]:
    """Split into whole lines and the rest: a torn tail, or a block of zeros left by a power cut."""
    good: list[bytes] = []
    torn: list[bytes] = []
    for line in data.splitlines(keepends=True):
        whole = (
            line.endswith(b"\n") and event_log.event_of(line.decode(errors="replace")) is not None
        )
        (good if whole else torn).append(line)
    return b"".join(good), b"".join(torn)


def _is_whole_object(data: bytes) -> bool:
    try:
        table = plain_json.loads(data.decode())
    except ValueError:
        return False
    return isinstance(table, dict) and file_checksums.pop_checksum(table)


def _seal_journals(run_dir: Path, in_place: bool) -> list[FileFinding]:
    """Make parts of the journals that a dead recorder left; only in place, as sealing removes the
    journal.
    """
    findings = []
    for spec in table_specs.ALL:
        left = sorted((run_dir / spec.name).glob(f"*{JOURNAL_SUFFIX}"))
        if left and in_place:
            TableWriter(run_dir, table_specs.with_origin(spec), resumed=True).close()
        action = "readable by `open_run`; --in-place makes parts for other programs"
        if in_place:
            action = "made parts of them"
        if left:
            findings.append(FileFinding(f"{spec.name} ({len(left)} journals)", "open", action))
    return findings


def _check_tables(run_dir: Path) -> list[FileFinding]:
    """Report only: a reader skips what is damaged."""
    findings = []
    for spec in table_specs.ALL:
        notes: list[str] = []
        table = TableReader(run_dir, spec, notes)
        table.note_missing()
        table.check_all()
        for _ in table.iterate_tables():
            pass
        findings += [FileFinding(spec.name, "damaged", note) for note in notes]
    return findings


def _check_inputs(run_dir: Path) -> list[FileFinding]:
    """Report only: a replay reads whatever is intact."""
    reader = inputs_file.InputsReader(run_dir)
    ticks = sum(len(frame.records) for frame in reader)
    if reader.damage:
        return [FileFinding("inputs", "torn", f"{ticks} ticks are readable")]
    if not reader.exists:
        return []
    return [FileFinding("inputs", "whole", f"{ticks} ticks")]


def _check_config(run_dir: Path) -> list[FileFinding]:
    """Report only: a rebuilt summary uses defaults for settings that cannot be read."""
    notes: list[str] = []
    run_config.read_config(run_dir, notes)
    if not notes:
        return []
    return [FileFinding("config.toml", "damaged", "; ".join(notes))]


def _repair_summary(run_dir: Path, in_place: bool) -> FileFinding:
    path = run_dir / "summary.json"
    there = path.is_symlink() or path.exists()
    if there and _is_whole_object(files.read_bytes(path, files.SMALL_BYTES)):
        return FileFinding(path.name, "whole", "")
    table = rebuild_summary(run_dir)
    target = _make_target(path, in_place or not there)
    files.write_text_atomic(target, plain_json.dumps(table, indent=2) + "\n")
    state = "unreadable" if there else "missing"
    return FileFinding(
        path.name, state, f"rebuilt from {table['ticks']} ticks: {target.relative_to(run_dir)}"
    )


def rebuild_summary(run_dir: Path) -> dict[str, Any]:
    """Rebuild `summary.json` from the files on disk, marked `"rebuilt": true`."""
    summary = Summary.for_config(run_config.read_config(run_dir, []))
    # Rows may be on disk twice, if the recorder was replaced: each time counts once.
    path = run_dir / "events.jsonl"
    last_s = -np.inf
    for rows in _all_rows(run_dir):
        new = rows[telemetry.get_column(rows, "mono_s") > last_s]
        if len(new):
            last_s = float(new[-1, telemetry.COLUMN["mono_s"]])
            summary.add_rows(new[np.isfinite(telemetry.get_column(new, "state"))])
    # Shapes are in the controller's inputs, events in their log up to its last whole line.
    ticks = 0
    for frame in inputs_file.InputsReader(run_dir):
        ticks += len(frame.records)
        for estimate in frame.estimates.values():
            summary.add_shape(estimate)
    if path.exists():
        good, _ = _split_events(files.read_bytes(path, event_log.EVENTS_BYTES_MAX))
    else:
        good, _ = b"", b""
    for line in good.splitlines():
        summary.add_event(event_log.event_of(line.decode()) or {})
    table = summary.as_dict({}, {})
    table["ticks"] = max(table["ticks"], ticks)
    return {**table, "exit": table["exit"] or "crashed", "rebuilt": True}


def _all_rows(run_dir: Path) -> Iterator[telemetry.Rows]:
    """Every tick of the tables."""
    if not run_lookup.is_run(run_dir):
        return
    for block in run.open_run(run_dir).tick_blocks(telemetry.FIELDS):
        yield np.column_stack([block[name] for name in telemetry.FIELDS])
