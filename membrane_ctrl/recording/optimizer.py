"""Closed segments through `rerun rrd optimize`, one at a time, in a process that steps back behind everything.

It takes a third off a segment and the wait off opening it. The original is replaced in one step, and only by a
file that has its footer and was made without a complaint.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
from collections import deque
from pathlib import Path

from membrane_ctrl.recording.sink import LAYOUT, is_whole

_PACKAGE = importlib.util.find_spec("rerun_cli")
assert _PACKAGE is not None
assert _PACKAGE.origin is not None  # it comes with rerun-sdk
_RERUN = Path(_PACKAGE.origin).parent / "rerun"


def optimize_command(source: Path, target: Path, *options: str) -> list[str]:
    """The command that writes `target` from `source`; the binary itself, as its Python wrapper outlives a kill.

    An option may be another source.
    """
    return ["nice", "-n", "19", str(_RERUN), "rrd", "optimize", *options, str(source), "-o", str(target)]


def quiet_environment() -> dict[str, str]:
    """Rerun's command without its log and its usage statistics."""
    return os.environ | {"RUST_LOG": "error", "TELEMETRY_ENABLED": "false"}


class Optimizer:
    """Works through closed segments beside the recorder; call `poll` now and then.

    Parameters
    ----------
    run_dir : Path
        Where the segments are; what a recorder that was killed has left half done there is removed.
    """

    def __init__(self, run_dir: Path) -> None:
        for half_done in run_dir.glob(".*.rrd.part"):
            half_done.unlink(missing_ok=True)
        self._waiting: deque[Path] = deque()
        self._process: subprocess.Popen[bytes] | None = None
        self._source = self._part = Path()

    def add(self, path: Path) -> None:
        """Take a closed segment on."""
        self._waiting.append(path)

    def poll(self) -> None:
        """Put a finished file in place, start the next. Raises OSError, also for one that could not be optimised."""
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                return
            self._process = None
            self._put_in_place(code)
        if self._waiting:
            self._source = self._waiting.popleft()
            self._part = self._source.with_name(f".{self._source.name}.part")
            # the run's layout, which only its first segment has
            layout = [str(path) for path in (self._source.with_name(LAYOUT),) if path.exists()]
            self._process = subprocess.Popen(
                optimize_command(self._source, self._part, *layout),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=quiet_environment(),
            )

    def _put_in_place(self, code: int) -> None:
        if code == 0 and self._part.exists() and is_whole(self._part):
            with self._part.open("rb") as file:
                os.fsync(file.fileno())
            self._part.replace(self._source)
            return
        self._part.unlink(missing_ok=True)
        raise OSError(f"{self._source.name} stays as it is: rrd optimize ended with {code}")

    @property
    def busy(self) -> bool:
        """Something is under way or waits."""
        return self._process is not None or bool(self._waiting)

    def close(self) -> None:
        """End what is under way; its segment stays as it is."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            self._part.unlink(missing_ok=True)
