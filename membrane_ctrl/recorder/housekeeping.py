"""Side tasks of the recorder: watches the disk, optimises closed segments, deletes old runs."""

import contextlib
import time
from functools import partial
from pathlib import Path

from membrane_ctrl.config.schema import RecordingConfig
from membrane_ctrl.model import recorder_events
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.recorder.recorder_errors import RecorderErrors
from membrane_ctrl.recorder.rerun_recording import LAYOUT
from membrane_ctrl.recorder.segment_optimizer import Optimizer
from membrane_ctrl.run_files import detail_level, retention, run_folder

# Counting the bytes of a hundred runs keeps the disk busy for a second.
RETENTION_INTERVAL_S = 3600.0
# At the run's end a person waits for the prompt, and a service manager is about to kill remaining
# processes. A one-hour segment takes longer only on a very busy machine
# (docs/reference/recording.md).
_OPTIMISE_LAST_S = 20.0
_LOOK_S = 0.05
_RUN = "retention: "  # followed by the run that cannot be deleted


class Housekeeping:
    """Works once a second; `detail` states what to omit."""

    def __init__(
        self, run_dir: Path, clock: RunClock, config: RecordingConfig, errors: RecorderErrors
    ) -> None:
        self._run_dir = run_dir
        self._clock = clock
        self._config = config
        self._errors = errors
        self._optimizer = Optimizer(run_dir)
        self._retention_due_s = 0.0
        self.detail = detail_level.DetailLevel.ALL

    def optimise_remaining(self, closed: list[Path]) -> None:
        """At the end of the run, optimise closed segments, as far as time allows."""
        give_up_s = time.monotonic() + _OPTIMISE_LAST_S
        self._queue_segments(closed)
        while True:
            self._errors.run_guarded("optimise", self._optimizer.poll_worker)
            if not self._optimizer.is_busy or time.monotonic() > give_up_s:
                return
            time.sleep(_LOOK_S)

    def _queue_segments(self, closed: list[Path]) -> None:
        if self.detail == detail_level.DetailLevel.ALL:  # a second copy of a segment needs room
            for path in closed:
                self._optimizer.add_segment(path)

    def watch_disk(self, now_s: float, closed: list[Path]) -> None:
        """Watch the disk and continue pending work.

        Parameters
        ----------
        now_s : float
            The run's clock.
        closed : list of path
            Segments that were closed since, to be optimised.
        """
        self._errors.run_guarded("disk check", self._watch_disk)
        self._queue_segments(closed)
        self._errors.run_guarded("optimise", self._optimizer.poll_worker)
        if now_s >= self._retention_due_s:
            self._retention_due_s = now_s + RETENTION_INTERVAL_S
            self._errors.run_guarded("retention", self._delete_old)

    def _watch_disk(self) -> None:
        left_mb = run_folder.free_mb(self._run_dir)
        least_mb = self._config.min_free_mb
        self.detail = detail_level.decide_detail_level(left_mb, least_mb, self.detail)
        if left_mb < least_mb:
            limit = f"less than recording.min_free_mb = {least_mb:g} MB free"
            self._errors.report_error(
                "disk", f"{self._run_dir}: {limit}; delete old runs", recorder_events.DiskLow
            )
        else:
            self._errors.report_recovered("disk")

    def _delete_old(self) -> None:
        """Delete runs beyond `recording.keep_gb` and `keep_days`; a failure is reported for each
        run.
        """
        config = self._config
        if config.keep_gb is None and config.keep_days is None:
            return
        # the run's own axis: a wall clock set wrong meanwhile must delete nothing
        now_utc = self._clock.utc(self._clock.now())
        retention.delete_remains(self._run_dir.parent)
        runs = retention.list_deletable_runs(self._run_dir.parent, self._run_dir, now_utc)
        expired = retention.find_expired(
            runs, retention.size_bytes(self._run_dir), config.keep_gb, config.keep_days, now_utc
        )
        # a folder that a person has moved away is no longer an error
        self._errors.clear_errors(_RUN, but={_RUN + run.folder.name for run, _ in expired})
        # one by one: a folder that cannot be deleted must not block the others
        for (
            run,
            why,
        ) in expired:
            self._errors.run_guarded(_RUN + run.folder.name, partial(self._delete_run, run, why))

    def _delete_run(self, run: retention.OldRun, why: str) -> None:
        retention.delete_run(run)
        self._errors.report(recorder_events.RunDeleted(run.folder.name, why))

    def close(self) -> None:
        """Abort pending work."""
        with contextlib.suppress(OSError):
            self._optimizer.close()
            (self._run_dir / LAYOUT).unlink(missing_ok=True)
