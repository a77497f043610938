"""What may keep a command from being sent after the hold has answered."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SendLimits:
    """What may keep a command from being sent after the hold has answered the connection."""

    # monotonic time; later it is not sent, and the hold does not obey it
    deadline_s: float = math.inf
    refusal: Callable[[], str] = str  # why it must not be sent any more; empty if it may

    def find_refusal(self) -> str:
        """Why the command must not be sent now; empty if it may."""
        if time.monotonic() > self.deadline_s:
            return "the hold answered too late, so it was not sent"
        return self.refusal()
