"""Canonical names of this machine's devices, the same for every spelling of a port or address."""

import ipaddress
import os
import socket
from collections.abc import Iterator

from firmware_iface import roles, settings
from firmware_iface.links import modbus_rtu, port_names
from membrane_ctrl.config.schema import DevicesConfig


def list_device_names(devices: DevicesConfig) -> set[str]:
    """Canonical names of the configured devices on this machine, however spelt."""
    names = {serial_name(port) for port in _interlock_ports(devices)}
    if devices.board is not None:
        return names | modbus_names(devices.board, devices.unit_id)
    for section in devices.roles().values():
        if isinstance(section, settings.ON_MODBUS):
            names |= modbus_names(section.link, section.unit_id)
        else:
            names.add(serial_name(section.port))
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
    """A Modbus device's names, by which two programs recognise that they want the same one.

    Parameters
    ----------
    url : str
        `tcp://HOST:PORT` or `rtu:///dev/PORT?baud=...`, however spelt.
    unit_id : int
        Its address on the line or behind the host. A serial line has one owner, whatever the unit.

    Returns
    -------
    set of str
        The real path of a serial port; of a host one name for each of its addresses. Two devices
        are the same if their sets have a name in common.
    """
    if url.startswith("rtu:"):
        return {serial_name(url.removeprefix("rtu://").partition("?")[0])}
    try:
        host, port = modbus_rtu.parse_tcp_url(url)
    except ValueError:
        return {url}  # impossible: opening it reports that
    return {f"{address} port {port} unit {unit_id}" for address in host_addresses(host)}


def serial_name(port: str) -> str:
    try:
        return os.path.realpath(port_names.resolve_port_path(port))
    except roles.LinkError:
        return port  # not plugged in, or ambiguous


def host_addresses(host: str) -> set[str]:
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
    if parsed.is_loopback or parsed.is_unspecified:
        return "localhost"
    return str(parsed)
