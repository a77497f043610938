"""Parameters of a Bronkhorst instrument over Modbus."""

import struct

from firmware_iface.drivers.bronkhorst_parameter import InstrumentParameter
from firmware_iface.links.modbus_link import ModbusLink
from firmware_iface.roles import DeviceRefusedError

MANUAL = "Bronkhorst 9.17.035, section 4.4.6"


def register_of(parameter: InstrumentParameter) -> tuple[int, int]:
    """First register on the wire (from 0) and number of registers of a parameter.

    Source: manual 9.17.035, section 4.4.6: integers have one register at 32 process + number;
    longer parameters have eight registers each from 0x8000 + 256 process + 8 number.
    """
    if parameter.kind in ("u8", "u16"):
        return 32 * parameter.process + parameter.number, 1
    words = 2 if parameter.kind == "f32" else (parameter.chars + 1) // 2
    return 0x8000 + 256 * parameter.process + 8 * parameter.number, words


class ModbusParameters:
    """Parameters of the instrument behind a link. The link's checksum detects flipped bits."""

    def __init__(self, link: ModbusLink) -> None:
        self._link = link

    @property
    def name(self) -> str:
        """For messages."""
        return self._link.name

    async def connect(self) -> None:
        """Connect, unless that is done. Raises LinkDownError."""
        if not self._link.connected:
            await self._link.connect()

    async def number(self, parameter: InstrumentParameter) -> float:
        """A number. Raises LinkError."""
        words = await self._words(parameter)
        if parameter.kind == "f32":
            return float(struct.unpack(">f", struct.pack(">2H", *words))[0])
        return float(words[0])

    async def text(self, parameter: InstrumentParameter) -> str:
        """A text. Raises LinkError."""
        words = await self._words(parameter)
        raw = struct.pack(f">{len(words)}H", *words)[: parameter.chars]
        return raw.split(b"\0")[0].decode("ascii", "replace").strip()

    async def _words(self, parameter: InstrumentParameter) -> list[int]:
        address, count = register_of(parameter)
        try:
            return await self._link.read_holding(address, count)
        except DeviceRefusedError as error:
            raise DeviceRefusedError(
                f"{error}; not a Bronkhorst, or one without {parameter.name}"
            ) from error

    async def write(self, parameter: InstrumentParameter, value: int) -> None:
        """Write one register; the echo carries address and value back. Raises LinkError.

        Parameters
        ----------
        parameter : InstrumentParameter
            One of kind `u8` or `u16`: others have several registers.
        value : int
            In the instrument's counts: for a setpoint, 32000 is 100 % of the capacity.
        """
        await self._link.write_register(register_of(parameter)[0], value)

    async def close(self) -> None:
        """Disconnect. Never raises."""
        await self._link.close()

    def describe(self) -> dict[str, str]:
        """Port and manual."""
        return {"port": self._link.name, "manual": MANUAL}
