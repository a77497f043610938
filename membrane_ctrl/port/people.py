"""Who asks: roles, and the one who has the command."""

from __future__ import annotations

import math
from dataclasses import dataclass

from membrane_ctrl.commands import TABLE, Role
from membrane_ctrl.port.protocol import Action

_RANK: dict[Role, int] = {"read": 0, "operate": 1, "tune": 2}
_ERRANDS: dict[str, Role] = {"status": "read", "watch": "read", "release": "operate", "quiet": "operate"}

# Nobody has to have the command for these: what stops the pump is always taken, the others move nothing
FREE = frozenset({"status", "watch", "stop", "latch", "mark", "release", "quiet"})


@dataclass(frozen=True, slots=True)
class Peer:
    """Who is at the other end of a connection: `unix:NAME` or `tls:NAME`, as the system or a certificate says."""

    who: str
    role: Role


def may_not(peer: Peer, do: Action) -> str:
    """Why the peer may not ask this at all; empty if it may."""
    needed = TABLE[do].role if do in TABLE else _ERRANDS[do]
    if _RANK[peer.role] >= _RANK[needed]:
        return ""
    return f"{do} takes the role {needed}; {peer.who} has {peer.role}"


class Helm:
    """One commander at a time; the first to command has it until it is given back, taken over, or lapses.

    Parameters
    ----------
    lapses_s : float
        Without a command for so long, the next one who commands has it.
    """

    def __init__(self, lapses_s: float) -> None:
        self._lapses_s = lapses_s
        self._holder = ""
        self._last_s = -math.inf

    def holder(self, now_s: float) -> str:
        """Who has the command; empty: nobody."""
        return self._holder if now_s - self._last_s <= self._lapses_s else ""

    def claim(self, who: str, take_over: bool, now_s: float) -> str:
        """Take the command, or keep it; returns why not, or nothing."""
        holder = self.holder(now_s)
        if holder not in ("", who) and not take_over:
            return f"{holder} has the command; take it over (--take-over) or wait until it is given back"
        self._holder, self._last_s = who, now_s
        return ""

    def release(self, who: str) -> None:
        """Give it back; of no effect for anyone else."""
        if self._holder == who:
            self._holder = ""
