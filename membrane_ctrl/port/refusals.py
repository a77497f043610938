"""What was refused goes on record, but nobody can fill the record with it."""

from __future__ import annotations

from collections.abc import Callable

from membrane_ctrl.tick import Event

# An honest mistake or ten are all there; of a flood one in ten seconds, with the count of the others
_BURST = 10.0
_PER_S = 0.1


class Refusals:
    """Records refusals, a bucket of them at a time.

    Parameters
    ----------
    tell : callable
        Puts an event on record.
    now : callable
        The run's clock.

    Attributes
    ----------
    count : int
        All of them.
    """

    def __init__(self, tell: Callable[[Event], None], now: Callable[[], float]) -> None:
        self._tell, self._now = tell, now
        self._left, self._since_s = _BURST, now()
        self._unsaid = 0
        self.count = 0

    def record(self, who: str, command: str, reason: str, why: str = "") -> None:
        """Count a refusal, and record it if the bucket allows."""
        self.count += 1
        now_s = self._now()
        self._left = min(_BURST, self._left + _PER_S * (now_s - self._since_s))
        self._since_s = now_s
        if self._left < 1.0:
            self._unsaid += 1
            return
        self._left -= 1.0
        event: Event = {"kind": "refused", "who": who, "command": command, "why": why, "reason": reason}
        if self._unsaid:
            event["and_unrecorded"] = self._unsaid
        self._tell(event)
        self._unsaid = 0
