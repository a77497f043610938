"""A ring as the recorder reads it: each message once, also when another recorder goes on where one was killed."""

from __future__ import annotations

from membrane_ctrl.ipc.ring import RingReader


class Feed:
    """Counts messages from the ring's first one on, and passes over those a former recorder has brought to the disk.

    Parameters
    ----------
    reader : RingReader
        Fresh: it starts at the oldest message still in the ring.
    position : int
        Messages already recorded.
    dropped : int
        Messages already known to be lost.

    Attributes
    ----------
    position : int
        Messages recorded or lost so far.
    dropped : int
        Lost: overwritten before any recorder got to them.
    """

    def __init__(self, reader: RingReader, position: int = 0, dropped: int = 0) -> None:
        self._reader = reader
        self._end = 0
        self._lost_by_reader = 0
        self.position = position
        self.dropped = dropped

    def drain(self) -> list[bytes]:
        """All messages since the last call that nobody has recorded yet."""
        messages = self._reader.drain()
        lost = self._reader.dropped - self._lost_by_reader
        self._lost_by_reader = self._reader.dropped
        first = self._end + lost
        self._end = first + len(messages)
        known = min(max(0, self.position - first), len(messages))
        self.dropped += max(0, first - self.position) if lost else 0
        self.position = max(self.position, self._end)
        return messages[known:]
