"""One program a device on this machine, whichever folder or user it runs in.

A lock is a name in the kernel's table of abstract sockets (unix(7)): no file that a link could redirect, a sandbox
hide, another user own or a killed process leave behind. Who holds it is what the kernel says of the listener.
"""

import contextlib
import hashlib
import ipaddress
import os
import socket
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

from firmware_iface import roles, settings
from firmware_iface.links import modbus_rtu, serial_port
from membrane_ctrl.config.devices import DevicesConfig
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.terminal import one_line

# of SO_PEERCRED: pid, uid, gid
_CREDENTIALS = struct.Struct("3i")
# Each refused program asks the holder's socket once who it is, and is never answered: the kernel keeps so many
_ASKERS = 4096
_SHOWN = 100  # letters of the holder's command line


@contextlib.contextmanager
def locked(devices: Iterable[str]) -> Iterator[None]:
    """Have these devices (`device_names`, `modbus_names`) for oneself; given back at the end, or with the process.

    Raises DeviceError (one line: which device another program uses, who that is, and what to do).
    """
    with contextlib.ExitStack() as stack:
        for device in sorted(set(devices)):
            held = stack.enter_context(socket.socket(socket.AF_UNIX))
            address = _address(device)
            try:
                held.bind(address)
            except OSError:
                raise DeviceError(
                    f"{device}: in use by {_holder(address)}; stop that first (`membrane-ctrl ctl stop`, or Ctrl-C)"
                ) from None
            held.listen(_ASKERS)
        yield


def device_names(devices: DevicesConfig) -> set[str]:
    """What the board or the instruments are on this machine, whatever the configuration calls them."""
    if devices.board is not None:
        return modbus_names(devices.board, devices.unit_id)
    names: set[str] = set()
    for section in devices.roles().values():
        if isinstance(section, settings.ON_MODBUS):
            names |= modbus_names(section.link, section.unit_id)
        else:
            names.add(_serial_name(section.port))
    return names


def modbus_names(url: str, unit_id: int) -> set[str]:
    """A Modbus device's names: of a serial line the line's, as it has one owner; of a host those of its addresses."""
    if url.startswith("rtu:"):
        return {_serial_name(url.removeprefix("rtu://").partition("?")[0])}
    try:
        host, port = modbus_rtu.parse_tcp_url(url)
    except ValueError:
        return {url}  # no device can be there: whoever opens it says so
    return {f"{address} port {port} unit {unit_id}" for address in _addresses(host)}


def _serial_name(port: str) -> str:
    try:
        return os.path.realpath(serial_port.port_path(port))
    except roles.LinkError:
        return port  # not plugged in, or not to be told from another


def _addresses(host: str) -> set[str]:
    """Where a name leads; all ways to this machine itself are one."""
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)}
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
    """Who listens there, as far as it can be told."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address)
            raw = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        except OSError:
            return "another program"
    pid = int(_CREDENTIALS.unpack(raw)[0])
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").rstrip("\0").split("\0")
    except OSError:  # it has just ended, or the process table is hidden
        return f"process {pid}"
    return f"process {pid} ({one_line(' '.join(words))[:_SHOWN]})"
