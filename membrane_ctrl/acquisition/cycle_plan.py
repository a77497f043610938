"""The patterns of the measurement cycles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_iface.optical_roles import Pattern


@dataclass(frozen=True, slots=True)
class CyclePlan:
    """The patterns of both kinds of cycle, in order, and the least time between exposures.

    `standing` gives the crossed pattern of the moment where one frame of it takes the place of
    `fringes`.
    """

    full: Sequence[Pattern]
    fringes: Sequence[Pattern]
    frame_interval_s: float
    standing: Callable[[], Pattern] | None = None

    def list_patterns(self, full: bool) -> Sequence[Pattern]:
        """Of the next cycle."""
        if full:
            return self.full
        if self.standing is None:
            return self.fringes
        return [self.standing()]
