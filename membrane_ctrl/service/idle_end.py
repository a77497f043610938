"""When a service that a hold has started ends: an hour after its last viewer and its last hold."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class IdleEnd:
    """Counts the time without use; the clock is the caller's.

    Attributes
    ----------
    limit_s : float
        Time without viewers and without a hold after which the service ends.
    used_s : float
        When it was last used; at first, when it began.
    """

    limit_s: float
    used_s: float

    def note_use(self, now_s: float, viewers: int, holding: bool) -> None:
        """Note how many viewers there are, and whether a hold runs.

        Parameters
        ----------
        now_s : float
            Time by the clock of `used_s`, which is the caller's.
        viewers : int
            Open pages.
        holding : bool
            Whether a hold runs in a folder of the service: it is never left without its page.
        """
        if viewers > 0 or holding:
            self.used_s = now_s

    def is_due(self, now_s: float) -> bool:
        """Whether the service should end."""
        return now_s - self.used_s >= self.limit_s
