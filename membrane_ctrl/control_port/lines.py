"""Lines from a peer that is not trusted: bounded in length, in time and in number.

A peer may send a line that never ends, a byte a minute, or thousands of lines a second. Each of
them would otherwise cost the reader its memory or its time.
"""

from __future__ import annotations

import select
import socket
import time

# The longest line of a hold is the answer to `status`: some 5 kB, and at most 16 kB with every
# notice there is.
LINE_BYTES_MAX = 65_536

_READ_BYTES = 16_384
# Lines a second, as a token bucket. A real hold sends ten states a second, and after a fault
# some tens of events.
_BURST = 1000.0
_PER_S = 200.0


class LineError(ConnectionError):
    """A peer that exceeds a limit; the text is the reason, for use within a sentence."""


class LineReader:
    """Reads lines from a connected socket.

    Parameters
    ----------
    connection : socket
        In blocking mode; its time-out is set for each read.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._unread = bytearray()
        self._tokens = _BURST
        self._counted_s = time.monotonic()

    def read_line(self, until_s: float) -> bytes | None:
        """Read the next line, which must be complete at a time of the monotonic clock.

        Returns
        -------
        bytes or None
            The line without its end; None if the peer has closed the connection.

        Raises
        ------
        TimeoutError
            The line is not complete in time.
        LineError
            The line is too long, or there are too many.
        OSError
            The connection failed.
        """
        # Each byte is searched once, and no more is kept than the longest line has
        searched = 0
        while (end := self._unread.find(b"\n", searched)) < 0:
            searched = len(self._unread)
            if searched > LINE_BYTES_MAX:
                raise LineError(f"a line of more than {LINE_BYTES_MAX} bytes")
            received = self._receive(until_s)
            if not received:
                return None
            self._unread += received
        if end > LINE_BYTES_MAX:
            raise LineError(f"a line of more than {LINE_BYTES_MAX} bytes")
        line = bytes(self._unread[:end])
        del self._unread[: end + 1]
        self._count_line()
        return line

    def waiting(self) -> bool:
        """Whether a read would return at once: something has arrived, or the peer has gone."""
        if b"\n" in self._unread:
            return True
        return bool(select.select([self._connection], [], [], 0.0)[0])

    def _receive(self, until_s: float) -> bytes:
        left_s = until_s - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError
        self._connection.settimeout(left_s)
        return self._connection.recv(_READ_BYTES)

    def _count_line(self) -> None:
        now_s = time.monotonic()
        self._tokens = min(_BURST, self._tokens + _PER_S * (now_s - self._counted_s))
        self._counted_s = now_s
        self._tokens -= 1.0
        if self._tokens < 0.0:
            raise LineError(f"more than {_PER_S:g} lines a second")
