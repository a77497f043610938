"""A post that is kept filled: a child process that ends or falls silent is replaced, but not for ever.

A child says each second or so that it is alive, and for how long it may now be silent (`child_report.alive`). A
process that was stopped, or that hangs, is still there but does not keep its word: it is killed, and the next one
takes its place.
"""

from __future__ import annotations

import math
import select
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection

from membrane_ctrl.child_report import ALIVE
from membrane_ctrl.processes import Child
from membrane_ctrl.tick import Event

# The first replacement comes at once, the next ones later and later: what dies at its start must not keep the
# machine busy with starting it.
_LONGEST_WAIT_S = 60.0
# A day has room for many; what ends more often in an hour will not be mended by starting it again.
_MOST_PER_HOUR = 10
_HOUR_S = 3600.0
# Until its first word: an interpreter that starts on a busy machine. What takes longer is said in that word.
_STARTS_S = 60.0

Make = Callable[[int], tuple[Child, Connection]]


class Post:
    """One such post.

    Parameters
    ----------
    make : callable
        Makes the child that comes after so many others, not started yet, and the end of the pipe it reports by.

    Attributes
    ----------
    child : Child
        Who fills it now, or did last.
    """

    def __init__(self, make: Make) -> None:
        self._make = make
        self._replaced_s: deque[float] = deque()
        self._count = 0
        self._ended_s: float | None = None
        self._given_up = False
        self._expected_s = math.inf  # the child's next word
        self._silent = False
        self.child, self._line = make(0)

    def start(self, now_s: float) -> None:
        """Start the first child."""
        self._expected_s = now_s + _STARTS_S
        self.child.start()

    def send(self, word: str) -> bool:
        """Hand a word to the child; False if nobody takes it now. Never waits."""
        try:
            if not (self.child.alive and select.select([], [self._line.fileno()], [], 0)[1]):
                return False
            self._line.send(word)
        except OSError:
            return False
        return True

    def look(self, now_s: float) -> list[Event]:
        """What it has said since the last call, and what became of it; starts another when that is due.

        Never waits, but for starting a process (some ms, less than a tick).
        """
        said = self._said(now_s)
        if self.child.alive:
            if now_s > self._expected_s and not self._silent:
                said.append(self._fell_silent(now_s))
            return said
        name = self.child.name
        if self._ended_s is None:
            self._ended_s = now_s
            said.append({"kind": "child_ended", "child": name, "exit_code": self.child.exit_code})
        if self._used_up(now_s):
            if not self._given_up:
                self._given_up = True
                said.append({"kind": "child_given_up", "child": name, "restarts": len(self._replaced_s)})
            return said
        if now_s - self._ended_s >= self._wait_s():
            self.replace(now_s)
            said.append({"kind": "child_restarted", "child": name, "restarts": self._count})
        return said

    def replace(self, now_s: float) -> None:
        """Start another child in the place of the one that ended."""
        self._line.close()
        self._count += 1
        self._replaced_s.append(now_s)
        self._ended_s, self._given_up, self._silent = None, False, False
        self._expected_s = now_s + _STARTS_S
        self.child, self._line = self._make(self._count)
        self.child.start()

    def _fell_silent(self, now_s: float) -> Event:
        """Kill who keeps still, unless nobody may take the place: half a recorder is better than none."""
        self._silent = True
        late_s = round(now_s - self._expected_s, 1)
        killed = not self._used_up(now_s)
        if killed:
            self.child.kill()
        return {"kind": "child_silent", "child": self.child.name, "overdue_s": late_s, "killed": killed}

    def _used_up(self, now_s: float) -> bool:
        """Whether this hour's replacements are spent."""
        while self._replaced_s and now_s - self._replaced_s[0] > _HOUR_S:
            self._replaced_s.popleft()
        return len(self._replaced_s) >= _MOST_PER_HOUR

    def _wait_s(self) -> float:
        return min(_LONGEST_WAIT_S, 2.0 ** (len(self._replaced_s) - 1)) if self._replaced_s else 0.0

    def _said(self, now_s: float) -> list[Event]:
        said: list[Event] = []
        try:
            while self._line.poll():
                event = self._line.recv()
                if event["kind"] == ALIVE:
                    self._expected_s, self._silent = now_s + event["for_s"], False
                else:
                    said.append(event)
        except (EOFError, OSError):  # it has ended
            pass
        return said
