"""Modbus devices as RTU slaves on an emulated serial line, one or several on the same bus."""

import asyncio
import struct
from collections.abc import Callable, Mapping

from firmware_iface.emulators.serial_device import SerialDevice
from firmware_iface.links.serial_port import SerialSettings

_SHORTEST = 4  # unit, function, CRC
_LONGEST = 256  # of a frame; bytes without a silence between them never end otherwise
# far above the 1.75 ms of the standard: a program's bytes may be held up between two reads
_SILENCE_S = 0.005
DIAGNOSTICS = 8

PduHandler = Callable[[bytes], bytes]
"""Request PDU to answer PDU; empty for no answer."""


class RtuBusEmulator(SerialDevice):
    """All slaves of one bus.

    Parameters
    ----------
    settings : SerialSettings
        Of the line.
    slaves : mapping of int to callable
        By unit id: makes the PDU of the answer from that of the request; empty for no answer.
    echo_test : bool
        Whether function 8 ("return query data") is answered; else it goes to the slave, which
        refuses it.
    """

    def __init__(
        self, settings: SerialSettings, slaves: Mapping[int, PduHandler], echo_test: bool = True
    ) -> None:
        super().__init__(settings)
        self._slaves = slaves
        self._echo_test = echo_test
        self._buffer = b""
        self._received_s = 0.0

    def received(self, data: bytes) -> None:
        """Answer a frame as soon as its CRC is right; after a silence the next one begins."""
        now_s = asyncio.get_running_loop().time()
        if now_s - self._received_s > _SILENCE_S:
            self._buffer = data
        else:
            self._buffer = self._buffer + data
        self._received_s = now_s
        # A frame carries no length: it is complete as soon as its last two bytes are the CRC of the
        # rest. A half one that happens to pass is one in 65536.
        frame = self._buffer = self._buffer[-_LONGEST:]
        if len(frame) < _SHORTEST:
            return
        (received_crc,) = struct.unpack("<H", frame[-2:])
        if received_crc != compute_bitwise_crc(frame[:-2]):
            return
        self._buffer = b""
        unit, pdu = frame[0], frame[1:-2]
        if unit in self._slaves and (body := self.answer(unit, pdu)):
            self.send_answer(body + struct.pack("<H", compute_bitwise_crc(body)))

    def answer(self, unit: int, pdu: bytes) -> bytes:
        """Unit id and PDU of the answer, without CRC; empty for no answer.

        Parameters
        ----------
        unit : int
            Of the slave; one of this bus.
        pdu : bytes
            Function code and data of the request.
        """
        echoed = self._echo_test and pdu[0] == DIAGNOSTICS and pdu[1:3] == b"\0\0"
        reply = pdu if echoed else self._slaves[unit](pdu)
        return bytes([unit]) + reply if reply else b""


def compute_bitwise_crc(data: bytes) -> int:
    """The CRC of Modbus, bit by bit as in the standard's figure:
    independent of the link's table.
    """
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            carry = crc & 1
            crc >>= 1
            if carry:
                crc ^= 0xA001
    return crc
