"""`membrane-ctrl review export`: writes a run for other programs as Parquet, CSV or HDF5."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from membrane_ctrl.model import errors, program
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.files import make_folder, move_file, scratch_folder, write_text_atomic
from membrane_ctrl.model.optional import import_optional
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.review import catalogue
from membrane_ctrl.review.run_times import part_s
from membrane_ctrl.run_files import table_specs
from membrane_ctrl.run_files.named_tables import named_table
from membrane_ctrl.run_files.run import Run, open_run
from membrane_ctrl.run_files.streams import STREAMS

FORMATS = ("parquet", "csv", "hdf5")
SHAPES = "shapes"
EVENTS = "events"
_SHAPE_COLUMNS = ("hencky_um", "sag_um", "sag_change_sigma_um", "displacement_um")


def refuse_originals(folder: Path) -> None:
    """Raises InputError if a folder belongs to any run, or to its tables.

    A folder of exported files also has `events.jsonl`, and may be overwritten.
    """
    folder = folder.resolve()
    if any(folder.name == spec.name for spec in table_specs.ALL):
        at = folder.parent
    else:
        at = folder
    if (at / "config.toml").exists() or any(at.glob("*.rrd")) or any(at.glob("ticks/ticks-*")):
        raise errors.InputError(
            f"{folder}: this folder contains the recorder's files; choose another folder"
        )


def export_run(
    run: Run,
    to: str,
    out: str | Path,
    streams: Sequence[str] = (),
    start_s: float = -math.inf,
    end_s: float = math.inf,
) -> list[Path]:
    """Write a run's columns.

    Parameters
    ----------
    run : Run
        The run; notes on missing parts are added to it.
    to : str
        One of `FORMATS`.
    out : str or Path
        Folder for the files: `ticks.<format>`, `shapes.<format>`, `events.jsonl`; HDF5 is one file
        `run.h5`.
    streams : sequence of str
        Rerun paths (`/loop/error`), fields (`error_um`), `shapes` or `events`; everything by
        default.
    start_s, end_s : float
        Part of the run, s from its start.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    InputError
        The format or a stream is unknown, h5py is missing, the run has none of the requested data,
        or the folder belongs to a run.
    DeviceError
        The folder cannot be written.
    """
    if to not in FORMATS:
        raise errors.InputError(f"--format {to}: known: {', '.join(FORMATS)}")
    fields, extras = _select_streams(streams)
    out = Path(out)
    refuse_originals(out)
    with errors.convert_write_errors(out, errors.DeviceError):
        make_folder(out)
        # beside existing files, so that a failed export leaves those unchanged
        with scratch_folder(out, ".export-") as folder:
            files = (_write_hdf5 if to == "hdf5" else _list_files)(
                run, to, folder, fields, extras, start_s, end_s
            )
            for path in files:
                move_file(path, out / path.name)
            return [out / path.name for path in files]


def _list_files(
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
        written += _write_tables(blocks, out / f"ticks.{to}", to, _make_origin(run))
        _warn_if_missing(run, bool(written))
    if SHAPES in extras and (shapes := run.cycles(start_s, end_s)).num_rows:
        written += _write_tables(iter([shapes]), out / f"shapes.{to}", to, _make_origin(run))
    if EVENTS in extras and (lines := _event_lines(run, start_s, end_s)):
        path = out / "events.jsonl"
        write_text_atomic(path, "".join(f"{line}\n" for line in lines))
        written.append(path)
    if not written:
        raise _make_nothing_error(run)
    return written


def _event_lines(run: Run, start_s: float, end_s: float) -> list[str]:
    return [json.dumps(each.line, ensure_ascii=False) for each in run.log_between(start_s, end_s)]


def _warn_if_missing(run: Run, telemetry: bool) -> None:
    if not telemetry:
        run.notes.append("no telemetry in this part of the run: no ticks are exported")


def _make_nothing_error(run: Run) -> errors.InputError:
    return errors.InputError(
        "; ".join((f"{run.folder}: nothing to export of the requested data", *run.notes))
    )


def _select_streams(streams: Sequence[str]) -> tuple[tuple[str, ...], set[str]]:
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


def _make_origin(run: Run) -> dict[str, str]:
    """Metadata of an exported file; CSV has none."""
    times = {
        "run": run.name,
        "started_utc": run.origin_utc.isoformat(),
        "recorded_by": run.recorded_by,
    }
    return program.file_origin("membrane-export/1") | times


def _write_tables(
    tables: Iterator[pa.Table], path: Path, to: str, origin: dict[str, str]
) -> list[Path]:
    """Write tables of one schema one after the other; without tables, write nothing."""
    writer = None
    try:
        for table in tables:
            if writer is None:
                if to == "parquet":
                    make = pa.parquet.ParquetWriter
                else:
                    make = pa.csv.CSVWriter
                writer = make(str(path), table.schema.with_metadata(origin))
            writer.write_table(table.cast(writer.schema) if to == "parquet" else table)
    finally:
        if writer is not None:
            writer.close()
    return [path] if writer is not None else []


def _append_values(file: Any, place: str, values: Column) -> None:
    """Append values to a data set of an HDF5 file; the first ones make it."""
    if place not in file:
        file.create_dataset(
            place, data=values, maxshape=(None,), chunks=True, compression="gzip", shuffle=True
        )
        return
    data = file[place]
    data.resize(data.shape[0] + values.size, axis=0)
    data[-values.size :] = values


def _write_hdf5(
    run: Run,
    to: str,
    out: Path,
    fields: Sequence[str],
    extras: set[str],
    start_s: float,
    end_s: float,
) -> list[Path]:
    path = out / "run.h5"
    h5py = import_optional("h5py", "h5", f"--format {to}")
    with h5py.File(path, "w") as file:
        file.attrs.update(_make_origin(run))
        if fields:
            for block in run.tick_blocks(fields, start_s, end_s):
                for name, values in block.items():
                    _append_values(file, f"ticks/{name}", values)
            _warn_if_missing(run, "ticks" in file)
        shapes = run.shapes()
        shapes = shapes.select_cycles((shapes.time_s >= start_s) & (shapes.time_s < end_s))
        if SHAPES in extras and len(shapes):
            for name in ("time_s", "coeffs_um", *_SHAPE_COLUMNS):
                file.create_dataset(f"shapes/{name}", data=getattr(shapes, name))
        if EVENTS in extras and (lines := _event_lines(run, start_s, end_s)):
            file.create_dataset("events", data=lines, dtype=h5py.string_dtype())
        empty = not len(file)
    if empty:
        raise _make_nothing_error(run)
    return [path]


def export_command(
    run: Path, form: str, out: Path | None, streams: list[str], start: str | None, end: str | None
) -> int:
    """Write a run for other programs and print the files, with notes on missing parts.

    Parameters
    ----------
    run : Path
        A run's folder, its name or a part of it, or `last`.
    form : str
        One of `FORMATS`.
    out : Path or None
        Folder of the files; None: `export` in the run's folder.
    streams : list of str
        As in `export_run`; empty: everything.
    start, end : str or None
        Times as a person writes them (`run_times.moment_s`); None: unlimited.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    InputError, DeviceError
        As `export_run`.
    """
    opened = open_run(catalogue.resolve_run(run))
    folder = out.resolve() if out else opened.folder / "export"
    files = export_run(opened, form, folder, streams, *part_s(opened.origin_utc, start, end))
    for note in opened.notes:
        print(f"note: {note}")
    for path in files:
        print(path)
    return 0
