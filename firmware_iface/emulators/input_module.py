"""A Modbus module with discrete inputs and coils, such as one to which interlock circuits are
wired.

Source: Modbus application protocol 1.1b3, sections 6.1 (read coils) and 6.2 (read discrete inputs).
"""

import struct
from collections.abc import Callable, Mapping

from firmware_iface.emulators import modbus_pdu

READ_COILS, READ_DISCRETE = 1, 2
_BITS_MAX = 2000  # in one transaction

Bits = Mapping[int, Callable[[], bool]]


class InputModule:
    """Bits by address, each from a function of its present state.

    Parameters
    ----------
    discrete, coils : mapping of int to callable
        By address on the wire, from 0: whether the bit is 1 now. An address that is missing is
        answered with exception 2.

    Attributes
    ----------
    powered : bool
        False: every bit reads 0, as with a supply of the circuits that has failed.
    broken : bool
        True: requests are answered with exception 4, "device failure".
    """

    def __init__(self, discrete: Bits, coils: Bits) -> None:
        self._tables: dict[int, Bits] = {READ_DISCRETE: discrete, READ_COILS: coils}
        self.powered = True
        self.broken = False

    def respond(self, pdu: bytes) -> bytes | None:
        """The answer to a request for bits; None for any other function."""
        table = self._tables.get(pdu[0])
        if table is None:
            return None
        if self.broken:
            return modbus_pdu.exception_pdu(pdu, modbus_pdu.DEVICE_FAILURE)
        if len(pdu) != 5:
            return modbus_pdu.exception_pdu(pdu, modbus_pdu.ILLEGAL_VALUE)
        address, count = struct.unpack(">HH", pdu[1:])
        if not 1 <= count <= _BITS_MAX:
            return modbus_pdu.exception_pdu(pdu, modbus_pdu.ILLEGAL_VALUE)
        places = range(address, address + count)
        if not all(place in table for place in places):
            return modbus_pdu.exception_pdu(pdu, modbus_pdu.ILLEGAL_ADDRESS)
        # Bits in the order of their addresses, the first in the lowest bit.
        packed = 0
        for position, place in enumerate(places):
            if self.powered and table[place]():
                packed |= 1 << position
        size = (count + 7) // 8
        return bytes([pdu[0], size]) + packed.to_bytes(size, "little")
