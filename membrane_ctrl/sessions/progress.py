"""Progress of a session on stderr: a live line on a terminal, otherwise a line per minute."""

import contextlib
import select
import signal
import sys
from collections.abc import Iterator, Sequence
from types import FrameType

from membrane_ctrl.model import terminal
from membrane_ctrl.sessions.live_log import LiveLog

_POLL_S = 1.0  # for an answer on the page
_EVERY_S = {True: 1.0, False: 60.0}


class Progress:
    """Counts the recorded seconds of a session; raises a requested KeyboardInterrupt at a safe
    place.
    """

    def __init__(self) -> None:
        self.log: LiveLog | None = None  # of the session, once it is known
        self._live = sys.stderr.isatty()
        self._step = ""
        self._planned_s = 0.0
        self._longest_s = 0.0
        self._after_s = 0.0
        self._done_s = self._shown_s = 0.0
        self._asking = False
        self.interrupted = False

    def begin_step(
        self, step: str, planned_s: float, after_s: float, longest_s: float = 0.0
    ) -> None:
        """Start a step.

        Parameters
        ----------
        step : str
            Its name, on the terminal and on the page.
        planned_s : float
            Its expected duration.
        after_s : float
            That of the later steps.
        longest_s : float
            Its duration where the planned one does not suffice.
        """
        self._step = step
        self._planned_s = planned_s
        self._longest_s = max(planned_s, longest_s)
        self._after_s = after_s
        self._done_s = self._shown_s = 0.0
        line = step
        if self._longest_s > planned_s:
            line = f"{step}: {_format_clock(planned_s)} to {_format_clock(longest_s)}"
        elif planned_s:
            line = f"{step}: about {_format_clock(planned_s)}"
        self._print_text(line)
        self.log_entry("step", step, planned_s=planned_s, after_s=after_s)

    def __call__(self, seconds: float) -> None:
        """Note additional recorded seconds."""
        if self.interrupted:
            self.interrupted = False
            raise KeyboardInterrupt
        self._done_s += seconds
        if self._done_s - self._shown_s < _EVERY_S[self._live]:
            return
        self._shown_s = self._done_s
        expected_s = self._planned_s
        if self._done_s > self._planned_s:
            expected_s = self._longest_s
        left_s = max(0.0, expected_s - self._done_s)
        line = (
            f"{self._step}: {_format_clock(self._done_s)}, {_format_clock(left_s)} left, session "
            f"{_format_clock(left_s + self._after_s)}"
        )
        if self._live:
            terminal.live_line(line)
        else:
            self._print_text(line)

    def print_line(self, line: str) -> None:
        """Print a permanent line, and note it in the log."""
        self._print_text(line)
        self.log_entry("result", line)

    def log_entry(self, what: str, line: str, **more: float | Sequence[str]) -> None:
        """Note what happens in the log, if there is one.

        Parameters
        ----------
        what, line, **more
            As for `LiveLog.log_entry`.
        """
        if self.log is not None:
            self.log.log_entry(what, line, **more)

    def _print_text(self, line: str) -> None:
        if self._live:
            terminal.live_line(line, "\n")
        else:
            print(line, file=sys.stderr, flush=True)

    def ask_question(self, question: str, among: Sequence[str] = ()) -> str:
        """Ask on the terminal, and on the page too; the first answer counts.

        Ctrl-C interrupts at once.

        Parameters
        ----------
        question : str
            In one line, with the answers that count.
        among : sequence of str
            The answers that the page offers; empty: it does not ask.

        Returns
        -------
        str
            Empty at the end of the input, and for none of them.
        """
        if self.log is not None:
            self.log.pop_answer("", ())  # one that came too late for the last question
        print(f"{question} ", end="", file=sys.stderr, flush=True)
        self.log_entry("asks", question, among=among)
        self._asking = True
        try:
            while among and self.log is not None and not _has_typed_line(_POLL_S):
                if (given := self.log.pop_answer(question, among)) is not None:
                    self.print_line(f"{given.by} answers on the page: {given.answer or 'none'}")
                    return given.answer
            return sys.stdin.readline().strip()
        finally:
            self._asking = False

    @contextlib.contextmanager
    def catch_signals(self) -> Iterator[None]:
        """Note Ctrl-C and SIGTERM, and raise them at the next tick,
        not in the middle of a command.
        """

        def note_signal(number: int, frame: FrameType | None) -> None:
            if self._asking:
                raise KeyboardInterrupt
            self.interrupted = True

        former = {
            number: signal.signal(number, note_signal) for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)


def _has_typed_line(within_s: float) -> bool:
    """Whether a line waits on the terminal, or its end; also if that is unknown."""
    try:
        return bool(select.select([sys.stdin], [], [], within_s)[0])
    except (OSError, ValueError):  # not a file
        return True


def _format_clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
