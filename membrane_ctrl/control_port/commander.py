"""Who has command of a hold: a client's name for single commands, or one session for as long as it
lives.

Single commands (`ctl`, the console, the page) come on connections of their own, so command belongs
to the client's name and lapses some minutes after the last one. A session (tuning, calibration)
sends its commands over minutes to hours on one connection, which it claims: then command belongs to
that connection alone, not to its user. A session that ends, or whose process dies, closes its
connection, and with it gives up command.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CommandSession:
    """A session that has command."""

    id: str  # of its connection
    who: str
    what: str  # as it calls itself
    pid: int | None  # None: on another machine
    since_utc: str

    def describe(self) -> str:
        """Who it is, in words."""
        process = "on another machine"
        if self.pid is not None:
            process = f"process {self.pid}"
        return f"{self.who} ({self.what}, session {self.id}, {process}, since {self.since_utc})"

    def to_dict(self) -> dict[str, str | int | None]:
        """The session as a part of the status."""
        return {
            "id": self.id,
            "who": self.who,
            "what": self.what,
            "pid": self.pid,
            "since_utc": self.since_utc,
        }


class Commander:
    """One commander at a time: the first to command, until it releases or loses command or idles
    too long.
    """

    def __init__(self, lapses_s: float) -> None:
        self._lapses_s = lapses_s
        self._holder = ""
        self._last_s = -math.inf
        self.session: CommandSession | None = None

    def holder(self, now_s: float) -> str:
        """Name of the client that has command; empty if nobody."""
        if self.session is not None:
            return self.session.who
        if now_s - self._last_s <= self._lapses_s:
            return self._holder
        return ""

    def claim(self, who: str, take_over: bool, now_s: float, connection: str = "") -> str:
        """Take or keep command for a single command.

        Parameters
        ----------
        who : str
            The client's name.
        take_over : bool
            Take command from the session that has it.
        now_s : float
            The run's clock.
        connection : str
            The id of the client's connection.

        Returns
        -------
        str
            Why not, or an empty text.
        """
        if self.session is not None and self.session.id == connection:
            return ""
        if not take_over and (refusal := self._explain_refusal(who, now_s)):
            return refusal
        self.session = None
        self._holder = who
        self._last_s = now_s
        return ""

    def begin_session(self, session: CommandSession, take_over: bool, now_s: float) -> str:
        """Give command to a session.

        Parameters
        ----------
        session : CommandSession
            The session.
        take_over : bool
            Also if another client has command.
        now_s : float
            Time of the request.

        Returns
        -------
        str
            Why not; empty if it has command.
        """
        if self.session is not None and self.session.id == session.id:
            return ""
        if not take_over and (refusal := self._explain_refusal(session.who, now_s)):
            return refusal
        self.session = session
        self._holder = ""
        return ""

    def end_session(self, connection: str) -> CommandSession | None:
        """End the session of a connection that is closed; returns it, None if it has no command."""
        ended = self.session
        if ended is None or ended.id != connection:
            return None
        self.session = None
        return ended

    def release(self, who: str, connection: str = "") -> None:
        """Release command, if this client has it; else nothing happens.

        Parameters
        ----------
        who : str
            The client's name.
        connection : str
            The id of its connection: a session of command belongs to that, and not to the name.
        """
        if self.session is not None:
            self.end_session(connection)
        elif self._holder == who:
            self._holder = ""

    def _explain_refusal(self, who: str, now_s: float) -> str:
        """Why a client may not command; empty if it may."""
        if self.session is not None:
            return (
                f"{self.session.describe()} has command; wait for its end, or take over with "
                "--take-over"
            )
        holder = self.holder(now_s)
        if holder in ("", who):
            return ""
        return f"{holder} has command; take over with --take-over, or wait for its release"
