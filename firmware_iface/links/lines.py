"""One device that is asked in lines of text."""

from __future__ import annotations

import re
from dataclasses import dataclass

from firmware_iface.links.exchange import Question, SerialExchange
from firmware_iface.links.serial_port import BytePort
from firmware_iface.roles import LinkError

_SHOWN_CHARS = 60
_LINE_ENDS = b"\r\n"


@dataclass(frozen=True, slots=True)
class LineFence:
    """A question whose answer cannot be that of any other (see `exchange`)."""

    command: str
    answer: re.Pattern[str]
    longest: int = 80


class LineLink:
    """Commands out, lines of text back, each checked as a whole against what it has to look like.

    Parameters
    ----------
    port : BytePort
        The line.
    end : str
        What a command ends in.
    timeout_s : float
        For the device; the time on the wire comes on top.
    fence : LineFence
        Asked after a loss.
    quiet_s : float
        Silence after a loss.
    """

    def __init__(self, port: BytePort, end: str, timeout_s: float, fence: LineFence, quiet_s: float = 0.1) -> None:
        self._exchange = SerialExchange(port, gap_s=0.0, quiet_s=quiet_s, blank=_LINE_ENDS)
        self._end = end
        self._timeout_s = timeout_s
        self._fence = fence

    @property
    def name(self) -> str:
        """For messages."""
        return self._exchange.port.name

    @property
    def connected(self) -> bool:
        """Whether the line is open."""
        return self._exchange.port.is_open

    @property
    def reconnects(self) -> int:
        """Times the line was opened after the first."""
        return self._exchange.port.reconnects

    @property
    def retry_in_s(self) -> float:
        """Time until `connect` will try."""
        return self._exchange.port.retry_in_s

    def connect(self, greeting: str = "") -> None:
        """Open the line; see `SerialExchange.connect`. Raises LinkDownError."""
        self._exchange.connect(greeting.encode("ascii"))

    async def close(self) -> None:
        """Close the line; a question in flight fails at once."""
        await self._exchange.close()

    async def query(self, command: str, answer: re.Pattern[str], longest: int = 80) -> re.Match[str]:
        """The answer to a command, whose whole text has the given form (line ends included).

        Parameters
        ----------
        command : str
            Without its end.
        answer : re.Pattern
            Has to match everything that comes, line ends before it aside, and nothing that is still incomplete.
        longest : int
            Characters of the longest answer; more are no answer.

        Raises
        ------
        LinkError
            No answer of this form in time.
        LinkDownError
            The line is gone.
        """
        fence = self._question(self._fence.command, self._fence.answer, self._fence.longest)
        heard = await self._exchange.ask(self._question(command, answer, longest), self._timeout_s, fence)
        found = answer.fullmatch(heard.decode("ascii"))
        assert found is not None  # `take` has matched it
        return found

    def _question(self, command: str, answer: re.Pattern[str], longest: int) -> Question:
        what = f"{self.name}: {command.splitlines()[-1]}"

        def take(heard: bytes) -> bytes | None:
            heard = heard.lstrip(_LINE_ENDS)
            try:
                text = heard.decode("ascii")
            except UnicodeDecodeError:
                raise LinkError(f"{what}: not text ({heard[:24].hex(' ')}); noise, or wrong baud rate") from None
            if answer.fullmatch(text):
                return heard
            if len(text) > longest:
                raise LinkError(f"{what}: {text[:_SHOWN_CHARS]!r}... is no answer to this")
            return None

        return Question((command + self._end).encode("ascii"), take, longest, what)
