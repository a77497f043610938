"""The latched fault of a hold: written to its file when it latches, removed when it clears.

Another thread writes the file; no tick waits for it.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial

from membrane_ctrl.controller import tick
from membrane_ctrl.model import events, run_events
from membrane_ctrl.run_files.latched_fault import LatchedFault, LatchedFile, ResumeLog


class FaultLatch:
    """Keeps the latched-fault file in step with the controller; waits for the disk only on exit,
    with the pump off.

    Parameters
    ----------
    file : LatchedFile or None
        None: no latch outlives the run (the twin's default).
    resumes : ResumeLog or None
        Counts resumes across runs.
    run : str
        Name of the run folder.
    utc : callable
        Converts the run's clock to UTC.
    report : callable
        Records that writing the file failed, or works again.
    """

    def __init__(
        self,
        file: LatchedFile | None,
        resumes: ResumeLog | None,
        run: str,
        utc: Callable[[float], datetime],
        report: Callable[[events.Event], None],
    ) -> None:
        self._file = file
        self._resumes = resumes
        self._run = run
        self._utc = utc
        self._report = report
        # one thread, so that a fault and its acknowledgement stay in order; started by the first
        # fault
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="latched-fault")
        self._pending: deque[events.Event] = deque()  # from the disk thread
        self._failing = False
        self._last: Callable[[], None] = lambda: None
        self._fault: events.Fault | None = None

    @property
    def latched_line(self) -> str:
        """The latched fault in one line; empty without one."""
        fault = None if self._file is None else self._file.read()
        return "" if fault is None else str(fault)

    @property
    def resumes_s(self) -> tuple[float, ...]:
        """Ages of the last day's resumes, oldest first."""
        if self._resumes is None:
            return ()
        return self._resumes.ages_s(datetime.now(UTC))

    def __enter__(self) -> FaultLatch:
        if self._file is not None:
            with contextlib.suppress(OSError):  # a failure is reported when it matters
                self._file.reserve_space()
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._disk.submit(self._finish_writing, self._file)
        self._disk.shutdown()
        self._report_failure()

    def handle_tick(self, outputs: tick.TickOutputs) -> None:
        """After a tick: latch a fault; clear an acknowledged one."""
        # A fault that only holds the flow is not latched: the state `fault` latches the newest one
        self._report_failure()
        for event in outputs.events:
            match event:
                case events.Fault():
                    self._fault = event
                case events.StateEntered(state="fault"):
                    self._latch_fault(outputs.row.mono_s)
                case events.Resumed() if self._resumes is not None:
                    self._disk.submit(
                        self._try_write,
                        partial(self._resumes.add_resume, self._utc(outputs.row.mono_s)),
                    )
                case (
                    events.StateEntered(from_="fault")
                    | events.CommandTaken(command="ack", refused=None)
                ) if self._file is not None:
                    self._disk.submit(self._try_write, self._file.clear)

    def _latch_fault(self, now_s: float) -> None:
        words = {key: getattr(self._fault, key, "") for key in ("name", "cause", "seen", "remedy")}
        if self._file is not None:
            self._write_file(partial(self._file.write, self._add_date(words, now_s)))

    def _add_date(self, words: dict[str, str], now_s: float) -> LatchedFault:
        return LatchedFault(
            **words, time_utc=self._utc(now_s).isoformat(timespec="seconds"), run=self._run
        )

    def _write_file(self, act: Callable[[], None]) -> None:
        self._last = act
        self._disk.submit(self._try_write, act)

    def _finish_writing(self, file: LatchedFile) -> None:
        """At the end of the run: retry a failed write once, and wait for the disk."""
        if self._failing:
            self._try_write(self._last)
        if not self._failing:
            self._try_write(file.sync)
        file.release_space()

    def _try_write(self, act: Callable[[], None]) -> None:
        try:
            act()
        except Exception as error:  # nothing else would see an exception of this thread
            if not self._failing:
                self._pending.append(run_events.LatchFailed(str(error)))
            self._failing = True
        else:
            if self._failing:
                self._pending.append(run_events.LatchWritten())
                self._failing = False

    def _report_failure(self) -> None:
        while self._pending:
            self._report(self._pending.popleft())
