"""A child process that is replaced when it ends or falls silent."""

import math
import select
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection

from membrane_ctrl.model import child_events, event_lines, events
from membrane_ctrl.model.durations import pause_s
from membrane_ctrl.processes.child import Child

# Restarting does not help a child that ends more often
_MOST_PER_HOUR = 10
_HOUR_S = 3600.0
# Until the first report: the interpreter may start on a busy machine
_STARTS_S = 60.0

Make = Callable[[int], tuple[Child, Connection]]


class ManagedChild:
    """A child process that is replaced when it ends or falls silent; `child` is the current one.

    A child reports about once a second that it is alive, and how long it may now be silent
    (`child_events.Alive`). A stopped or hung child breaks that promise and is killed. `make` gets
    the number of earlier children and returns the next one, not yet started, with our end of its
    pipe.
    """

    def __init__(self, make: Make) -> None:
        self._make = make
        self._replaced_s: deque[float] = deque()
        self._count = 0
        self._ended_s: float | None = None
        self._given_up = False
        self._expected_s = math.inf  # when the next report is due
        self._silent = False
        self.child, self._line = make(0)

    def start(self, now_s: float) -> None:
        """Start the first child."""
        self._expected_s = now_s + _STARTS_S
        self.child.start()

    def send(self, word: str) -> bool:
        """Send the child a message without waiting; False if the pipe is full."""
        try:
            if not (self.child.alive and select.select([], [self._line.fileno()], [], 0)[1]):
                return False
            self._line.send(word)
        except OSError:
            return False
        return True

    def check_child(self, now_s: float) -> list[events.Event]:
        """Return reports and fate of the child since the last call; start the next one when due
        (some ms).
        """
        # 1. A child that lives reports, or is killed if it is silent for longer than it stated
        reports = self._read_reports(now_s)
        if self.child.alive:
            if now_s > self._expected_s and not self._silent:
                reports.append(self._kill_silent(now_s))
            return reports
        # 2. One that has ended is reported once, then replaced, up to some times an hour
        name = self.child.name
        if self._ended_s is None:
            self._ended_s = now_s
            reports.append(child_events.ChildEnded(name, self.child.exit_code))
        if self._has_no_replacement_left(now_s):
            if not self._given_up:
                self._given_up = True
                reports.append(child_events.ChildGivenUp(name, len(self._replaced_s)))
            return reports
        # at once, then at growing intervals: a child that dies at its start must not keep the
        # machine busy
        if now_s - self._ended_s >= pause_s(len(self._replaced_s)):
            self.replace_child(now_s)
            reports.append(child_events.ChildRestarted(name, self._count))
        return reports

    def replace_child(self, now_s: float) -> None:
        """Start another child in its place."""
        self._line.close()
        self._count += 1
        self._replaced_s.append(now_s)
        self._ended_s = None
        self._given_up = False
        self._silent = False
        self._expected_s = now_s + _STARTS_S
        self.child, self._line = self._make(self._count)
        self.child.start()

    def _kill_silent(self, now_s: float) -> events.Event:
        """Kill a silent child, unless it may not be replaced:
        a slow recorder is better than none.
        """
        self._silent = True
        late_s = round(now_s - self._expected_s, 1)
        killed = not self._has_no_replacement_left(now_s)
        if killed:
            self.child.kill()
        return child_events.ChildSilent(self.child.name, late_s, killed)

    def _has_no_replacement_left(self, now_s: float) -> bool:
        """Whether this hour's replacements are spent."""
        while self._replaced_s and now_s - self._replaced_s[0] > _HOUR_S:
            self._replaced_s.popleft()
        return len(self._replaced_s) >= _MOST_PER_HOUR

    def _read_reports(self, now_s: float) -> list[events.Event]:
        reports: list[events.Event] = []
        try:
            while self._line.poll():
                event = event_lines.from_dict(self._line.recv())
                if isinstance(event, child_events.Alive):
                    self._expected_s = now_s + event.for_s
                    self._silent = False
                else:
                    reports.append(event)
        except (EOFError, OSError):  # it has ended
            pass
        return reports
