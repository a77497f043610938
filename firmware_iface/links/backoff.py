"""How long to leave a device alone after a failed attempt to connect."""

from __future__ import annotations

# quick enough for a cable put back, slow enough not to hammer a server that accepts and hangs up
FIRST_S = 0.1
LONGEST_S = 5.0


class BackOff:
    """Doubling waits between attempts.

    Every attempt counts as failed until `succeeded` is called; a connection that is accepted and dropped before one
    valid answer is therefore no success.
    """

    def __init__(self) -> None:
        self._wait_s = 0.0
        self._earliest_s = float("-inf")

    def remaining_s(self, now_s: float) -> float:
        """Time until the next attempt is due; 0 when it is."""
        return max(0.0, self._earliest_s - now_s)

    def attempted(self, now_s: float) -> None:
        """An attempt begins."""
        self._wait_s = min(max(2 * self._wait_s, FIRST_S), LONGEST_S)
        self._earliest_s = now_s + self._wait_s

    def succeeded(self) -> None:
        """A valid answer came: the next attempt may be made at once."""
        self._wait_s = 0.0
        self._earliest_s = float("-inf")
