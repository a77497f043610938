"""What the drivers need of a Modbus device over any wire, and the protocol's codes."""

from collections.abc import Sequence
from typing import Protocol

from firmware_iface.roles import (
    DeviceBusyError,
    DeviceRefusedError,
    LinkError,
)

# Modbus semantics, independent of the transport.

READ_COILS = 1
READ_DISCRETE = 2
READ_HOLDING = 3
READ_INPUT = 4
WRITE_SINGLE = 6
DIAGNOSTICS = 8
WRITE_MULTIPLE = 16
EXCEPTION_FLAG = 0x80
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal value",
    4: "device failure",
    5: "acknowledged, not done",
    6: "device busy",
    10: "gateway path unavailable",
    11: "no device behind the gateway",
}
# what to do; the other codes are explained by the device's manual
_REMEDIES = {
    1: "is this the device that the configuration names?",
    2: "is this the device that the configuration names, and its register map?",
    4: "the device has failed: see its manual",
    10: "the gateway is overloaded or its serial port is off: check the gateway's settings",
    11: "the gateway answers, but nothing on its serial line: check unit_id, and the device's "
    "power, wiring, baud rate and parity",
}
SHORT_REPLY = (
    "the device or a gateway cuts its answers: check the gateway's buffer, and that this is the "
    "device that the configuration names"
)
_REFUSALS = (1, 2, 3)  # the request itself is wrong for this device; the others may be temporary
_BUSY = 6


class ModbusLink(Protocol):
    """One Modbus device over any wire: what the drivers need. All raise LinkError kinds.

    Addresses are those on the wire, from 0; manuals often number registers from 1, or from 40001.
    """

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""

    async def connect(self) -> None:
        """Connect again."""

    async def read_holding(self, address: int, count: int) -> list[int]:
        """Read holding registers (function code 3).

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers, 1..125.

        Returns
        -------
        list of int
            `count` words, unsigned 16 bit.
        """

    async def read_input(self, address: int, count: int) -> list[int]:
        """Read input registers (function code 4).

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers, 1..125.

        Returns
        -------
        list of int
            `count` words, unsigned 16 bit.
        """

    async def write_register(self, address: int, word: int) -> None:
        """Write one holding register (function code 6); the echo is checked.

        Parameters
        ----------
        address : int
            The register on the wire, from 0.
        word : int
            Unsigned 16 bit.
        """

    async def write_registers(self, address: int, words: Sequence[int]) -> None:
        """Write holding registers in one request (function code 16); the echo is checked.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        words : sequence of int
            1..123 words, unsigned 16 bit.
        """

    async def close(self) -> None:
        """Close; a request in flight fails at once."""


class ModbusBitLink(Protocol):
    """One Modbus device with coils or discrete inputs. All raise LinkError kinds."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def connected(self) -> bool:
        """Whether the connection is up."""

    async def connect(self) -> None:
        """Connect again."""

    async def read_coils(self, address: int, count: int) -> list[bool]:
        """Read coils, the bits that can also be written (function code 1).

        Parameters
        ----------
        address : int
            First coil on the wire, from 0.
        count : int
            Coils, 1..2000.
        """

    async def read_discrete(self, address: int, count: int) -> list[bool]:
        """Read discrete inputs (function code 2).

        Parameters
        ----------
        address : int
            First input on the wire, from 0.
        count : int
            Inputs, 1..2000.
        """

    async def close(self) -> None:
        """Close; a request in flight fails at once."""


class AnyModbusLink(ModbusLink, ModbusBitLink, Protocol):
    """One Modbus device with registers, coils and discrete inputs."""


def bytes_of_bits(count: int) -> int:
    """Number of bytes in which so many coils or discrete inputs are sent."""
    return (count + 7) // 8


def exception_error(what: str, code: int) -> LinkError:
    """Return the error for an exception answer: refused, busy or another.

    Parameters
    ----------
    what : str
        The exchange, for the message.
    code : int
        Of the exception.
    """
    kind: type[LinkError] = LinkError
    if code in _REFUSALS:
        kind = DeviceRefusedError
    elif code == _BUSY:
        kind = DeviceBusyError
    remedy = f"; {_REMEDIES[code]}" if code in _REMEDIES else ""
    return kind(f"{what}: exception {code} ({EXCEPTIONS.get(code, 'unknown')}){remedy}")
