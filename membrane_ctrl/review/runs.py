"""`membrane-ctrl runs`: list, show, prune; `export` for other programs: Parquet, CSV or HDF5;
`mark`.
"""

import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from rich.console import Console
from rich.table import Table

from membrane_ctrl.model import errors, events, plain_json, program, terminal
from membrane_ctrl.model.files import make_folder, move, scratch_folder, write_text_atomic
from membrane_ctrl.model.run_events import Ended, Mark
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.catalogue import (
    beside,
    end_s,
    moment_s,
    not_in,
    number,
    one_line,
    part_s,
    span,
)
from membrane_ctrl.run_files import table_specs
from membrane_ctrl.run_files.run import Run, open_run
from membrane_ctrl.run_files.run_folder import add_mark
from membrane_ctrl.run_files.streams import STREAMS, named_table


def refuse_originals(folder: Path) -> None:
    """Raises InputError if a folder belongs to any run, or to its tables.

    A folder of exported files also has `events.jsonl`, and may be overwritten.
    """
    folder = folder.resolve()
    at = folder.parent if any(folder.name == spec.name for spec in table_specs.ALL) else folder
    if (at / "config.toml").exists() or any(at.glob("*.rrd")) or any(at.glob("ticks/ticks-*")):
        raise errors.InputError(
            f"{folder}: this folder contains the recorder's files; choose another folder"
        )


FORMATS = ("parquet", "csv", "hdf5")
SHAPES = "shapes"
EVENTS = "events"
_SHAPE_COLUMNS = ("hencky_um", "sag_um", "sag_sigma_um", "displacement_um")


def export(
    run: Run,
    to: str,
    out: str | Path,
    streams: Sequence[str] = (),
    start_s: float = -math.inf,
    end_s: float = math.inf,
) -> list[Path]:
    """Write a run's columns.

    Raises InputError if the format or a stream is unknown, h5py is missing, the run has none of the
    requested data, or the folder belongs to a run; DeviceError if the folder cannot be written.

    Parameters
    ----------
    to : str
        One of `FORMATS`.
    out : str or Path
        Folder for the files: `ticks.<format>`, `shapes.<format>`, `events.jsonl`; HDF5 is one file
        `run.h5`.
    streams : sequence of str
        Rerun paths (`/loop/error`), fields (`error_um`), `shapes` or `events`; everything by
        default.
    start_s, end_s : float
        Part of the run.
    """
    if to not in FORMATS:
        raise errors.InputError(f"--format {to}: known: {', '.join(FORMATS)}")
    fields, extras = _selected(streams)
    out = Path(out)
    refuse_originals(out)
    with errors.writing(out, errors.DeviceError):
        make_folder(out)
        # beside existing files, so that a failed export leaves those unchanged
        with scratch_folder(out, ".export-") as folder:
            files = (_hdf5 if to == "hdf5" else _files)(
                run, to, folder, fields, extras, start_s, end_s
            )
            for path in files:
                move(path, out / path.name)
            return [out / path.name for path in files]


def _files(
    run: Run,
    to: str,
    out: Path,
    fields: Sequence[str],
    extras: set[str],
    start_s: float,
    end_s: float,
) -> list[Path]:
    written = []
    if fields:
        blocks = (
            named_table(block, run.origin_utc) for block in run.tick_blocks(fields, start_s, end_s)
        )
        written += _tables(blocks, out / f"ticks.{to}", to, _origin(run))
        _say_if_missing(run, bool(written))
    if SHAPES in extras and (shapes := run.cycles(start_s, end_s)).num_rows:
        written += _tables(iter([shapes]), out / f"shapes.{to}", to, _origin(run))
    if EVENTS in extras and (lines := _event_lines(run, start_s, end_s)):
        path = out / "events.jsonl"
        write_text_atomic(path, "".join(f"{line}\n" for line in lines))
        written.append(path)
    if not written:
        raise _nothing(run)
    return written


def _event_lines(run: Run, start_s: float, end_s: float) -> list[str]:
    return [json.dumps(each.line, ensure_ascii=False) for each in run.log_between(start_s, end_s)]


def _say_if_missing(run: Run, telemetry: bool) -> None:
    if not telemetry:
        run.notes.append("no telemetry in this part of the run: no ticks are exported")


def _nothing(run: Run) -> errors.InputError:
    return errors.InputError(
        "; ".join((f"{run.folder}: nothing to export of the requested data", *run.notes))
    )


def _selected(streams: Sequence[str]) -> tuple[tuple[str, ...], set[str]]:
    """The requested telemetry fields and other tables."""
    if not streams:
        return FIELDS, {SHAPES, EVENTS}
    by_path = {stream.path: [line.field for line in stream.lines] for stream in STREAMS}
    fields: list[str] = []
    extras: set[str] = set()
    for name in streams:
        if name in {SHAPES, EVENTS}:
            extras.add(name)
        elif name in FIELDS:
            fields.append(name)
        elif name in by_path:
            fields += by_path[name]
        else:
            raise errors.InputError(
                f"--streams {name}: known: {', '.join([*by_path, SHAPES, EVENTS])} and "
                "telemetry fields"
            )
    return (tuple(dict.fromkeys(["mono_s", *fields])) if fields else ()), extras


def _origin(run: Run) -> dict[str, str]:
    """Metadata of an exported file; CSV has none."""
    times = {
        "run": run.name,
        "started_utc": run.origin_utc.isoformat(),
        "recorded_by": run.recorded_by,
    }
    return program.file_origin("membrane-export/1") | times


def _tables(tables: Iterator[pa.Table], path: Path, to: str, origin: dict[str, str]) -> list[Path]:
    """Write tables of one schema one after the other; without tables, write nothing."""
    writer = None
    try:
        for table in tables:
            if writer is None:
                make = pa.parquet.ParquetWriter if to == "parquet" else pa.csv.CSVWriter
                writer = make(str(path), table.schema.with_metadata(origin))
            writer.write_table(table.cast(writer.schema) if to == "parquet" else table)
    finally:
        if writer is not None:
            writer.close()
    return [path] if writer is not None else []


def _hdf5(
    run: Run,
    to: str,
    out: Path,
    fields: Sequence[str],
    extras: set[str],
    start_s: float,
    end_s: float,
) -> list[Path]:
    path = out / "run.h5"
    try:
        import h5py
    except ImportError:
        raise errors.InputError(
            f"--format {to} needs h5py: pip install 'membrane-ctrl[sofast]'"
        ) from None
    with h5py.File(path, "w") as file:
        file.attrs.update(_origin(run))
        for block in run.tick_blocks(fields, start_s, end_s) if fields else ():
            for name, values in block.items():
                place = f"ticks/{name}"
                if place not in file:
                    file.create_dataset(
                        place,
                        data=values,
                        maxshape=(None,),
                        chunks=True,
                        compression="gzip",
                        shuffle=True,
                    )
                    continue
                data = file[place]
                data.resize(data.shape[0] + values.size, axis=0)
                data[-values.size :] = values
        if fields:
            _say_if_missing(run, "ticks" in file)
        shapes = run.shapes()
        shapes = shapes.select((shapes.time_s >= start_s) & (shapes.time_s < end_s))
        if SHAPES in extras and len(shapes):
            for name in ("time_s", "coeffs_um", *_SHAPE_COLUMNS):
                file.create_dataset(f"shapes/{name}", data=getattr(shapes, name))
        if EVENTS in extras and (lines := _event_lines(run, start_s, end_s)):
            file.create_dataset("events", data=lines, dtype=h5py.string_dtype())
        empty = not len(file)
    if empty:
        raise _nothing(run)
    return [path]


def list_command(
    logs: Sequence[Path], wanted: catalogue.Filter, since: str | None, until: str | None, json: bool
) -> int:
    """Print the table of the folders' runs that pass a filter, oldest first."""
    wanted = replace(wanted, since_utc=_day(since), until_utc=_day(until))
    folders = {folder.resolve(): folder for folder in logs}  # each once
    found = [entry for folder in folders.values() for entry in catalogue.entries(folder, wanted)]
    found.sort(key=lambda entry: entry.name)  # which begins with its start
    if json:
        print(plain_json.dumps([catalogue.as_dict(entry) for entry in found], indent=1))
    else:
        _console().print(_table(found))
    return 0


def show_command(run: Path, json: bool) -> int:
    """Print one run: its line of the catalogue, its states and faults, its missing parts."""
    opened = open_run(catalogue.resolve(run))
    opened.look_through()
    entry = catalogue.entry(opened.folder)
    if json:
        table = catalogue.as_dict(entry) | {
            "recorded_by": opened.recorded_by,
            "notes": opened.notes,
            "summary": opened.summary,
        }
        print(plain_json.dumps(table, indent=1))
        return 0
    _console().print(_table([entry]))
    if besides := beside(entry.faults_s, entry.paused_s, entry.moving_s, entry.duration_s):
        print(f"  not counted as held: {', '.join(besides)}")
    if opened.recorded_by:
        print(f"  recorded by {one_line(opened.recorded_by)}")
    for each in opened.log:
        match each.event:
            case (
                events.StateEntered(state=said)
                | events.Fault(name=said)
                | Mark(text=said)
                | Ended(exit=said)
            ):
                print(f"  {opened.utc(each.mono_s):%H:%M:%S}  {each.event.kind:6} {one_line(said)}")
    for note in opened.notes:
        print(f"  note: {note}")
    return 0


def prune_command(
    logs: Path, keep_days: float | None, keep_gb: float | None, delete: bool, json: bool
) -> int:
    """List the runs that the retention rule would delete; delete them only with `delete`."""
    gone = catalogue.to_prune(logs, datetime.now(UTC), keep_days, keep_gb)
    stay = catalogue.prune([run for run, _ in gone]) if delete else {}
    gone = [(run, why) for run, why in gone if run.folder not in stay]
    if json:
        table = [
            {"name": run.folder.name, "size_bytes": run.size_bytes, "why": why} for run, why in gone
        ]
        print(plain_json.dumps({"deleted": delete, "runs": table}, indent=1))
    else:
        for run, why in gone:
            print(
                f"{'deleted' if delete else 'would delete'} {run.folder.name}, "
                f"{run.size_bytes / 1e6:.0f} MB: {why}"
            )
        freed_mb = sum(run.size_bytes for run, _ in gone) / 1e6
        print(
            f"{len(gone)} runs, {freed_mb:.0f} MB"
            + ("" if delete or not gone else "; --delete deletes them")
        )
    for folder, why in stay.items():
        print(f"{folder}: cannot be deleted ({why}); check its permissions", file=sys.stderr)
    return errors.Exit.DEVICE_FAILED if stay else 0


def mark_command(words: Sequence[str], at: str | None) -> int:
    """Add a mark to a run's timeline; the words are the run and the text."""
    if len(words) != 2 or at is None:
        raise errors.InputError(
            "review mark: write `review mark RUN TEXT --at 03:12` (TEXT in quotes)"
        )
    if not words[1].strip():
        raise errors.InputError(
            "review mark: TEXT is empty: write `review mark RUN TEXT --at 03:12`"
        )
    opened = open_run(catalogue.resolve(Path(words[0])))
    at_s = moment_s(at, opened.origin_utc)
    if not 0 <= at_s <= end_s(opened):
        raise not_in(opened, f"--at {at}")
    mark = add_mark(opened.folder, opened.origin_utc, at_s, words[1])
    print(f"marked {mark['time_utc']} in {opened.name}")
    return 0


def export_command(
    run: Path, form: str, out: Path | None, streams: list[str], start: str | None, end: str | None
) -> int:
    """Write a run for other programs and report where."""
    opened = open_run(catalogue.resolve(run))
    folder = out.resolve() if out else opened.folder / "export"
    files = export(opened, form, folder, streams, *part_s(opened.origin_utc, start, end))
    for note in opened.notes:
        print(f"note: {note}")
    for path in files:
        print(path)
    return 0


def _day(text: str | None) -> datetime | None:
    """A date or a time, in UTC."""
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise errors.InputError(f"date {text!r}: write 2026-11-21 or 2026-11-21T03:00") from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def _console() -> Console:
    """A console as wide as the terminal or, for a file or pipe, the table."""
    return terminal.table_console(width=None if sys.stdout.isatty() else 170)


def _table(found: list[catalogue.RunEntry]) -> Table:
    """The table; runs of several folders have names from where these part."""
    common = os.path.commonpath([entry.folder.parent for entry in found]) if found else ""
    table = Table(box=None, header_style="bold", pad_edge=False)
    words = {"run", "started, UTC", "configuration", "end"}
    numbers = ("length", "held", "std µm", "in band", "faults", "Kp", "Ti")
    for title in ("run", "started, UTC", *numbers, "configuration", "MB", "end"):
        table.add_column(title, justify="left" if title in words else "right")
    for entry in found:
        table.add_row(
            one_line(str(entry.folder.relative_to(common))),
            f"{entry.started_utc:%Y-%m-%d %H:%M}",
            span(entry.duration_s),
            span(entry.held_s),
            number(entry.std_um),
            "–" if math.isnan(entry.in_band) else f"{100 * entry.in_band:.4g} %",
            str(entry.faults),
            number(entry.kp_per_s),
            number(entry.ti_s),
            entry.configuration,
            f"{entry.size_mb:.1f}",
            one_line(entry.exit)
            + (f" ({one_line(entry.ended_in)})" if entry.ended_in else "")
            + (f", {entry.marks} marked" if entry.marks else "")
            + (", kept" if entry.kept else ""),
        )
    return table
