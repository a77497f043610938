"""Names of the serial ports of this machine that survive a replug."""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from serial.tools import list_ports

from firmware_iface.roles import DeviceRefusedError, LinkDownError

_USB_NAME = re.compile(r"usb:([0-9A-Fa-f]{4}):([0-9A-Fa-f]{4})(?::(.+))?")


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port of this machine: its path, the name that survives a replug, its own
    description.
    """

    path: str
    usb_name: str
    description: str


def list_serial_ports(
    comports: Callable[[], Iterable[Any]] = list_ports.comports,
) -> list[PortInfo]:
    """The serial ports of this machine, by path; `usb_name` is empty
    when the port is not on USB.
    """
    return sorted((_make_port_info(port) for port in comports()), key=lambda port: port.path)


def check_port_name(name: str) -> str:
    """The name itself, when it is a path or `usb:VID:PID[:SERIAL]`. Raises ValueError."""
    if name.startswith("/") or _USB_NAME.fullmatch(name):
        return name
    raise ValueError(
        f"port {name!r}: expected a path (/dev/ttyUSB0) or usb:VID:PID[:SERIAL] "
        "(usb:0403:6001:A50285BI)"
    )


def resolve_port_path(
    name: str, comports: Callable[[], Iterable[Any]] = list_ports.comports
) -> str:
    """Return the present path of the port with a name.

    Parameters
    ----------
    name : str
        A path, or `usb:VID:PID[:SERIAL]`.
    comports : callable
        Lists the ports of the machine.

    Raises
    ------
    LinkDownError
        It is not plugged in.
    DeviceRefusedError
        Several adapters have the name.
    """
    wanted = _USB_NAME.fullmatch(name)
    if wanted is None:
        return name
    # Vendor and product always count, the serial number only if the name states one: many cheap
    # adapters have none.
    vid = int(wanted[1], 16)
    pid = int(wanted[2], 16)
    serial = wanted[3]
    found = [
        port
        for port in comports()
        if (port.vid, port.pid) == (vid, pid) and (serial is None or port.serial_number == serial)
    ]
    if not found:
        raise LinkDownError(f"{name}: no such USB adapter is plugged in")
    if len(found) > 1:
        choice = ", ".join(sorted(_make_port_info(port).usb_name for port in found))
        raise DeviceRefusedError(
            f"{name}: {len(found)} adapters match; name one by its serial number: {choice}"
        )
    return str(found[0].device)


def _make_port_info(port: Any) -> PortInfo:
    usb_name = ""
    if port.vid is not None:
        usb_name = f"usb:{port.vid:04X}:{port.pid:04X}" + (
            f":{port.serial_number}" if port.serial_number else ""
        )
    return PortInfo(str(port.device), usb_name, str(port.description))
