"""Runs closed segments through `rerun rrd optimize`.

One segment at a time is optimised, in a process of lowest priority. That shrinks a segment by a
third and makes it open at once. The original is replaced atomically, and only by a file that has
its footer and was made without an error. Without that program, as in an installation without the
viewer, segments stay as they are written.
"""

import importlib.util
import os
import subprocess
from collections import deque
from pathlib import Path

from membrane_ctrl.recorder.rerun_recording import LAYOUT, is_whole

_PACKAGE = importlib.util.find_spec("rerun_cli")
assert _PACKAGE is not None
assert _PACKAGE.origin is not None  # it comes with rerun-sdk
_RERUN = Path(_PACKAGE.origin).parent / "rerun"


def optimize_command(source: Path, target: Path, *options: str) -> list[str]:
    """The command that writes one segment from another.

    It names the binary: Rerun's Python wrapper would survive a kill of the recorder.

    Parameters
    ----------
    source : Path
        The closed segment.
    target : Path
        A new file beside it; not whole until the command has ended with 0.
    *options : str
        Options of `rerun rrd optimize`, and paths of other sources, which are merged.
    """
    return [
        "nice",
        "-n",
        "19",
        str(_RERUN),
        "rrd",
        "optimize",
        *options,
        str(source),
        "-o",
        str(target),
    ]


def quiet_environment() -> dict[str, str]:
    """Rerun's command without its log and its usage statistics."""
    return os.environ | {"RUST_LOG": "error", "TELEMETRY_ENABLED": "false"}


class Optimizer:
    """Works through closed segments beside the recorder; call `poll_worker` now and then.

    Removes half-done files left by a killed recorder.
    """

    def __init__(self, run_dir: Path) -> None:
        for half_done in run_dir.glob(".*.rrd.part"):
            half_done.unlink(missing_ok=True)
        self._waiting: deque[Path] = deque()
        self._process: subprocess.Popen[bytes] | None = None
        self._source = self._part = Path()

    def add_segment(self, path: Path) -> None:
        """Queue a closed segment, if the program that optimises is installed."""
        if _RERUN.exists():
            self._waiting.append(path)

    def poll_worker(self) -> None:
        """Put a finished file in place and start the next. Raises OSError, also for a failed
        optimisation.
        """
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                return
            self._process = None
            self._put_in_place(code)
        if self._waiting:
            self._source = self._waiting.popleft()
            self._part = self._source.with_name(f".{self._source.name}.part")
            # the run's layout, which only the first segment contains
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
        raise OSError(f"{self._source.name} is not optimised: rrd optimize ended with {code}")

    @property
    def is_busy(self) -> bool:
        """Whether a segment is in progress or queued."""
        return self._process is not None or bool(self._waiting)

    def close(self) -> None:
        """Abort the current optimisation; its segment stays as it is."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            self._part.unlink(missing_ok=True)
