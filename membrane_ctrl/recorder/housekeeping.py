"""Side tasks of the recorder: watches the disk, optimises closed segments, deletes old runs."""

import contextlib
import importlib.util
import os
import subprocess
import time
from collections import deque
from functools import partial
from pathlib import Path

from membrane_ctrl.config.schema import Config, RecordingConfig
from membrane_ctrl.model import run_events
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.recorder.sink import LAYOUT, RecorderErrors, is_whole
from membrane_ctrl.run_files import disk_budget, run_folder

# Detects that the run's folder was removed or replaced, and makes a new one.


class FolderWatch:
    """Holds the folder open, so that its inode number cannot be reused and identifies it."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._descriptor = _opened(run_dir)
        # an `rm -r` that meets a newly written file leaves the folder, but without its content
        self._has_config = (run_dir / run_folder.CONFIG).exists()

    def gone(self) -> bool:
        """Whether the folder or its content was removed or moved. Raises OSError (not if it is
        missing).
        """
        if self._descriptor is None or (
            self._has_config and not (self._run_dir / run_folder.CONFIG).exists()
        ):
            return True
        try:
            found = self._run_dir.stat()
        except FileNotFoundError:
            return True
        return not os.path.samestat(found, os.fstat(self._descriptor))

    def begin_anew(self, config: Config) -> None:
        """Make the folder again, with its configuration. Raises OSError; the folder is then still
        `gone`.
        """
        self._run_dir.mkdir(parents=True, exist_ok=True)
        run_folder.write_heads(self._run_dir, config)
        self.close()
        self._descriptor = _opened(self._run_dir)
        self._has_config = True

    def close(self) -> None:
        """Release the folder."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _opened(folder: Path) -> int | None:
    try:
        return os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None


# Runs closed segments through `rerun rrd optimize`, one at a time, in a process of lowest priority.
#
# That shrinks a segment by a third and makes it open at once. The original is replaced atomically,
# and only by a file that has its footer and was made without an error.


_PACKAGE = importlib.util.find_spec("rerun_cli")
assert _PACKAGE is not None
assert _PACKAGE.origin is not None  # it comes with rerun-sdk
_RERUN = Path(_PACKAGE.origin).parent / "rerun"


def optimize_command(source: Path, target: Path, *options: str) -> list[str]:
    """The command that writes `target` from `source`; it names the binary, as its Python wrapper
    survives a kill.

    Options may include another source.
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
    """Works through closed segments beside the recorder; call `poll` now and then.

    Removes half-done files left by a killed recorder.
    """

    def __init__(self, run_dir: Path) -> None:
        for half_done in run_dir.glob(".*.rrd.part"):
            half_done.unlink(missing_ok=True)
        self._waiting: deque[Path] = deque()
        self._process: subprocess.Popen[bytes] | None = None
        self._source = self._part = Path()

    def add(self, path: Path) -> None:
        """Queue a closed segment."""
        self._waiting.append(path)

    def poll(self) -> None:
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
    def busy(self) -> bool:
        """Whether a segment is in progress or queued."""
        return self._process is not None or bool(self._waiting)

    def close(self) -> None:
        """Abort the current optimisation; its segment stays as it is."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            self._part.unlink(missing_ok=True)


# Counting the bytes of a hundred runs keeps the disk busy for a second.
RETENTION_INTERVAL_S = 3600.0
# At the run's end a person waits for the prompt, and a service manager is about to kill remaining
# processes. A one-hour segment takes longer only on a very busy machine
# (docs/reference/recording.md).
_OPTIMISE_LAST_S = 20.0
_LOOK_S = 0.05
_RUN = "retention: "  # followed by the run that cannot be deleted


class Housekeeping:
    """Works once a second; `detail` says what to omit."""

    def __init__(
        self, run_dir: Path, clock: RunClock, config: RecordingConfig, errors: RecorderErrors
    ) -> None:
        self._run_dir = run_dir
        self._clock = clock
        self._config = config
        self._errors = errors
        self._optimizer = Optimizer(run_dir)
        self._retention_due_s = 0.0
        self.detail = disk_budget.DetailLevel.ALL

    def finish(self, closed: list[Path]) -> None:
        """At the end of the run, optimise closed segments, as far as time allows."""
        give_up_s = time.monotonic() + _OPTIMISE_LAST_S
        self._take(closed)
        while True:
            self._errors.guarded("optimise", self._optimizer.poll)
            if not self._optimizer.busy or time.monotonic() > give_up_s:
                return
            time.sleep(_LOOK_S)

    def _take(self, closed: list[Path]) -> None:
        if self.detail == disk_budget.DetailLevel.ALL:  # a second copy of a segment needs room
            for path in closed:
                self._optimizer.add(path)

    def look(self, now_s: float, closed: list[Path]) -> None:
        """Watch the disk and continue pending work; `closed` are segments to optimise."""
        self._errors.guarded("disk check", self._watch_disk)
        self._take(closed)
        self._errors.guarded("optimise", self._optimizer.poll)
        if now_s >= self._retention_due_s:
            self._retention_due_s = now_s + RETENTION_INTERVAL_S
            self._errors.guarded("retention", self._delete_old)

    def _watch_disk(self) -> None:
        left_mb, least_mb = run_folder.free_mb(self._run_dir), self._config.min_free_mb
        self.detail = disk_budget.detail_level(left_mb, least_mb, self.detail)
        if left_mb < least_mb:
            limit = f"less than recording.min_free_mb = {least_mb:g} MB free"
            self._errors.report_error(
                "disk", f"{self._run_dir}: {limit}; delete old runs", run_events.DiskLow
            )
        else:
            self._errors.recovered("disk")

    def _delete_old(self) -> None:
        config = self._config
        if config.keep_gb is None and config.keep_days is None:
            return
        # the run's own axis: a wall clock set wrong meanwhile must delete nothing
        now_utc = self._clock.utc(self._clock.now())
        disk_budget.delete_remains(self._run_dir.parent)
        runs = disk_budget.deletable_runs(self._run_dir.parent, self._run_dir, now_utc)
        gone = disk_budget.expired(
            runs, disk_budget.size_bytes(self._run_dir), config.keep_gb, config.keep_days, now_utc
        )
        # a folder that a person has moved away is no longer an error
        self._errors.forget(_RUN, but={_RUN + run.folder.name for run, _ in gone})
        for (
            run,
            why,
        ) in gone:  # one by one: a folder that cannot be deleted must not block the others
            self._errors.guarded(_RUN + run.folder.name, partial(self._delete, run, why))

    def _delete(self, run: disk_budget.OldRun, why: str) -> None:
        disk_budget.delete_run(run)
        self._errors.report(run_events.RunDeleted(run.folder.name, why))

    def close(self) -> None:
        """Abort pending work."""
        with contextlib.suppress(OSError):
            self._optimizer.close()
            (self._run_dir / LAYOUT).unlink(missing_ok=True)
