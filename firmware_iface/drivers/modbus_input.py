"""Interlock circuits at the discrete inputs or coils of a Modbus device.

A closed circuit reads 1. There is no setting that inverts it: a broken wire and a module without
its supply read 0, which must mean "open".
"""

from collections.abc import Sequence
from typing import Literal

from firmware_iface.links.modbus_link import ModbusBitLink
from firmware_iface.roles import DeviceIdentity

BitFunction = Literal["discrete", "coil"]


class ModbusInputs:
    """Some bits of one Modbus device, an interlock's circuit each.

    Parameters
    ----------
    link : ModbusBitLink
        The device.
    bits : sequence of (function, address)
        "discrete" or "coil", and the address counted from 0, of each circuit.
    """

    def __init__(self, link: ModbusBitLink, bits: Sequence[tuple[BitFunction, int]]) -> None:
        self._link = link
        self._bits = tuple(bits)

    async def open(self) -> DeviceIdentity:
        """Connect, and read every circuit once. Raises LinkError."""
        if not self._link.connected:
            await self._link.connect()
        await self.closed_circuits()
        return DeviceIdentity("Modbus inputs", "", "")

    async def closed_circuits(self) -> tuple[bool, ...]:
        """Whether each circuit is closed. Raises LinkError.

        Each bit is a request of its own: a range with addresses that the device does not have would
        be refused.
        """
        closed = [await self._read_input(function, address) for function, address in self._bits]
        return tuple(closed)

    async def _read_input(self, function: BitFunction, address: int) -> bool:
        if function == "coil":
            (bit,) = await self._link.read_coils(address, 1)
        else:
            (bit,) = await self._link.read_discrete(address, 1)
        return bit

    async def close(self) -> None:
        """Disconnect. Never raises."""
        await self._link.close()

    def describe(self) -> dict[str, str]:
        """Location of the circuits."""
        bits = ", ".join(f"{function} {address}" for function, address in self._bits)
        return {"port": self._link.name, "register": bits}
