"""Any Modbus device as an RTU slave on an emulated serial line, alone or with others on the same bus."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Mapping

from firmware_iface.emulators.modbus_server import exception_pdu
from firmware_iface.emulators.serial_device import SerialDevice
from firmware_iface.links.serial_port import SerialSettings

_SHORTEST = 4  # unit, function, CRC
_SILENCE_S = 0.005  # far above the 1.75 ms of the standard: a program's bytes may be held up between two reads
DIAGNOSTICS = 8

PduHandler = Callable[[bytes], bytes]
"""Request PDU to answer PDU; empty for no answer."""


class RtuBusEmulator(SerialDevice):
    """All slaves of one bus.

    Parameters
    ----------
    settings : SerialSettings
        Of the line.
    slaves : mapping
        Unit id to what answers it (for example `lambda pdu: respond(pdu, table)`); other units stay silent.
    echo_test : bool
        Whether function 8 ("return query data") is known; otherwise it is refused.
    seed : int
        For faults.

    Attributes
    ----------
    wrong_unit, wrong_function : bool
        Faults of the protocol: answers carry the next unit id, or the next function code.
    exception_code : int
        Every request is answered with this exception and not carried out; 0: off.
    """

    def __init__(
        self, settings: SerialSettings, slaves: Mapping[int, PduHandler], echo_test: bool = True, seed: int = 0
    ) -> None:
        super().__init__(settings, seed)
        self.wrong_unit = False
        self.wrong_function = False
        self.exception_code = 0
        self._slaves = slaves
        self._echo_test = echo_test
        self._heard = b""
        self._heard_s = 0.0

    def received(self, data: bytes) -> None:
        """Answer a frame as soon as its CRC is right; after a silence the next one begins."""
        now_s = asyncio.get_running_loop().time()
        self._heard = data if now_s - self._heard_s > _SILENCE_S else self._heard + data
        self._heard_s = now_s
        frame = self._heard
        if len(frame) < _SHORTEST or struct.unpack("<H", frame[-2:])[0] != bitwise_crc(frame[:-2]):
            return
        self._heard = b""
        unit, pdu = frame[0], frame[1:-2]
        if unit not in self._slaves:
            return
        if self.exception_code:
            reply = exception_pdu(pdu, self.exception_code)
        elif self._echo_test and pdu[0] == DIAGNOSTICS and pdu[1:3] == b"\0\0":
            reply = pdu
        else:
            reply = self._slaves[unit](pdu)
        if not reply:
            return
        reply = bytes([reply[0] + self.wrong_function]) + reply[1:]
        body = bytes([unit + self.wrong_unit]) + reply
        self.say(body + struct.pack("<H", bitwise_crc(body)))


def bitwise_crc(data: bytes) -> int:
    """The CRC of Modbus, bit by bit as in the standard's figure: independent of the link's table."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            carry = crc & 1
            crc >>= 1
            if carry:
                crc ^= 0xA001
    return crc
