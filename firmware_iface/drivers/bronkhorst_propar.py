"""Bronkhorst parameters over ProPar on a serial line, in its binary form.

Source: manual 9.17.027. Binary, because its messages carry a sequence number: an answer is never taken for that of
another question. What ProPar lacks is a checksum. So every number is asked for three times in one message, and what
was written is read back; a flipped bit then makes answers that differ.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from firmware_iface.drivers.bronkhorst import MEASURE, Parameter
from firmware_iface.drivers.propar import (
    STATUS,
    STATUS_TEXT,
    VALUES,
    Message,
    binary_frame,
    request,
    split_binary,
    values,
    write_data,
)
from firmware_iface.links.exchange import Question, SerialExchange
from firmware_iface.links.serial_port import BytePort
from firmware_iface.roles import DeviceRefusedError, LinkError

MANUAL = "Bronkhorst 9.17.027, sections 3.4 to 3.6"
_QUIET_S = 0.1
_ANSWER_BYTES = 50  # the longest: a text of 16 characters, or three floats, with every byte doubled
# Two copies are hit at the same bit once in a million messages on a line where a tenth of them is hit at all
_COPIES = 3
_REFUSALS = (3, 4, 5, 6, 13)  # status: the request itself is wrong for this instrument
_SEQUENCES = 256
_FORMATS = {"u8": ">B", "u16": ">H", "f32": ">f"}


class ProparParameters:
    """Parameters of one instrument on a line of its own.

    Parameters
    ----------
    port : BytePort
        The line.
    node : int
        128: whichever instrument is at the end of the cable.
    timeout_s : float
        For the instrument to answer; the time on the wire comes on top.
    """

    def __init__(self, port: BytePort, node: int = 128, timeout_s: float = 0.2) -> None:
        self._port = port
        self._node = node
        self._timeout_s = timeout_s
        self._exchange = SerialExchange(port, gap_s=0.0, quiet_s=_QUIET_S)
        self._sequence = 0

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self._port.name} node {self._node}"

    async def connect(self) -> None:
        """Open the port, unless that is done. Raises LinkDownError."""
        if not self._port.is_open:
            self._exchange.connect()

    async def number(self, parameter: Parameter) -> float:
        """A number that came `_COPIES` times the same. Raises LinkError."""
        first, *others = await self._asked(*[parameter] * _COPIES)
        if any(other != first for other in others):
            came = ", ".join(raw.hex() for raw in (first, *others))
            raise LinkError(f"{self.name}: {parameter.name} came as {came}; noise")
        return float(struct.unpack(_FORMATS[parameter.kind], first)[0])

    async def text(self, parameter: Parameter) -> str:
        """A text that came twice. Raises LinkError."""
        first, second = (await self._asked(parameter))[0], (await self._asked(parameter))[0]
        if first != second:
            raise LinkError(f"{self.name}: {parameter.name} came as {first!r} and as {second!r}; noise")
        return first.split(b"\0")[0].decode("ascii", "replace").strip()

    async def write(self, parameter: Parameter, value: int) -> None:
        """Write, and read back. Raises LinkError."""
        answer = await self._transact(write_data(parameter, value), f"writing {parameter.name}")
        if answer[0] != STATUS:
            raise LinkError(f"{self.name}: writing {parameter.name}: command {answer[0]} came instead of a status")
        found = await self.number(parameter)
        if found != value:
            raise LinkError(f"{self.name}: {parameter.name} written {value}, read back {found:g}")

    async def close(self) -> None:
        """Close the port. Never raises."""
        await self._exchange.close()

    def describe(self) -> dict[str, str]:
        """Port, settings, manual."""
        return {"port": f"{self.name}, {self._port.settings}", "manual": MANUAL}

    async def _asked(self, *parameters: Parameter) -> list[bytes]:
        """Raw values of several parameters, from one message."""
        what = f"reading {parameters[0].name}"
        answer = await self._transact(request(parameters), what)
        try:
            found = values(answer)
        except (ValueError, IndexError) as error:
            raise LinkError(f"{self.name}: {what}: the answer does not add up ({error})") from error
        if answer[0] != VALUES or [(group, index) for group, index, _ in found] != [
            (place, place) for place in range(len(parameters))
        ]:
            raise LinkError(f"{self.name}: {what}: something else was answered than asked")
        for parameter, (_, _, raw) in zip(parameters, found, strict=True):
            if parameter.kind in _FORMATS and len(raw) != struct.calcsize(_FORMATS[parameter.kind]):
                raise LinkError(f"{self.name}: {what}: a value of another type was answered")
        return [raw for _, _, raw in found]

    async def _transact(self, data: bytes, what: str) -> bytes:
        """Data of the answer with the question's own sequence number; a status other than 0 is raised."""
        what = f"{self.name}: {what}"
        question = self._question(data, what)
        fence = self._question(request([MEASURE]), f"{self.name}: asking anew after a loss")
        answer = await self._exchange.ask(question, self._timeout_s, fence)
        message = split_binary(answer)[0][-1]
        if message.data[0] != STATUS:
            return message.data
        code = message.data[1] if len(message.data) > 1 else 255
        if code == 0:
            return message.data
        kind = DeviceRefusedError if code in _REFUSALS else LinkError
        raise kind(f"{what}: status {code} ({STATUS_TEXT.get(code, 'unknown')})")

    def _question(self, data: bytes, what: str) -> Question:
        self._sequence = (self._sequence + 1) % _SEQUENCES
        frame = binary_frame(Message(self._sequence, self._node, data))
        return Question(frame, _taker(self._sequence, self._node), 2 * _ANSWER_BYTES, what)


def _taker(sequence: int, node: int) -> Callable[[bytes], bytes | None]:
    """Finds the answer with this sequence number; others are late and thrown away."""

    def take(heard: bytes) -> bytes | None:
        for message in split_binary(heard)[0]:
            if (message.sequence, message.node) == (sequence, node):
                return binary_frame(message)
        return None

    return take
