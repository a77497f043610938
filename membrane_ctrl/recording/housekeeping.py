"""What the recorder does beside recording: looks at the disk, optimises closed segments, deletes old runs."""

from __future__ import annotations

import contextlib
import time
from functools import partial
from pathlib import Path

from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import RecordingConfig
from membrane_ctrl.recording.complaints import Complaints
from membrane_ctrl.recording.optimizer import Optimizer
from membrane_ctrl.recording.retention import OldRun, deletable_runs, delete_remains, delete_run, expired, size_bytes
from membrane_ctrl.recording.run_folder import free_mb
from membrane_ctrl.recording.sink import LAYOUT
from membrane_ctrl.recording.thrift import Thrift, thrift

# Counting the bytes of a hundred runs takes a second of disk.
RETENTION_INTERVAL_S = 3600.0
# At the run's end a person waits for the prompt, and a service manager is about to kill what is left. A segment of an
# hour takes longer only on a very busy machine (docs/recording.md).
_OPTIMISE_LAST_S = 20.0
_LOOK_S = 0.05
_RUN = "retention: "  # and the run that cannot be deleted


class Housekeeping:
    """One look each second.

    Attributes
    ----------
    thrift : Thrift
        What has to be left out.
    """

    def __init__(self, run_dir: Path, clock: RunClock, config: RecordingConfig, complaints: Complaints) -> None:
        self._run_dir = run_dir
        self._clock = clock
        self._config = config
        self._complaints = complaints
        self._optimizer = Optimizer(run_dir)
        self._retention_due_s = 0.0
        self.thrift = Thrift.ALL

    def finish(self, closed: list[Path]) -> None:
        """The run is over: optimise what is closed; what takes too long stays as it is."""
        give_up_s = time.monotonic() + _OPTIMISE_LAST_S
        self._take(closed)
        while True:
            self._complaints.guarded("optimise", self._optimizer.poll)
            if not self._optimizer.busy or time.monotonic() > give_up_s:
                return
            time.sleep(_LOOK_S)

    def _take(self, closed: list[Path]) -> None:
        if self.thrift == Thrift.ALL:  # a second copy of a segment needs room
            for path in closed:
                self._optimizer.add(path)

    def look(self, now_s: float, closed: list[Path]) -> None:
        """Watch the disk, go on with what is under way; `closed` are segments to optimise."""
        self._complaints.guarded("disk check", self._watch_disk)
        self._take(closed)
        self._complaints.guarded("optimise", self._optimizer.poll)
        if now_s >= self._retention_due_s:
            self._retention_due_s = now_s + RETENTION_INTERVAL_S
            self._complaints.guarded("retention", self._delete_old)

    def _watch_disk(self) -> None:
        left_mb, least_mb = free_mb(self._run_dir), self._config.min_free_mb
        self.thrift = thrift(left_mb, least_mb, self.thrift)
        if left_mb < least_mb:
            limit = f"less than recording.min_free_mb = {least_mb:g} MB free"
            self._complaints.complain("disk", f"{self._run_dir}: {limit}; delete old runs", kind="disk_low")
        else:
            self._complaints.recovered("disk")

    def _delete_old(self) -> None:
        config = self._config
        if config.keep_gb is None and config.keep_days is None:
            return
        # the run's own axis: a wall clock that is set wrong meanwhile deletes nothing
        now_utc = self._clock.utc(self._clock.now())
        delete_remains(self._run_dir.parent)
        runs = deletable_runs(self._run_dir.parent, self._run_dir, now_utc)
        gone = expired(runs, size_bytes(self._run_dir), config.keep_gb, config.keep_days, now_utc)
        # a folder that a person has moved away by hand is no trouble any more
        self._complaints.forget(_RUN, but={_RUN + run.folder.name for run, _ in gone})
        for run, why in gone:  # one by one: a folder that cannot go must not keep the others
            self._complaints.guarded(_RUN + run.folder.name, partial(self._delete, run, why))

    def _delete(self, run: OldRun, why: str) -> None:
        delete_run(run)
        self._complaints.report({"kind": "run_deleted", "run": run.folder.name, "message": why})

    def close(self) -> None:
        """End what is under way."""
        with contextlib.suppress(OSError):
            self._optimizer.close()
            (self._run_dir / LAYOUT).unlink(missing_ok=True)
