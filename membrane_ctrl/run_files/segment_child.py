"""The program that decodes Rerun segments, so that a damaged file cannot end the program that asked for it.

Rerun's reader aborts its process on some damaged files, and takes unlimited memory or time on others. This program
imports the reader once; each request is then served by a fork of it, under limits. A fork may die: the next request
gets another. The program is started by `segment_process`.

Requests are lines of JSON on stdin with the keys `do` ("read", "check" or "is_whole"), `path`, `entities`, `seconds`.
An answer is a line of JSON, `{"ok": true, "parts": [[entity, component, rows, width], ...]}` or `{"ok": false,
"died", "fault"}`, and the data of the parts, for each the times (int64, ns) and the values (float64, row by row).
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import sys
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader

from membrane_ctrl.run_files.segments import FAULTS, panics_are_faults

TIME = "run_time"
COMPONENTS = ("Scalars:scalars", "Measurements:values", "Measurements:variances")
# Address space beyond this program: a segment of 0.7 GB, its columns and their copies take three times as much.
_MEMORY_BYTES = 3_000_000_000
_IDLE_S = 60.0  # without a request for so long, the program ends
_DIED = 1
_FAULT_MOST = 200

Part = tuple[str, str, "np.ndarray[Any, np.dtype[np.int64]]", "np.ndarray[Any, np.dtype[np.float64]]"]


def main() -> None:
    """Serve requests until stdin is closed, or none has come for a while."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _load_conversions()
    requests = sys.stdin.buffer
    while select.select([requests], [], [], _IDLE_S)[0]:
        line = requests.readline()
        if not line:
            return
        _serve_in_fork(json.loads(line))


def _load_conversions() -> None:
    """Load what Arrow loads with its first conversions (0.4 s), so that no fork must."""
    numbers = pa.array([[1]])
    numbers.flatten().cast("float64").to_numpy(zero_copy_only=False)


def _serve_in_fork(request: dict[str, Any]) -> None:
    pid = os.fork()
    if pid == 0:
        _serve_and_exit(request)
    _, status = os.waitpid(pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code == -signal.SIGALRM:
        os._exit(_DIED)  # perhaps within its answer
    if code != 0:
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        _answer({"ok": False, "died": True, "fault": f"Rerun's reader died on it ({how})"}, [])


def _serve_and_exit(request: dict[str, Any]) -> None:
    """In the fork: decode, answer, and end without the interpreter's clean-up."""
    try:
        signal.alarm(int(request["seconds"]))
        most_bytes = _address_space_bytes() + _MEMORY_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most_bytes, most_bytes))
        path = Path(request["path"])
        try:
            parts: list[Part] = []
            match request["do"]:
                case "is_whole":
                    _require_footer(path)
                case "check":
                    _require_decodable(path)
                case _:
                    parts = decode(path, set(request["entities"]))
        except (*FAULTS, MemoryError, TypeError, KeyError, ArithmeticError) as error:
            _answer({"ok": False, "died": False, "fault": _reason(error, path)}, [])
        else:
            heads = [[entity, name, *values.shape] for entity, name, _, values in parts]
            _answer({"ok": True, "parts": heads}, parts)
        os._exit(0)
    finally:
        os._exit(_DIED)


def _address_space_bytes() -> int:
    pages = Path("/proc/self/statm").read_text().split()[0]
    return int(pages) * resource.getpagesize()


def _reason(error: BaseException, path: Path) -> str:
    lines = str(error).splitlines() or [type(error).__name__]
    return lines[0].removeprefix(f"Failed to read RRD file at {path}: ")[:_FAULT_MOST]


def _answer(head: dict[str, Any], parts: list[Part]) -> None:
    out: BinaryIO = sys.stdout.buffer
    out.write(json.dumps(head).encode() + b"\n")
    for _, _, times, values in parts:
        out.write(np.ascontiguousarray(times, np.int64).tobytes())
        out.write(np.ascontiguousarray(values, np.float64).tobytes())
    out.flush()


def _require_footer(path: Path) -> None:
    with warnings.catch_warnings(), panics_are_faults():
        warnings.simplefilter("ignore")
        RrdReader(path).store()


def _require_decodable(path: Path) -> None:
    with warnings.catch_warnings(), panics_are_faults():
        warnings.simplefilter("ignore")
        for _ in RrdReader(path).stream():
            pass


def decode(path: Path, entities: set[str]) -> list[Part]:
    """Decode the numbers of some entities: a part for each entity, component and width.

    Raises one of `FAULTS`, or whatever else a damaged table causes.
    """
    found: dict[tuple[str, str, int], tuple[list[Any], list[Any]]] = {}
    with warnings.catch_warnings(), panics_are_faults():
        warnings.simplefilter("ignore")  # the reader warns about a missing footer
        # all of them first: most damage ends this before any table is made
        chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path in entities]
        for chunk in chunks:
            batch: pa.RecordBatch = chunk.to_record_batch()
            names = batch.schema.names
            if TIME not in names or not batch.num_rows:
                continue
            times = batch.column(TIME).cast("int64").to_numpy(zero_copy_only=False)
            for name in COMPONENTS:
                if name not in names:
                    continue
                flat = batch.column(name).flatten().to_numpy(zero_copy_only=False)
                values = np.asarray(flat, np.float64).reshape(batch.num_rows, -1)
                parts = found.setdefault((chunk.entity_path, name, values.shape[1]), ([], []))
                parts[0].append(times)
                parts[1].append(values)
    return [
        (entity, name, np.concatenate(times), np.concatenate(values))
        for (entity, name, _), (times, values) in found.items()
    ]


if __name__ == "__main__":
    main()
