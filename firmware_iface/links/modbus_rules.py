"""What Modbus means, whichever wire it comes over."""

from collections.abc import Sequence
from typing import Protocol

from firmware_iface.roles import DeviceBusyError, DeviceRefusedError, LinkError

READ_HOLDING, READ_INPUT, WRITE_SINGLE, DIAGNOSTICS, WRITE_MULTIPLE = 3, 4, 6, 8, 16
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
_REFUSALS = (1, 2, 3)  # the request itself is wrong for this device; the others may pass
_BUSY = 6


class ModbusLink(Protocol):
    """One Modbus device over any wire: what the drivers need. All raise LinkError kinds."""

    @property
    def name(self) -> str:
        """For messages."""

    @property
    def connected(self) -> bool:
        """Whether the connection stands."""

    @property
    def reconnects(self) -> int:
        """Connections made after the first."""

    @property
    def retry_in_s(self) -> float:
        """Time until `connect` will try."""

    async def connect(self) -> None:
        """Connect anew."""

    async def read_holding(self, address: int, count: int) -> list[int]:
        """Function code 3."""

    async def read_input(self, address: int, count: int) -> list[int]:
        """Function code 4."""

    async def write_register(self, address: int, word: int) -> None:
        """Function code 6; the echo is checked."""

    async def write_registers(self, address: int, words: Sequence[int]) -> None:
        """Function code 16; the echo is checked."""

    async def close(self) -> None:
        """Close; a request in flight fails at once."""


def exception_error(what: str, code: int) -> LinkError:
    """The error for an exception answer."""
    kind = DeviceRefusedError if code in _REFUSALS else DeviceBusyError if code == _BUSY else LinkError
    return kind(f"{what}: exception {code} ({EXCEPTIONS.get(code, 'unknown')})")
