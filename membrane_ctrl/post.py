"""A post that is kept filled: a child process that ends is replaced, but not for ever and not at once each time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection

from membrane_ctrl.processes import Child
from membrane_ctrl.tick import Event

# The first replacement comes at once, the next ones later and later: what dies at its start must not keep the
# machine busy with starting it.
_LONGEST_WAIT_S = 60.0
# A day has room for many; what ends more often in an hour will not be mended by starting it again.
_MOST_PER_HOUR = 10
_HOUR_S = 3600.0

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
        self.child, self._line = make(0)

    def start(self) -> None:
        """Start the first child."""
        self.child.start()

    def look(self, now_s: float) -> list[Event]:
        """What it has said since the last call, and what became of it; starts another when that is due.

        Never waits, but for starting a process (some ms, less than a tick).
        """
        said = self._said()
        if self.child.alive:
            return said
        name = self.child.name
        if self._ended_s is None:
            self._ended_s = now_s
            said.append({"kind": "child_ended", "child": name, "exit_code": self.child.exit_code})
        while self._replaced_s and now_s - self._replaced_s[0] > _HOUR_S:
            self._replaced_s.popleft()
        if len(self._replaced_s) >= _MOST_PER_HOUR:
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
        self._ended_s, self._given_up = None, False
        self.child, self._line = self._make(self._count)
        self.child.start()

    def _wait_s(self) -> float:
        return min(_LONGEST_WAIT_S, 2.0 ** (len(self._replaced_s) - 1)) if self._replaced_s else 0.0

    def _said(self) -> list[Event]:
        said: list[Event] = []
        try:
            while self._line.poll():
                said.append(self._line.recv())
        except (EOFError, OSError):  # it has ended
            pass
        return said
