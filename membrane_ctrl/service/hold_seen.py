"""What the service has received of a hold up to one moment."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.columns import MISSING
from membrane_ctrl.service.ended_run import EndedRun, EndKind

SILENT_S = 5.0  # without a status, the hold hangs or the connection is lost

Message = dict[str, Any]


@dataclass(frozen=True, slots=True)
class HoldSeen:
    """A hold at one moment; replaced as a whole."""

    name: str  # of the run; empty before the first contact
    role: str = "read"  # of this process at the port
    status: Message = field(default_factory=dict)  # the port's last status
    seen_s: float = -math.inf  # monotonic time of that status
    problem: str = "not connected yet"  # why there is no status; empty if there is
    events: tuple[str, ...] = ()  # newest last
    figure: shape_estimate.ShapeEstimate | None = None
    reference: shape_estimate.ShapeEstimate | None = None  # the first usable figure that was seen
    ended: EndedRun | None = None  # the newest run, if its hold has gone

    @property
    def silent(self) -> str:
        """Why the shown status must not be relied on; empty if it may be."""
        if self.problem:
            return self.problem if self.ended is None else self.ended.headline
        age_s = time.monotonic() - self.seen_s
        return f"no status for {age_s:.0f} s" if age_s > SILENT_S else ""

    @property
    def state_name(self) -> str:
        """The hold's state as people read it; without a hold, how the newest run ended."""
        if not self.silent:
            return str(self.status.get("state", MISSING))
        if self.problem and self.ended is not None:
            return "fault" if self.ended.kind is EndKind.FAULT else "ended"
        return "no contact"
