"""A queue of alarm messages to one list of services."""

from collections import deque
from collections.abc import Callable

from membrane_ctrl.alarms.book import AlarmMessage
from membrane_ctrl.model.durations import pause_s

Send = Callable[[AlarmMessage], bool]

_AGAIN_S, _AGAIN_MOST_S = 10.0, 300.0
# a day without a network must not end in a thousand mails
_KEPT = 50


class Outbox:
    """A queue of messages, each tried until it is sent; a full box drops the oldest, which
    `dropped` counts.

    `send` returns whether the message was sent; it may be slow but must not raise.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._waiting: deque[AlarmMessage] = deque()
        self._due_s = 0.0
        self.failures = 0  # since the last success
        self.dropped = 0

    def queue_message(self, message: AlarmMessage) -> None:
        """Queue a message."""
        self._waiting.append(message)
        if len(self._waiting) > _KEPT:
            self._waiting.popleft()
            self.dropped += 1

    @property
    def is_empty(self) -> bool:
        """All messages are sent."""
        return not self._waiting

    def step(self, now_s: float) -> None:
        """Send queued messages, oldest first, unless the last failure is too recent."""
        if now_s < self._due_s:
            return
        while self._waiting:
            if not self._send(self._waiting[0]):
                self.failures += 1
                self._due_s = now_s + pause_s(self.failures, _AGAIN_S, _AGAIN_MOST_S)
                return
            self._waiting.popleft()
            self.failures = 0
