"""ProPar messages (Bronkhorst, manual 9.17.027): data of requests and answers, and the two ways to frame them.

Binary: DLE STX sequence node length data DLE ETX, a DLE inside doubled (section 3.6). ASCII: a colon, then
length + 1, node and data as hexadecimal, CR LF (section 3.5). Neither has a checksum.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from firmware_iface.drivers.bronkhorst import Parameter

STATUS, WRITE, VALUES, REQUEST = 0, 1, 2, 4  # commands: status, write with answer, values, request
_DLE, _STX, _ETX = 0x10, 0x02, 0x03
_TYPES = {"u8": 0x00, "u16": 0x20, "f32": 0x40, "text": 0x60}
_FORMATS = {0x00: ">B", 0x20: ">H", 0x40: ">I"}
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


@dataclass(frozen=True, slots=True)
class Message:
    """One message: sequence number (0 in ASCII, which has none), node and data."""

    sequence: int
    node: int
    data: bytes


def binary_frame(message: Message) -> bytes:
    """As sent in binary."""
    body = bytes([message.sequence, message.node, len(message.data)]) + message.data
    return bytes([_DLE, _STX]) + body.replace(b"\x10", b"\x10\x10") + bytes([_DLE, _ETX])


def ascii_frame(message: Message) -> bytes:
    """As sent in ASCII."""
    return b":%02X%02X%s\r\n" % (len(message.data) + 1, message.node, message.data.hex().upper().encode())


def split_binary(heard: bytes) -> tuple[list[Message], bytes]:
    """The whole messages in what was heard, and the bytes left over; broken ones are left out."""
    messages: list[Message] = []
    while (start := heard.find(b"\x10\x02")) >= 0:
        body, at = bytearray(), start + 2
        while at + 1 < len(heard) and (heard[at] != _DLE or heard[at + 1] == _DLE):
            body.append(heard[at])
            at += 2 if heard[at] == _DLE else 1
        if at + 1 >= len(heard):
            return messages, heard[start:]
        if heard[at + 1] == _ETX and len(body) > 3 and body[2] == len(body) - 3:
            messages.append(Message(body[0], body[1], bytes(body[3:])))
        heard = heard[at + 2 if heard[at + 1] == _ETX else at :]
    return messages, heard[-1:] if heard.endswith(b"\x10") else b""


def parse_ascii(line: bytes) -> Message | None:
    """The message in a line, None if it is none."""
    try:
        raw = bytes.fromhex(line.strip().removeprefix(b":").decode("ascii"))
    except ValueError:
        return None
    if not line.startswith(b":") or len(raw) < 3 or raw[0] != len(raw) - 1:
        return None
    return Message(0, raw[1], raw[2:])


def request(parameters: Sequence[Parameter]) -> bytes:
    """Data that asks for parameters of one process or several, each under its place in the list as its index."""
    data = bytearray([REQUEST])
    for place, parameter in enumerate(parameters):
        more = 0x80 if place + 1 < len(parameters) else 0
        kind = _TYPES[parameter.kind]
        # every parameter in a process group of its own: the place is both the group's and the parameter's index
        data += bytes([place | more, place | kind, parameter.process, parameter.number | kind])
        if parameter.kind == "text":
            data.append(parameter.chars)
    return bytes(data)


def write_data(parameter: Parameter, value: int) -> bytes:
    """Data that writes a number and wants an answer."""
    kind = _TYPES[parameter.kind]
    return bytes([WRITE, parameter.process, parameter.number | kind]) + struct.pack(_FORMATS[kind], value)


def values(data: bytes) -> list[tuple[int, int, bytes]]:
    """Index of process, index of parameter and raw value of each parameter in data of an answer or a write.

    Raises ValueError when the data do not add up.
    """
    found: list[tuple[int, int, bytes]] = []
    at, group, chained, last_group = 1, 0, False, False
    while at < len(data):
        if not chained:
            if last_group:
                raise ValueError("bytes after the last process")
            group, last_group = data[at] & 0x7F, not data[at] & 0x80
            at += 1
        index, kind, chained = data[at] & 0x1F, data[at] & 0x60, bool(data[at] & 0x80)
        at += 1
        if kind == 0x60:
            size, at = data[at], at + 1
            if size == 0:  # ends with a 0
                size = data.index(0, at) - at
                raw, at = data[at : at + size], at + size + 1
                found.append((group, index, raw))
                continue
        else:
            size = struct.calcsize(_FORMATS[kind])
        raw, at = data[at : at + size], at + size
        if len(raw) != size:
            raise ValueError("a value is cut off")
        found.append((group, index, raw))
    if chained or not found or not last_group:
        raise ValueError("a parameter is missing")
    return found
