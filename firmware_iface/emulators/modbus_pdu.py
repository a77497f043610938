"""Answers the requests of Modbus (PDUs) from a table of registers, whatever the transport.

It does not use the client's library: two independent implementations check each other. Source:
Modbus application protocol 1.1b3.
"""

import struct
from collections.abc import Sequence
from typing import Protocol

READ_HOLDING = 3
WRITE_SINGLE = 6
WRITE_MULTIPLE = 16
READ_WRITE = 23
ILLEGAL_FUNCTION = 1
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3
DEVICE_FAILURE = 4
BUSY = 6
_READ_MAX = 125  # words in one transaction
_WRITE_MAX = 123
_READ_WRITE_MAX = 121


class RegisterRefusal(Exception):  # noqa: N818 - an answer of the protocol, not an error of the program
    """A request the device answers with an exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


class RegisterTable(Protocol):
    """The registers that function codes read and write."""

    def read(self, address: int, count: int) -> list[int]:
        """Words of one instant. Raises RegisterRefusal.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers, 1..125; the caller has checked it.
        """

    def write(self, address: int, words: Sequence[int]) -> None:
        """Write all of them or none. Raises RegisterRefusal.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        words : sequence of int
            1..123 words, unsigned 16 bit; the caller has checked their number.
        """


def answer_request(pdu: bytes, table: RegisterTable) -> bytes:
    """The answer to a request of the functions 3, 6, 16 and 23.

    Parameters
    ----------
    pdu : bytes
        Function code and data, without unit, header or CRC; at least one byte.
    table : RegisterTable
        What is read and written.

    Returns
    -------
    bytes
        The PDU of the answer: function code and data, or an exception.
    """
    try:
        return pdu[:1] + _answer_function(pdu[0], pdu[1:], table)
    except RegisterRefusal as refusal:
        return exception_pdu(pdu, refusal.code)
    except struct.error:  # the request is shorter than its function code needs
        return exception_pdu(pdu, ILLEGAL_VALUE)


def exception_pdu(pdu: bytes, code: int) -> bytes:
    """The exception answer to a request.

    Parameters
    ----------
    pdu : bytes
        The request; only its function code is used.
    code : int
        One of this module's, such as `ILLEGAL_ADDRESS`.
    """
    return bytes([pdu[0] | 0x80, code])


def _answer_function(function_code: int, data: bytes, table: RegisterTable) -> bytes:
    if function_code == READ_HOLDING:
        address, count = struct.unpack(">HH", data)
        return _read_words(table, address, count)
    if function_code == WRITE_SINGLE:
        address, word = struct.unpack(">HH", data)
        table.write(address, [word])
        return data
    if function_code == WRITE_MULTIPLE:
        address, words = _decode_written_words(data, _WRITE_MAX)
        table.write(address, words)
        return data[:4]
    if function_code == READ_WRITE:
        read_address, read_count = struct.unpack_from(">HH", data)
        address, words = _decode_written_words(data[4:], _READ_WRITE_MAX)
        # refused as a whole: a wrong read writes nothing
        _read_words(table, read_address, read_count)
        table.write(address, words)
        return _read_words(table, read_address, read_count)
    raise RegisterRefusal(ILLEGAL_FUNCTION)


def _read_words(table: RegisterTable, address: int, count: int) -> bytes:
    if not 1 <= count <= _READ_MAX:
        raise RegisterRefusal(ILLEGAL_VALUE)
    return struct.pack(f">B{count}H", 2 * count, *table.read(address, count))


def _decode_written_words(data: bytes, most: int) -> tuple[int, list[int]]:
    address, count, size = struct.unpack_from(">HHB", data)
    if not 1 <= count <= most or size != 2 * count or len(data) != 5 + size:
        raise RegisterRefusal(ILLEGAL_VALUE)
    return address, list(struct.unpack_from(f">{count}H", data, 5))
