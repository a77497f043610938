"""Reads Rerun segments by a child process (`segment_child`), which a damaged file may kill."""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, NonNegativeInt, ValidationError

from membrane_ctrl.model.arrays import Column, IntArray
from membrane_ctrl.run_files.segments import require_bounded

# For a segment: its start on a busy machine, and a megabyte a second, a tenth of the usual rate.
_START_S = 30.0
_PER_MB_S = 1.0
_SPARE_S = 5.0  # the child ends itself first
_HEAD_BYTES_MAX = 4_000_000
_DATA_BYTES_MAX = 2_800_000_000  # four times what a segment may hold
_READ_BYTES = 1 << 20
_NONSENSE = "Rerun's reader gives no answer that makes sense"


class SegmentCrashError(RuntimeError):
    """The child died on a segment, or took too long."""


@dataclass(frozen=True, slots=True)
class SegmentPart:
    """Numbers of an entity: (n,) times in ns, (n, m) values."""

    entity: str
    component: str
    times_ns: IntArray
    values: Column


class _Head(BaseModel):
    """The first line of an answer of the child."""

    ok: bool
    died: bool = False
    fault: str = ""
    parts: list[tuple[str, str, NonNegativeInt, NonNegativeInt]] = []


def read_parts(path: Path, entities: set[str]) -> list[SegmentPart]:
    """Read the numbers of some entities.

    Raises
    ------
    OSError
        The file cannot be read, or would inflate to more than a recorder writes.
    RuntimeError
        Rerun refuses the file; a `SegmentCrashError` if its reader died or took too long.
    """
    require_bounded(path)
    return _READER.request({"do": "read", "path": str(path.resolve()), "entities": sorted(entities)}, _limit_s(path))


def require_decodable(path: Path) -> None:
    """Decode a segment and discard the result; raises like `read_parts`, with the first damage."""
    require_bounded(path)
    _READER.request({"do": "check", "path": str(path.resolve())}, _limit_s(path))


def is_whole(path: Path) -> bool:
    """Whether a closed segment has its footer."""
    try:
        require_bounded(path)
        _READER.request({"do": "is_whole", "path": str(path.resolve())}, _limit_s(path))
    except (OSError, RuntimeError):
        return False
    return True


def _limit_s(path: Path) -> float:
    return _START_S + _PER_MB_S * path.stat().st_size / 1e6


class _Reader:
    """One child at a time, started with the first request and again after it ended; for any thread."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        atexit.register(self.close)

    def request(self, request: dict[str, Any], limit_s: float) -> list[SegmentPart]:
        """Send a request and return the parts of its answer. Raises RuntimeError with the child's reason."""
        line = json.dumps(request | {"seconds": int(limit_s)}).encode() + b"\n"
        with self._lock:
            try:
                head, data = self._exchange(line, limit_s)
            except BaseException:  # an interrupt among them: what the child still sends belongs to no request
                self.close()
                raise
        if head.died:
            raise SegmentCrashError(head.fault)
        if not head.ok:
            raise RuntimeError(head.fault)
        return _parts_of(head, data)

    def close(self) -> None:
        """End the child."""
        child, self._child = self._child, None
        if child is None:
            return
        with contextlib.suppress(OSError):
            os.killpg(child.pid, signal.SIGKILL)  # its fork, too
        child.wait()
        for stream in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):
                assert stream is not None
                stream.close()

    def _exchange(self, line: bytes, limit_s: float) -> tuple[_Head, bytearray]:
        until_s = time.monotonic() + limit_s + _SPARE_S
        for attempt in (1, 2):
            child = self._running()
            assert child.stdin is not None
            try:
                child.stdin.write(line)
                child.stdin.flush()
                return self._read_answer(child, until_s)
            except (BrokenPipeError, EOFError):
                code = child.wait()
                self.close()
                if code != 0 or attempt == 2:  # 0: it had been idle, and ended just then
                    raise SegmentCrashError(f"Rerun's reader took more than {limit_s:.0f} s on it") from None
        raise AssertionError

    def _running(self) -> subprocess.Popen[bytes]:
        if self._child is not None and self._child.poll() is not None:
            self.close()
        if self._child is None:
            self._child = subprocess.Popen(
                # -P: a folder of runs, perhaps the working folder, may hold files named like modules
                [sys.executable, "-P", "-m", "membrane_ctrl.run_files.segment_child"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # a panic's report
                process_group=0,
            )
        return self._child

    def _read_answer(self, child: subprocess.Popen[bytes], until_s: float) -> tuple[_Head, bytearray]:
        assert child.stdout is not None
        handle = child.stdout.fileno()
        received = bytearray()
        while (end := received.find(b"\n")) < 0:
            if len(received) > _HEAD_BYTES_MAX:
                raise SegmentCrashError(_NONSENSE)
            received += _received(handle, until_s)
        try:
            head = _Head.model_validate_json(received[:end])
        except ValidationError:
            raise SegmentCrashError(_NONSENSE) from None
        del received[: end + 1]
        size = sum(8 * rows * (1 + width) for _, _, rows, width in head.parts)
        if size > _DATA_BYTES_MAX:
            raise SegmentCrashError(f"{size / 1e6:.0f} MB of numbers in it, which no recorder writes")
        while len(received) < size:
            received += _received(handle, until_s)
        return head, received


def _received(handle: int, until_s: float) -> bytes:
    """What the child has sent. Raises EOFError if it has ended, SegmentCrashError if it sends nothing in time."""
    left_s = until_s - time.monotonic()
    if left_s <= 0.0 or not select.select([handle], [], [], left_s)[0]:
        raise SegmentCrashError("Rerun's reader does not answer")
    data = os.read(handle, _READ_BYTES)
    if not data:
        raise EOFError
    return data


def _parts_of(head: _Head, data: bytearray) -> list[SegmentPart]:
    parts, place = [], 0
    for entity, component, rows, width in head.parts:
        times_ns = np.frombuffer(data, np.int64, rows, place).copy()
        place += times_ns.nbytes
        values = np.frombuffer(data, np.float64, rows * width, place).reshape(rows, width).copy()
        place += values.nbytes
        parts.append(SegmentPart(entity, component, times_ns, values))
    return parts


_READER = _Reader()
