"""How far a step is and how long it will take, on stderr: a live line on a terminal, a line a minute elsewhere."""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_EVERY_S = {True: 1.0, False: 60.0}


class Progress:
    """Counts the recorded seconds of a session; raises KeyboardInterrupt at a safe place once one was asked for."""

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._step, self._planned_s, self._after_s = "", 0.0, 0.0
        self._done_s = self._shown_s = 0.0
        self.interrupted = False

    def begin(self, step: str, planned_s: float, after_s: float) -> None:
        """A step that takes about so long, and so much after it."""
        self._step, self._planned_s, self._after_s = step, planned_s, after_s
        self._done_s = self._shown_s = 0.0
        self.say(f"{step}" + (f": about {_clock(planned_s)}" if planned_s else ""))

    def __call__(self, seconds: float) -> None:
        """So much more has been recorded."""
        if self.interrupted:
            self.interrupted = False
            raise KeyboardInterrupt
        self._done_s += seconds
        if self._done_s - self._shown_s < _EVERY_S[self._live]:
            return
        self._shown_s = self._done_s
        left_s = max(0.0, self._planned_s - self._done_s)
        line = (
            f"{self._step}: {_clock(self._done_s)}, {_clock(left_s)} left, session {_clock(left_s + self._after_s)}"
        )
        print(f"\r\033[K{line}" if self._live else line, end="" if self._live else "\n", file=sys.stderr, flush=True)

    def say(self, line: str) -> None:
        """A line that stays."""
        print(f"\r\033[K{line}" if self._live else line, file=sys.stderr, flush=True)

    @contextmanager
    def catching(self) -> Iterator[None]:
        """Ctrl-C and SIGTERM are taken note of and raised at the next tick, not in the middle of a command."""

        def note(number: int, frame: FrameType | None) -> None:
            self.interrupted = True

        former = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
