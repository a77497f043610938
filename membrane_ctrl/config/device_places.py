"""Which register, channel, coil or line each role of a configuration uses, so that no two roles use
the same one.

A pump and a gauge on one register would feed the pump's command back as a pressure; a pump and a
vent on one would open together. Devices may be shared, places in them may not.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from firmware_iface import settings

_WORDS = {"u32": 2, "i32": 2, "f32": 2}  # registers of a type; the others have one
_MODBUS_PORT = 502
_THIS_MACHINE = frozenset({"localhost", "127.0.0.1", "::1", "0.0.0.0", "::"})
# Registers that the driver of a Bronkhorst instrument uses (bronkhorst.register_of): measure 0x20,
# setpoint 0x21, control mode 0x24, and fmeasure in eight registers from 0x8000 + 256 * 33
_BRONKHORST_REGISTERS = (0x20, 0x21, 0x24, *range(0xA100, 0xA108))


@dataclass(frozen=True, slots=True)
class DevicePlace:
    """One place that a role uses.

    `key` is the configuration key that names it, `where` compares equal for one and the same place,
    and `words` describe it for people.
    """

    key: str
    where: Hashable
    words: str


def find_shared(
    roles: Mapping[str, object],
    interlocks: Sequence[settings.InterlockDriver],
    name_link: Callable[[str], Hashable] | None = None,
) -> str:
    """Find two roles that use the same register, channel, coil or line.

    Parameters
    ----------
    roles : mapping of object
        Settings of each role's device, by role.
    interlocks : sequence of InterlockDriver
        Settings of the interlocks.
    name_link : callable or None
        Returns one and the same value for links that lead to one device, however spelt; without it
        only the text of a link is compared.

    Returns
    -------
    str
        One line for a person; empty if there are none.
    """
    seen: dict[Hashable, DevicePlace] = {}
    for place in list_places(roles, interlocks, name_link or normalise_link):
        other = seen.setdefault(place.where, place)
        if other.key != place.key:
            return (
                f"{other.key} and {place.key} name the same {place.words}; give each a place of "
                "its own"
            )
    return ""


def list_places(
    roles: Mapping[str, object],
    interlocks: Sequence[settings.InterlockDriver],
    name_link: Callable[[str], Hashable],
) -> Iterator[DevicePlace]:
    """Yield every place that the roles and interlocks use, in the order of the configuration.

    A place is a register, an instrument, a line or an input that only one role may use.

    Parameters
    ----------
    roles : mapping
        By role, the table of its device (`DevicesConfig.roles`).
    interlocks : sequence of InterlockDriver
        Tables of the interlocks.
    name_link : callable
        Gives all spellings of a link one value: `normalise_link` by the text alone, or one that
        looks up hosts and ports.
    """
    for role, section in roles.items():
        key = f"devices.{role}"
        match section:
            case settings.ModbusMapConfig():
                yield from _list_registers(f"{key}.address", section, name_link)
            case settings.BronkhorstModbusConfig():
                unit = f"unit {section.unit_id} of {section.link}"
                device = (name_link(section.link), section.unit_id)
                yield DevicePlace(f"{key}.unit_id", (device, "instrument"), f"instrument, {unit}")
                for address in _BRONKHORST_REGISTERS:
                    yield DevicePlace(
                        f"{key}.unit_id",
                        (device, "holding", address),
                        f"register {address} of {unit}",
                    )
    for index, interlock in enumerate(interlocks):
        yield find_circuit_place(f"devices.interlocks.{index}", interlock, name_link)


def _list_registers(
    key: str, section: settings.ModbusMapConfig, name_link: Callable[[str], Hashable]
) -> Iterator[DevicePlace]:
    """Yield each register of a value."""
    defaults = _load_preset(section.preset)
    function = section.function or defaults.get("function", "holding")
    kind = section.type or defaults.get("type", "u16")
    for address in range(section.address, section.address + _WORDS.get(kind, 1)):
        where = ((name_link(section.link), section.unit_id), function, address)
        yield DevicePlace(
            key, where, f"{function} register {address} of unit {section.unit_id} of {section.link}"
        )


def _load_preset(name: str) -> dict[str, Any]:
    """Defaults of a preset; none for an unknown one, which is refused when the devices are made."""
    if not name:
        return {}
    # imports the links, which most readers of a configuration need not
    from firmware_iface.drivers import (
        modbus_map,
    )

    try:
        return modbus_map.load_preset(name)
    except ValueError:
        return {}


def find_circuit_place(
    key: str, interlock: settings.InterlockDriver, name_link: Callable[[str], Hashable]
) -> DevicePlace:
    """The place of an interlock's circuit.

    Parameters
    ----------
    key : str
        Of the interlock's table, such as `devices.interlocks.0`.
    interlock : InterlockDriver
        The table: an input of the board, a GPIO line, or a bit of a Modbus module.
    name_link : callable
        As for `list_places`.
    """
    match interlock:
        case settings.BoardInputConfig():
            words = f"input {interlock.input} of the pump board"
            return DevicePlace(f"{key}.input", ("board input", interlock.input), words)
        case settings.GpioLineConfig():
            words = f"line {interlock.line} of {interlock.chip}"
            return DevicePlace(
                f"{key}.line", ("line", name_link(interlock.chip), interlock.line), words
            )
        case _:
            where = (
                (name_link(interlock.link), interlock.unit_id),
                interlock.function,
                interlock.address,
            )
            bit = "coil" if interlock.function == "coil" else "discrete input"
            words = f"{bit} {interlock.address} of unit {interlock.unit_id} of {interlock.link}"
            return DevicePlace(f"{key}.address", where, words)


def normalise_link(link: str) -> Hashable:
    """A link by its text: host and port, or the serial port without its settings; of a file its
    path.
    """
    if not link.startswith("tcp:"):
        return link.removeprefix("rtu://").partition("?")[0]
    try:
        parts = urlsplit(link)
        host = (parts.hostname or "").rstrip(".")
        port = parts.port or _MODBUS_PORT
    except ValueError:  # impossible: opening it reports that
        return link
    return ("localhost" if host in _THIS_MACHINE else host), port
