"""Watches the exchanges with the devices: how long the tick waits for them, and which fail.

A link can fail a hundred times a second, each time with another message. The first failure is an
event; those after it are counted, and reported at intervals that double.
"""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

T = TypeVar("T")
Report = Callable[[str, bool, int], None]
"""Message, whether the link works, and the failures since the last report."""

# no multiple of a tick's period, so that the two timers are not due at the same time
_BEAT_S = 0.0207
_WAIT_MIN_S = 0.02  # of a tick: shorter waits delay nothing
_GOOD_S = 1.0  # without a failure until the link counts as good: one that comes and goes is one
_FIRST_REPEAT_S, _LAST_REPEAT_S = 1.0, 60.0
_MESSAGES_MAX = 4  # different ones that are reported at once: reading and writing fail differently


class StallMeter:
    """How long the program itself did not run: stopped, or without its share of the processor.

    A timer of the event loop that is overdue shows it.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._stalled_s = 0.0
        self._due_s: float | None = None
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Begin to measure, on the running loop."""
        self._due_s = self._now() + _BEAT_S
        self._timer = asyncio.get_running_loop().call_later(_BEAT_S, self._beat)

    def stop(self) -> None:
        """End measuring."""
        if self._timer is not None:
            self._timer.cancel()
        self._due_s = self._timer = None

    @property
    def stalled_s(self) -> float:
        """Total until now; 0 without a loop."""
        overdue_s = 0.0
        if self._due_s is not None:
            overdue_s = max(0.0, self._now() - self._due_s)
        return self._stalled_s + overdue_s

    def _beat(self) -> None:
        self._stalled_s = self.stalled_s
        self.start()


class WaitMeter:
    """How long a tick waits for its devices."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self.stalls = StallMeter(now)
        self._waited_s = 0.0

    async def measure(self, exchange: Awaitable[T]) -> T:
        """Wait for an exchange with the devices, and count the time."""
        begin_s, stalled_s = self._now(), self.stalls.stalled_s
        try:
            return await exchange
        finally:
            waited_s = self._now() - begin_s - (self.stalls.stalled_s - stalled_s)
            self._waited_s += max(0.0, waited_s)

    def take_wait_ms(self) -> float:
        """The time since the last call, in whole microseconds; 0 if it delays no tick."""
        waited_s, self._waited_s = self._waited_s, 0.0
        if waited_s < _WAIT_MIN_S:
            return 0.0
        return round(1e3 * waited_s, 3)


class FailureCounter:
    """Turns the failures of one link into few reports.

    Parameters
    ----------
    report : callable
        Gets a message, whether the link works again, and how many failures that stands for.
    first : int
        The first report comes with this failure: a single lost answer of a sensor is none.
    """

    def __init__(self, report: Report, first: int = 1) -> None:
        self._report = report
        self._first = first
        self._messages: set[str] = set()  # reported since the last repeated report
        self._unreported = 0
        self._standing = False
        self._last_failure_s = self._reported_s = float("-inf")
        self._repeat_s = _FIRST_REPEAT_S

    def note_failure(self, message: str, now_s: float) -> None:
        """Count a failed exchange, and report it if it begins a failure, is new, or is due again.

        Parameters
        ----------
        message : str
            What failed, in one line. Of many different ones only `_MESSAGES_MAX` are reported
            before the next repeat.
        now_s : float
            The run's clock. A standing failure is repeated in doubling intervals.
        """
        self._unreported += 1
        self._last_failure_s = now_s
        if not self._standing and self._unreported < self._first:
            return
        # A standing failure is repeated seldom; another message at once, but not without bound
        is_due = now_s - self._reported_s >= self._repeat_s
        is_new = message not in self._messages and len(self._messages) < _MESSAGES_MAX
        if self._standing and not is_due and not is_new:
            return
        if is_due and self._standing:
            self._repeat_s = min(2 * self._repeat_s, _LAST_REPEAT_S)
            self._messages.clear()
        self._messages.add(message)
        self._standing = True
        self._reported_s = now_s
        self._count_and_report(message, works=False)

    def note_success(self, now_s: float) -> None:
        """Everything that was asked was answered."""
        # A link that fails now and then does not count as good between the failures
        if now_s - self._last_failure_s < _GOOD_S:
            return
        if self._standing:
            self._count_and_report("answers again", works=True)
        self._standing = False
        self._unreported = 0
        self._repeat_s = _FIRST_REPEAT_S
        self._messages.clear()

    def note_connection(self) -> None:
        """A lost connection is back; whether it stays is not known yet."""
        self._standing = False
        self._count_and_report("connected again", works=True)

    def _count_and_report(self, message: str, works: bool) -> None:
        count, self._unreported = self._unreported, 0
        self._report(message, works, count)
