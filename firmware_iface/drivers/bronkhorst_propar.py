"""Bronkhorst parameters over ProPar on a serial line, in its binary form.

Source: manual 9.17.027. Binary, because its messages carry a sequence number: an answer is never
taken for that of another question. ProPar lacks a checksum. So every number is requested three
times in one message, and written values are read back; a flipped bit then makes the answers differ.

Messages: binary is DLE STX sequence node length data DLE ETX, with a DLE inside doubled (section
3.6); ASCII is a colon, then length + 1, node and data as hexadecimal, CR LF (section 3.5).
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_iface.drivers.bronkhorst import MEASURE
from firmware_iface.drivers.bronkhorst_parameter import InstrumentParameter
from firmware_iface.links import exchange, serial_port
from firmware_iface.roles import DeviceRefusedError, LinkError

# Commands: status, write with answer, values, request
STATUS, WRITE, VALUES, REQUEST = 0, 1, 2, 4
_DLE, _STX, _ETX = 0x10, 0x02, 0x03
_BEGIN = bytes((_DLE, _STX))
_TYPES = {"u8": 0x00, "u16": 0x20, "f32": 0x40, "text": 0x60}
_PROPAR_FORMATS = {0x00: ">B", 0x20: ">H", 0x40: ">I"}
STATUS_TEXT = {
    0: "no error",
    1: "process claimed",
    2: "command error",
    3: "process error",
    4: "parameter error",
    5: "parameter type error",
    6: "parameter value error",
    7: "network not active",
    8: "time-out start character",
    9: "time-out serial line",
    10: "hardware memory error",
    11: "node number error",
    12: "general communication error",
    13: "read only parameter",
}
MANUAL = "Bronkhorst 9.17.027, sections 3.4 to 3.6"
_QUIET_S = 0.1
_ANSWER_BYTES = 50  # the longest: a text of 16 characters, or three floats, with every byte doubled
# With errors in a tenth of the messages, the same bit flips in two copies once in a million
_COPIES = 3
_REFUSALS = (3, 4, 5, 6, 13)  # status: the request itself is wrong for this instrument
_SEQUENCES = 256
_FORMATS = {"u8": ">B", "u16": ">H", "f32": ">f"}


@dataclass(frozen=True, slots=True)
class ProparMessage:
    """One message: sequence number (0 in ASCII, which has none), node and data."""

    sequence: int
    node: int
    data: bytes


def binary_frame(message: ProparMessage) -> bytes:
    """As sent in binary."""
    body = bytes([message.sequence, message.node, len(message.data)]) + message.data
    return bytes([_DLE, _STX]) + body.replace(b"\x10", b"\x10\x10") + bytes([_DLE, _ETX])


def ascii_frame(message: ProparMessage) -> bytes:
    """As sent in ASCII."""
    return b":%02X%02X%s\r\n" % (
        len(message.data) + 1,
        message.node,
        message.data.hex().upper().encode(),
    )


def split_binary(received: bytes) -> tuple[list[ProparMessage], bytes]:
    """Return the complete messages received, and the remaining bytes; broken messages are dropped.

    The form of a message is in the module's docstring.
    """
    messages: list[ProparMessage] = []
    while (start := received.find(_BEGIN)) >= 0:
        # Read to the next DLE that is not doubled
        body = bytearray()
        at = start + len(_BEGIN)
        while at + 1 < len(received) and (received[at] != _DLE or received[at + 1] == _DLE):
            body.append(received[at])
            at += 2 if received[at] == _DLE else 1
        if at + 1 >= len(received):
            return messages, received[start:]
        # After it comes ETX, or the message is broken and another begins here
        if received[at + 1] != _ETX:
            received = received[at:]
            continue
        data = bytes(body[3:])
        if data and body[2] == len(data):
            messages.append(ProparMessage(body[0], body[1], data))
        received = received[at + 2 :]
    # A single DLE at the end may begin the next message
    if received.endswith(_BEGIN[:1]):
        return messages, received[-1:]
    return messages, b""


def parse_ascii(line: bytes) -> ProparMessage | None:
    """The message in a line, None if invalid."""
    try:
        raw = bytes.fromhex(line.strip().removeprefix(b":").decode("ascii"))
    except ValueError:
        return None
    if not line.startswith(b":") or len(raw) < 3 or raw[0] != len(raw) - 1:
        return None
    return ProparMessage(0, raw[1], raw[2:])


def make_request(parameters: Sequence[InstrumentParameter]) -> bytes:
    """Data that asks for parameters of one process or several, each under its place in the list as
    its index.
    """
    data = bytearray([REQUEST])
    for place, parameter in enumerate(parameters):
        more = 0x80 if place + 1 < len(parameters) else 0
        kind = _TYPES[parameter.kind]
        # each parameter has its own process group: the place is both the group's and the
        # parameter's index
        data += bytes([place | more, place | kind, parameter.process, parameter.number | kind])
        if parameter.kind == "text":
            data.append(parameter.chars)
    return bytes(data)


def write_data(parameter: InstrumentParameter, value: int) -> bytes:
    """Data of a message that writes a number; the instrument answers it with a status.

    Parameters
    ----------
    parameter : InstrumentParameter
        One of kind `u8` or `u16`.
    value : int
        In the instrument's counts, big end first on the wire.
    """
    kind = _TYPES[parameter.kind]
    return bytes([WRITE, parameter.process, parameter.number | kind]) + struct.pack(
        _PROPAR_FORMATS[kind], value
    )


def parse_values(data: bytes) -> list[tuple[int, int, bytes]]:
    """Index of process, index of parameter and raw value of each parameter in data of an answer or
    a write.

    Raises ValueError when the data do not add up.
    """
    found: list[tuple[int, int, bytes]] = []
    at = 1
    group = 0
    chained = False
    last_group = False
    while at < len(data):
        # A process number begins a group; its top bit announces another group.
        if not chained:
            if last_group:
                raise ValueError("bytes after the last process")
            group, last_group = data[at] & 0x7F, not data[at] & 0x80
            at += 1
        # A parameter: its number, its type, and whether another one of this process follows.
        index = data[at] & 0x1F
        kind = data[at] & 0x60
        chained = bool(data[at] & 0x80)
        at += 1
        # A string has its length in front, or ends with a zero; other types have fixed sizes.
        if kind == 0x60:
            size, at = data[at], at + 1
            if size == 0:  # ends with a 0
                size = data.index(0, at) - at
                raw, at = data[at : at + size], at + size + 1
                found.append((group, index, raw))
                continue
        else:
            size = struct.calcsize(_PROPAR_FORMATS[kind])
        raw, at = data[at : at + size], at + size
        if len(raw) != size:
            raise ValueError("a value is cut off")
        found.append((group, index, raw))
    if chained or not found or not last_group:
        raise ValueError("a parameter is missing")
    return found


class ProparParameters:
    """Parameters of one instrument on its own line; node 128 is whichever is at the end of the
    cable.
    """

    def __init__(
        self, port: serial_port.SerialPort, node: int = 128, timeout_s: float = 0.2
    ) -> None:
        self._port = port
        self._node = node
        self._timeout_s = timeout_s
        self._exchange = exchange.SerialExchange(port, gap_s=0.0, quiet_s=_QUIET_S)
        self._sequence = 0

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self._port.name} node {self._node}"

    async def connect(self) -> None:
        """Open the port, unless that is done. Raises LinkDownError."""
        if not self._port.is_open:
            self._exchange.connect()

    async def number(self, parameter: InstrumentParameter) -> float:
        """A number that arrived `_COPIES` times the same. Raises LinkError."""
        copies = await self._request_values(*[parameter] * _COPIES)
        if len(set(copies)) > 1:
            shown = ", ".join(copy.hex() for copy in copies)
            raise LinkError(
                f"{self.name}: {parameter.name} differs between copies ({shown}); noise"
            )
        (value,) = struct.unpack(_FORMATS[parameter.kind], copies[0])
        return float(value)

    async def text(self, parameter: InstrumentParameter) -> str:
        """A text that arrived twice the same. Raises LinkError."""
        first = (await self._request_values(parameter))[0]
        second = (await self._request_values(parameter))[0]
        if first != second:
            raise LinkError(
                f"{self.name}: {parameter.name} read as {first!r}, then as {second!r}; noise"
            )
        return first.split(b"\0")[0].decode("ascii", "replace").strip()

    async def write(self, parameter: InstrumentParameter, value: int) -> None:
        """Write, and read back, because ProPar has no checksum. Raises LinkError.

        Parameters
        ----------
        parameter : InstrumentParameter
            One of kind `u8` or `u16`.
        value : int
            In the instrument's counts: for a setpoint, 32000 is 100 % of the capacity.
        """
        answer = await self._transact(write_data(parameter, value), f"writing {parameter.name}")
        if answer[0] != STATUS:
            raise LinkError(
                f"{self.name}: writing {parameter.name}: command {answer[0]} instead of a status"
            )
        found = await self.number(parameter)
        if found != value:
            raise LinkError(f"{self.name}: {parameter.name} written {value}, read back {found:g}")

    async def close(self) -> None:
        """Close the port. Never raises."""
        await self._exchange.close()

    def describe(self) -> dict[str, str]:
        """Port, settings, manual."""
        return {"port": f"{self.name}, {self._port.settings}", "manual": MANUAL}

    async def _request_values(self, *parameters: InstrumentParameter) -> list[bytes]:
        """Raw values of several parameters, from one message."""
        what = f"reading {parameters[0].name}"
        answer = await self._transact(make_request(parameters), what)
        try:
            found = parse_values(answer)
        except (ValueError, IndexError) as error:
            raise LinkError(f"{self.name}: {what}: the answer is malformed ({error})") from error
        if answer[0] != VALUES or [(group, index) for group, index, _ in found] != [
            (place, place) for place in range(len(parameters))
        ]:
            raise LinkError(f"{self.name}: {what}: the answer is to another question")
        for parameter, (_, _, raw) in zip(parameters, found, strict=True):
            if parameter.kind in _FORMATS and len(raw) != struct.calcsize(_FORMATS[parameter.kind]):
                raise LinkError(f"{self.name}: {what}: a value has another type")
        return [raw for _, _, raw in found]

    async def _transact(self, data: bytes, what: str) -> bytes:
        """Data of the answer with the question's sequence number; a status other than 0 raises."""
        what = f"{self.name}: {what}"
        # The fence is a harmless request with a sequence number of its own: its answer shows that
        # no answer to an earlier question is still to come.
        question = self._make_question(data, what)
        fence = self._make_question(
            make_request([MEASURE]), f"{self.name}: asking again after a loss"
        )
        answer = await self._exchange.ask(question, self._timeout_s, fence)
        message = split_binary(answer)[0][-1]
        if message.data[0] != STATUS:
            return message.data
        # A status instead of data.
        code = message.data[1] if len(message.data) > 1 else 255
        if code == 0:
            return message.data
        kind = DeviceRefusedError if code in _REFUSALS else LinkError
        raise kind(f"{what}: status {code} ({STATUS_TEXT.get(code, 'unknown')})")

    def _make_question(self, data: bytes, what: str) -> exchange.WireQuestion:
        self._sequence = (self._sequence + 1) % _SEQUENCES
        frame = binary_frame(ProparMessage(self._sequence, self._node, data))
        return exchange.WireQuestion(
            frame, _make_frame_filter(self._sequence, self._node), 2 * _ANSWER_BYTES, what
        )


def _make_frame_filter(sequence: int, node: int) -> Callable[[bytes], bytes | None]:
    """Finds the answer with this sequence number; discards others, which are late."""

    def extract_frame(received: bytes) -> bytes | None:
        for message in split_binary(received)[0]:
            if (message.sequence, message.node) == (sequence, node):
                return binary_frame(message)
        return None

    return extract_frame
