"""Any Modbus device by a map from the configuration: one register is one role's value."""

import contextlib
import struct
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from firmware_iface.links.modbus_link import ModbusLink
from firmware_iface.roles import (
    Clock,
    DeviceIdentity,
    DeviceRefusedError,
    DisplacementSample,
    LinkError,
)

PRESETS = Path(__file__).parents[1] / "presets"
_FORMATS = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}


@dataclass(frozen=True, slots=True)
class ValueMap:
    """One value in the registers of a device."""

    address: int  # of its first register, counted from 0
    value: tuple[float, float]  # two values in the role's unit ...
    # ... and the register's contents there; linear between and beyond them
    raw: tuple[float, float]
    limits: tuple[float, float]  # values outside are refused, read or written
    function: str = "holding"  # "holding" or "input"
    type: str = "u16"  # "u16", "i16", "u32", "i32" or "f32"
    word_order: str = "big"  # of the two registers of a 32-bit type: "big" word first, or "little"
    # a holding register and its required content, if that identifies the device
    identity: tuple[int, int] | None = None
    version_address: int | None = None  # a holding register with the device's version, for display

    @property
    def words(self) -> int:
        """Number of registers."""
        return struct.calcsize(">" + _FORMATS[self.type]) // 2

    def decode(self, words: list[int]) -> float:
        """Registers to a value; NaN for a float that is not a number."""
        ordered = words if self.word_order == "big" else words[::-1]
        packed = struct.pack(f">{len(ordered)}H", *ordered)
        (raw,) = struct.unpack(">" + _FORMATS[self.type], packed)
        raw_0, raw_1 = self.raw
        value_0, value_1 = self.value
        return float(value_0 + (raw - raw_0) * (value_1 - value_0) / (raw_1 - raw_0))

    def encode(self, value: float) -> list[int]:
        """A value to registers. Raises ValueError outside the limits."""
        if not self.allows(value):
            raise ValueError(f"{value:g} is not within {self.limits[0]:g} .. {self.limits[1]:g}")
        # A straight line through the two stated points.
        raw_0, raw_1 = self.raw
        value_0, value_1 = self.value
        raw = raw_0 + (value - value_0) * (raw_1 - raw_0) / (value_1 - value_0)
        if self.type != "f32":
            raw = round(raw)
        # In the words and the order of the device.
        packed = struct.pack(">" + _FORMATS[self.type], raw)
        words = list(struct.unpack(f">{self.words}H", packed))
        if self.word_order == "big":
            return words
        return words[::-1]

    def allows(self, value: float) -> bool:
        """Whether the value is within the limits; NaN is not."""
        return self.limits[0] <= value <= self.limits[1]


def load_preset(name: str) -> dict[str, Any]:
    """The defaults of a preset. Raises ValueError for an unknown one."""
    path = PRESETS / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(sorted(found.stem for found in PRESETS.glob("*.toml")))
        raise ValueError(f"preset {name!r} is unknown; the presets are {known}")
    return tomllib.loads(path.read_text(encoding="utf-8"))


def make_map(given: dict[str, Any], preset_name: str = "") -> tuple[ValueMap, bool]:
    """Make the map of a device from configured keys over those of a preset.

    Parameters
    ----------
    given : dict of Any
        Keys of the configuration; None for those that are not set.
    preset_name : str
        Empty for none.

    Returns
    -------
    map : ValueMap
    fence : bool
        Whether the device supports function 8.

    Raises
    ------
    ValueError
        An unknown preset, a missing key, an address or a raw value that the device does not have.
    """
    # Keys of the configuration over those of the preset.
    defaults = load_preset(preset_name) if preset_name else {}
    raw_limits = defaults.pop("raw_limits", None)
    address_limits = defaults.pop("address_limits", None)
    fence = bool(defaults.pop("fence", True))
    keys = {**defaults, **{key: value for key, value in given.items() if value is not None}}
    if "raw" not in keys:
        raise ValueError("raw is missing: the register's contents at the two values")
    keys.setdefault("limits", (min(keys["value"]), max(keys["value"])))
    settings: dict[str, Any] = {
        key: tuple(found) if isinstance(found, list) else found for key, found in keys.items()
    }
    made = ValueMap(**settings)
    # What the device of the preset has.
    if address_limits and not address_limits[0] <= made.address <= address_limits[1]:
        raise ValueError(
            f"address = {made.address}: {preset_name} has {address_limits[0]} .. "
            f"{address_limits[1]}"
        )
    _check_raw(made, raw_limits)
    return made, fence


def _check_raw(made: ValueMap, raw_limits: list[float] | None) -> None:
    """Both limits must be numbers that the register can hold (and the preset's device takes)."""
    for value in made.limits:
        try:
            words = made.encode(value)
        except struct.error:
            raise ValueError(
                f"limits: {value:g} does not fit a register of type {made.type}"
            ) from None
        if raw_limits and not raw_limits[0] <= words[0] <= raw_limits[1]:
            raise ValueError(
                f"raw: {words[0]} at {value:g}; the device takes {raw_limits[0]} .. {raw_limits[1]}"
            )


class ModbusValue:
    """One value of a Modbus device, in the role that the configuration gives it.

    Parameters
    ----------
    link : ModbusLink
        To the device, not yet connected.
    value_map : ValueMap
        Register, type and scale of the value, in the role's unit.
    rest : float or None
        An actuator's value after opening and closing, in the role's unit; None for a sensor.
    clock : callable
        Monotonic time of the samples, s.
    """

    def __init__(
        self,
        link: ModbusLink,
        value_map: ValueMap,
        rest: float | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        self._link = link
        self._map = value_map
        self._rest = rest
        self._clock = clock
        self._samples = 0

    async def open(self) -> DeviceIdentity:
        """Connect, check the identity register if there is one, put an actuator to rest.

        Raises DeviceRefusedError (the identity register holds something else, or the device has no
        such registers).
        """
        if not self._link.connected:
            await self._link.connect()
        # Is it the configured device?
        version, detail = "", "not checked: the map names no identity register"
        if self._map.identity is not None:
            address, wanted = self._map.identity
            (found,) = await self._link.read_holding(address, 1)
            if found != wanted:
                raise DeviceRefusedError(
                    f"{self._link.name}: register {address} holds {found}, expected {wanted}"
                )
            detail = f"register {address} = {found}"
        if self._map.version_address is not None:
            (number,) = await self._link.read_holding(self._map.version_address, 1)
            version = f"{number / 100:.2f}"
        # An actuator at rest, and a value that can be read.
        if self._rest is not None:
            await self._write_value(self._rest)
        await self._read_value()
        return DeviceIdentity("Modbus device", "", version, detail, self._map.limits)

    async def close(self) -> None:
        """Put an actuator to rest and disconnect. Never raises."""
        if self._rest is not None:
            with contextlib.suppress(LinkError):  # out of reach
                await self._write_value(self._rest)
        await self._link.close()

    def describe(self) -> dict[str, str]:
        """Location of the value."""
        found = {
            "port": self._link.name,
            "register": f"{self._map.function} {self._map.address}, {self._map.type}",
        }
        if self._rest is None:
            return found
        return {**found, "watchdog": "none known: check what its output does alone"}

    async def _read_value(self) -> float:
        if self._map.function == "input":
            read = self._link.read_input
        else:
            read = self._link.read_holding
        value = self._map.decode(await read(self._map.address, self._map.words))
        if not self._map.allows(value):
            low, high = self._map.limits
            raise LinkError(
                f"{self._link.name}: register {self._map.address} reads {value:g}, not "
                f"{low:g} .. {high:g}"
            )
        return value

    async def _write_value(self, value: float) -> None:
        words = self._map.encode(value)
        if len(words) == 1:
            await self._link.write_register(self._map.address, words[0])
        else:
            await self._link.write_registers(self._map.address, words)

    async def displacement(self) -> DisplacementSample:
        """As `DisplacementSensor`; counter and time are of arrival; a frozen register is not
        detected.
        """
        value_um = await self._read_value()
        self._samples += 1
        return DisplacementSample(value_um, 0, self._samples, self._clock())

    async def gauge_pressure_pa(self) -> float:
        """As `PressureSensor`."""
        return await self._read_value()

    async def ambient_pressure_pa(self) -> float:
        """As `Barometer`."""
        return await self._read_value()

    async def air_temperature_c(self) -> float:
        """As `Thermometer`."""
        return await self._read_value()

    async def film_temperature_c(self) -> float:
        """As `FilmThermometer`."""
        return await self._read_value()

    async def ring_temperature_c(self) -> float:
        """As `RingThermometer`."""
        return await self._read_value()

    async def humidity_percent(self) -> float:
        """As `Hygrometer`."""
        return await self._read_value()

    async def set_pump(self, fraction: float) -> None:
        """As `Pump`."""
        await self._write_value(fraction)

    async def pump_fraction(self) -> float:
        """As `Pump`: what its register holds."""
        return await self._read_value()

    async def set_vent(self, fraction: float) -> None:
        """As `Vent`."""
        await self._write_value(fraction)

    async def vent_fraction(self) -> float:
        """As `Vent`: what its register holds."""
        return await self._read_value()
