"""Notices on their way: tried again until they are through, none twice, and never a pile of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from membrane_ctrl.alarms.book import Notice

Send = Callable[[Notice], bool]

_AGAIN_S, _AGAIN_MOST_S = 10.0, 300.0
# a day without network must not end in a thousand mails
_KEPT = 50


class Outbox:
    """A queue in front of a sender that may fail.

    Parameters
    ----------
    send : callable
        Returns whether the notice is through; may take its time, must not raise.

    Attributes
    ----------
    dropped : int
        The oldest of a full box.
    failing : bool
        The last attempt failed.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._waiting: deque[Notice] = deque()
        self._due_s = 0.0
        self._again_s = _AGAIN_S
        self.dropped = 0
        self.failing = False

    def post(self, notice: Notice) -> None:
        """Put a notice in."""
        self._waiting.append(notice)
        if len(self._waiting) > _KEPT:
            self._waiting.popleft()
            self.dropped += 1

    @property
    def empty(self) -> bool:
        """All are through."""
        return not self._waiting

    def step(self, now_s: float) -> None:
        """Send what waits, oldest first, unless the last failure is too fresh."""
        if now_s < self._due_s:
            return
        while self._waiting:
            if not self._send(self._waiting[0]):
                self.failing = True
                self._due_s = now_s + self._again_s
                self._again_s = min(2.0 * self._again_s, _AGAIN_MOST_S)
                return
            self._waiting.popleft()
            self.failing, self._again_s = False, _AGAIN_S
