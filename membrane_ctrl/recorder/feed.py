"""A ring as the recorder reads it: each message once, even when a new recorder continues after a
killed one.
"""

from membrane_ctrl.processes.ring import RingReader


class Feed:
    """Counts messages from the ring's first one, and skips those that an earlier recorder has
    written to disk.

    The reader is fresh: it starts at the oldest message still in the ring. `position` messages are
    recorded or lost, `dropped` of them overwritten before any recorder got to them.
    """

    def __init__(self, reader: RingReader, position: int = 0, dropped: int = 0) -> None:
        self._reader = reader
        self._end = 0
        self._lost_by_reader = 0
        self.position = position
        self.dropped = dropped

    def drain_messages(self) -> list[bytes]:
        """Unrecorded messages since the last call."""
        messages = self._reader.drain()
        lost = self._reader.dropped - self._lost_by_reader
        self._lost_by_reader = self._reader.dropped
        first = self._end + lost
        self._end = first + len(messages)
        known = min(max(0, self.position - first), len(messages))
        self.dropped += max(0, first - self.position) if lost else 0
        self.position = max(self.position, self._end)
        return messages[known:]
