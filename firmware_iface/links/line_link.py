"""Devices that answer lines of text: questions, answers, and the base of their drivers."""

import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from firmware_iface.links.exchange import SerialExchange, WireQuestion
from firmware_iface.links.serial_port import SerialPort
from firmware_iface.roles import DeviceIdentity, LinkError

_SHOWN_CHARS = 60
_LINE_ENDS = b"\r\n"


@dataclass(frozen=True, slots=True)
class LineFence:
    """A question whose answer cannot be that of any other (see `exchange`)."""

    command: str
    answer: re.Pattern[str]
    longest: int = 80


class LineLink:
    """Commands out, lines of text back, each checked as a whole against its expected form.

    Parameters
    ----------
    port : SerialPort
        The line.
    end : str
        Ends each command, such as CR LF.
    timeout_s : float
        Of the device; the time on the wire is added.
    fence : LineFence
        Question that shows, after a loss, that no earlier answer is still to come.
    quiet_s : float
        Silence after a loss, before the fence.
    """

    def __init__(
        self, port: SerialPort, end: str, timeout_s: float, fence: LineFence, quiet_s: float = 0.1
    ) -> None:
        self.port = port
        self._exchange = SerialExchange(port, gap_s=0.0, quiet_s=quiet_s, blank=_LINE_ENDS)
        self._end = end
        self._timeout_s = timeout_s
        self._fence = fence

    @property
    def name(self) -> str:
        """For messages."""
        return self.port.name

    def connect(self, greeting: str = "") -> None:
        """Open the line; see `SerialExchange.connect`. Raises LinkDownError."""
        self._exchange.connect(greeting.encode("ascii"))

    async def close(self) -> None:
        """Close the line; a question in flight fails at once."""
        await self._exchange.close()

    async def query(
        self, command: str, answer: re.Pattern[str], longest: int = 80
    ) -> re.Match[str]:
        """Send a command and return its answer.

        Parameters
        ----------
        command : str
            Without its line end.
        answer : re.Pattern
            Must match all that comes, line ends included, except line ends before it; and nothing
            that is still incomplete.
        longest : int
            More characters than this are no answer.

        Returns
        -------
        Match[str]
            The match.

        Raises
        ------
        LinkError
            No answer of this form in time.
        LinkDownError
            The line is gone.
        """
        fence = self._make_question(self._fence.command, self._fence.answer, self._fence.longest)
        received_bytes = await self._exchange.ask(
            self._make_question(command, answer, longest), self._timeout_s, fence
        )
        found = answer.fullmatch(received_bytes.decode("ascii"))
        assert found is not None  # `extract_answer` matched it
        return found

    def _make_question(self, command: str, answer: re.Pattern[str], longest: int) -> WireQuestion:
        what = f"{self.name}: {command.splitlines()[-1]}"

        def extract_answer(received_bytes: bytes) -> bytes | None:
            received_bytes = received_bytes.lstrip(_LINE_ENDS)
            try:
                text = received_bytes.decode("ascii")
            except UnicodeDecodeError:
                raise LinkError(
                    f"{what}: not text ({received_bytes[:24].hex(' ')}); noise, or wrong baud rate"
                ) from None
            if answer.fullmatch(text):
                return received_bytes
            if len(text) > longest:
                raise LinkError(f"{what}: {text[:_SHOWN_CHARS]!r}... is not a valid answer")
            return None

        request = command + self._end
        # a device may confirm a command by repeating it: that is no echo of the adapter
        repeats = answer.fullmatch(request) is not None
        return WireQuestion(
            request.encode("ascii"), extract_answer, longest, what, answer_repeats=repeats
        )


class LineDriver:
    """Base of a driver for a device that answers lines of text on its own serial port.

    Parameters
    ----------
    port, end, timeout_s, fence
        As for `LineLink`.
    """

    manual = ""

    def __init__(self, port: SerialPort, end: str, timeout_s: float, fence: LineFence) -> None:
        self._link = LineLink(port, end, timeout_s, fence)

    async def _open_port(
        self, begin: Callable[[], Awaitable[DeviceIdentity]], greeting: str = ""
    ) -> DeviceIdentity:
        """Open the port and begin; the port is closed again when that fails."""
        self._link.connect(greeting)
        try:
            return await begin()
        except LinkError:
            await self._link.close()
            raise

    async def close(self) -> None:
        """Close the port. Never raises."""
        await self._link.close()

    @property
    def _shown(self) -> str:
        """The settings in words; a driver may add its own."""
        return ""

    def describe(self) -> dict[str, str]:
        """For people: port, settings, manual."""
        port = f"{self._link.name}, {self._link.port.settings}"
        return {"port": port, "settings": self._shown, "manual": self.manual}
