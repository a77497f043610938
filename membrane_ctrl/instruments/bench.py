"""Makes the bench of the configured devices; only one program at a time may use a device."""

import asyncio
import contextlib
import hashlib
import ipaddress
import os
import socket
import struct
from collections.abc import Awaitable, Callable, Hashable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from firmware_iface import drivers, interlocks, role_bench, roles, settings
from firmware_iface.drivers import bronkhorst, bronkhorst_propar, modbus_map
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.links import modbus_rtu, serial_port
from membrane_ctrl.config import device_places
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import driver_loading, interlock_sources
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.model.terminal import one_line

# Makes the driver of a role from its `[devices.<role>]` table.


def role_devices(
    devices: DevicesConfig, links: modbus_rtu.ModbusLinks | None = None
) -> role_bench.RoleDevices:
    """The drivers named in the tables, not yet connected; those on one serial bus share it.

    Raises InputError for a port, URL, preset or setting that the driver does not accept.
    """
    links = links or modbus_rtu.ModbusLinks()
    made: dict[str, Any] = {}
    for role, section in devices.roles().items():
        try:
            made[role] = _driver(role, section, links)
        except ValueError as error:
            raise InputError(f"devices.{role}: {error}") from None
    displacement = made.pop("displacement", None)  # a bench held by its optics may have none
    vent = made.pop("vent", None)
    return role_bench.RoleDevices(
        displacement, made.pop("pump"), made.pop("gauge_pressure"), vent, made
    )


def _driver(role: str, section: settings.AnyDriver, links: modbus_rtu.ModbusLinks) -> Any:
    match section:
        case settings.ModbusMapConfig():
            return _modbus_value(role, section, links)
        case settings.BronkhorstModbusConfig():
            link = links.link(section.link, section.unit_id, section.timeout_s)
            return _bronkhorst(role, bronkhorst.ModbusParameters(link), section.serial)
        case settings.BronkhorstProparConfig():
            port = serial_port.SerialPort(section.port, serial_port.SerialSettings(section.baud))
            return _bronkhorst(
                role,
                bronkhorst_propar.ProparParameters(port, section.node, section.timeout_s),
                section.serial,
            )
        case _:
            device = driver_loading.make_driver(section, f"devices.{role}", drivers.SENSORS)
            if not hasattr(device, roles.ROLES[role].reads):
                name = driver_loading.name_of(section)
                raise ValueError(
                    f"the driver {name} has no {roles.ROLES[role].reads}, so it is no {role}"
                )
            return device


def _bronkhorst(
    role: str, port: bronkhorst.ParameterPort, serial: str
) -> bronkhorst.BronkhorstFlow | bronkhorst.BronkhorstPressure:
    return (
        bronkhorst.BronkhorstFlow(port, serial)
        if role == "pump"
        else bronkhorst.BronkhorstPressure(port, serial)
    )


def _modbus_value(
    role: str, section: settings.ModbusMapConfig, links: modbus_rtu.ModbusLinks
) -> modbus_map.ModbusValue:
    value_map, fence = modbus_map.make_map(map_keys(section), section.preset)
    link = links.link(section.link, section.unit_id, section.timeout_s, fence)
    return modbus_map.ModbusValue(link, value_map, rest=0.0 if role in roles.ACTUATORS else None)


def map_keys(section: settings.ModbusMapConfig) -> dict[str, Any]:
    """The keys of a map, in the terms of `drivers.modbus_map`."""
    keys = section.model_dump(
        include={"function", "type", "word_order", "address", "raw", "value", "limits"}
    )
    if section.identity_address is not None and section.identity_equals is not None:
        keys["identity"] = (section.identity_address, section.identity_equals)
    return keys


# A booting board or a starting network gets this long before the command gives up
_PATIENCE_S = 5.0
_PAUSE_S = 0.25
_LAPSE_S = 1.0  # beyond the longest life of an abandoned claim

T = TypeVar("T")


def open_bench(devices: DevicesConfig) -> roles.Bench:
    """The configured bench, not yet connected. Raises InputError for impossible devices."""
    require_places(devices)
    links = modbus_rtu.ModbusLinks()
    made: roles.Bench
    if devices.board is None:
        made = role_bench.RoleBench(role_devices(devices, links), devices.watchdog_s)
    else:
        made = pump_board(devices, devices.board, links)
    if not devices.interlocks:
        return made
    return interlocks.InterlockBench(
        made, board_inputs(devices), interlock_sources.polled_sources(devices, links)
    )


def pump_board(
    devices: DevicesConfig, url: str, links: modbus_rtu.ModbusLinks | None = None
) -> PumpBoard:
    """The board at this URL, not yet connected. Raises InputError."""
    try:
        link = (links or modbus_rtu.ModbusLinks()).link(url, devices.unit_id, devices.timeout_s)
        return PumpBoard(url, devices.unit_id, devices.timeout_s, devices.watchdog_s, link)
    except ValueError as error:
        raise InputError(f"devices.board: {error}") from None


def board_inputs(devices: DevicesConfig) -> dict[int, int]:
    """By interlock, the input of the board that it is wired to."""
    return {
        index: interlock.input
        for index, interlock in enumerate(devices.interlocks)
        if isinstance(interlock, settings.BoardInputConfig)
    }


def require_places(devices: DevicesConfig) -> None:
    """Refuse two roles on one place, also if their links are spelt differently.
    Raises InputError.
    """
    shared = device_places.find_shared(devices.roles(), devices.interlocks, _device_of_link)
    if shared:
        raise InputError(shared)
    ports: dict[str, tuple[str, str]] = {}
    for role, port, link in devices.list_ports():
        other, other_link = ports.setdefault(_serial_name(port), (role, link))
        if other != role and not (link and link == other_link):
            raise InputError(
                f"devices.{other} and devices.{role} name the same port, {port}; only Modbus "
                "devices on one link may "
                "share it"
            )


def _device_of_link(link: str) -> Hashable:
    """One value for all spellings of a link: of a TCP link the host's addresses, else the serial
    port or file.
    """
    plain = device_places.plain_link(link)
    if isinstance(plain, tuple):
        host, port = plain
        return frozenset(_addresses(host)), port
    return _serial_name(str(plain))


async def connect(bench: roles.Bench, devices: DevicesConfig) -> roles.BenchIdentity:
    """Open the bench; retry while a device is absent, fail at once if it is the wrong device.

    Raises DeviceError, naming the device and the problem in one line.
    """
    return await patiently(
        bench.open, devices.board or "devices"
    )  # a bench of roles names the role itself


async def patiently(attempt: Callable[[], Awaitable[T]], where: str) -> T:
    """Repeat an attempt to connect, as in `connect`."""
    loop = asyncio.get_running_loop()
    begin_s, patience_s = loop.time(), _PATIENCE_S
    failure = ""
    while True:
        try:
            return await attempt()
        except roles.LinkError as error:
            if not (isinstance(error, roles.LinkWaitsError) and failure):
                failure = str(error).removeprefix(f"{where}: ")
            if isinstance(
                error, roles.DeviceBusyError
            ):  # a killed program's claim lapses with its watchdog
                patience_s = max(patience_s, error.lapses_in_s + _LAPSE_S)
            if isinstance(error, roles.DeviceRefusedError) or loop.time() > begin_s + patience_s:
                raise DeviceError(f"{where}: {failure}") from None
        await asyncio.sleep(_PAUSE_S)


# One program per device on this machine, whatever its folder or user.
#
# A lock is a name in the kernel's table of abstract sockets (unix(7)): not a file, which a link
# could redirect, a sandbox hide, another user own or a killed process leave behind. The kernel
# identifies the
# listener that holds it.

# of SO_PEERCRED: pid, uid, gid
_CREDENTIALS = struct.Struct("3i")
# Each refused program connects to the holder's socket once to identify it; the kernel queues this
# many
_ASKERS = 4096
_SHOWN = 100  # characters of the holder's command line


@contextlib.contextmanager
def locked(devices: Iterable[str]) -> Iterator[None]:
    """Claim these devices (`device_names`, `modbus_names`) until the end of the block or of the
    process.

    Raises DeviceError, naming the device, the program that uses it and the remedy in one line.
    """
    with contextlib.ExitStack() as stack:
        for device in sorted(set(devices)):
            held = stack.enter_context(socket.socket(socket.AF_UNIX))
            address = _address(device)
            try:
                held.bind(address)
            except OSError:
                raise DeviceError(
                    f"{device}: in use by {_holder(address)}; stop that first "
                    "(`membrane-ctrl ctl stop`, or Ctrl-C)"
                ) from None
            held.listen(_ASKERS)
        yield


def device_names(devices: DevicesConfig) -> set[str]:
    """Canonical names of the configured devices on this machine, however spelt."""
    names = {_serial_name(port) for port in _interlock_ports(devices)}
    if devices.board is not None:
        return names | modbus_names(devices.board, devices.unit_id)
    for section in devices.roles().values():
        if isinstance(section, settings.ON_MODBUS):
            names |= modbus_names(section.link, section.unit_id)
        else:
            names.add(_serial_name(section.port))
    return names


def _interlock_ports(devices: DevicesConfig) -> Iterator[str]:
    """Yield the serial ports of interlocks. An input module in the network may serve several
    benches.
    """
    for interlock in devices.interlocks:
        if isinstance(interlock, settings.ModbusInputConfig) and interlock.link.startswith("rtu:"):
            port, _ = modbus_rtu.parse_rtu_url(interlock.link)
            yield port


def modbus_names(url: str, unit_id: int) -> set[str]:
    """A Modbus device's names: that of its serial line, which has one owner, or those of its host's
    addresses.
    """
    if url.startswith("rtu:"):
        return {_serial_name(url.removeprefix("rtu://").partition("?")[0])}
    try:
        host, port = modbus_rtu.parse_tcp_url(url)
    except ValueError:
        return {url}  # impossible: opening it reports that
    return {f"{address} port {port} unit {unit_id}" for address in _addresses(host)}


def _serial_name(port: str) -> str:
    try:
        return os.path.realpath(serial_port.port_path(port))
    except roles.LinkError:
        return port  # not plugged in, or ambiguous


def _addresses(host: str) -> set[str]:
    """Addresses of a host; all addresses of this machine count as one."""
    try:
        found = {
            str(entry[4][0]) for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        }
    except (OSError, UnicodeError):
        return {host.lower()}
    return {_plain_address(address) for address in found}


def _plain_address(address: str) -> str:
    parsed = ipaddress.ip_address(address.partition("%")[0])
    parsed = getattr(parsed, "ipv4_mapped", None) or parsed
    return "localhost" if parsed.is_loopback or parsed.is_unspecified else str(parsed)


def _address(device: str) -> bytes:
    return b"\0membrane-ctrl/device/" + hashlib.sha256(device.encode()).hexdigest()[:32].encode()


def _holder(address: bytes) -> str:
    """The process that listens there, if known."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address)
            raw = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        except OSError:
            return "another program"
    pid = int(_CREDENTIALS.unpack(raw)[0])
    try:
        words = (
            Path(f"/proc/{pid}/cmdline")
            .read_bytes()
            .decode(errors="replace")
            .rstrip("\0")
            .split("\0")
        )
    except OSError:  # it has just ended, or the process table is hidden
        return f"process {pid}"
    return f"process {pid} ({one_line(' '.join(words))[:_SHOWN]})"
