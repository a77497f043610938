"""The names of devices in locks, which do not depend on a device's present port or address."""

import contextlib
import os
from pathlib import Path

from firmware_iface import settings
from firmware_iface.links import modbus_rtu
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import device_names

_BY_ID = Path("/dev/serial/by-id")


def list_device_keys(devices: DevicesConfig) -> frozenset[str]:
    """Return the names by which a bench's devices are known to the lock store.

    Besides the present names (`device_names.list_device_names`), by which programs exclude each
    other, these are the configured ones and those of `/dev/serial/by-id`: a USB adapter or an
    address may get another name while a lock is set.

    Parameters
    ----------
    devices : DevicesConfig
        As configured; nothing is opened.

    Returns
    -------
    frozenset of str
    """
    if devices.board is not None:
        return modbus_keys(devices.board, devices.unit_id)
    keys: set[str] = set()
    for section in devices.roles().values():
        if isinstance(section, settings.ON_MODBUS):
            keys |= modbus_keys(section.link, section.unit_id)
        else:
            keys |= _serial_keys(section.port)
    return frozenset(keys | device_names.list_device_names(devices))


def modbus_keys(url: str, unit_id: int) -> frozenset[str]:
    """Return the names of a Modbus device, as `list_device_keys` does.

    Parameters
    ----------
    url : str
        `tcp://HOST:PORT` or `rtu:///dev/PORT?baud=...`.
    unit_id : int
        Its address on the line or behind the host.

    Returns
    -------
    frozenset of str
    """
    names = device_names.modbus_names(url, unit_id)
    if url.startswith("rtu:"):
        return frozenset(names | _serial_keys(url.removeprefix("rtu://").partition("?")[0]))
    with contextlib.suppress(ValueError):
        host, port = modbus_rtu.parse_tcp_url(url)
        names = names | {f"{host.lower()} port {port} unit {unit_id}"}
    return frozenset(names)


def _serial_keys(port: str) -> set[str]:
    """Return a serial port's names: as configured, its present path, and its names by identity."""
    present = os.path.realpath(port)
    keys = {port, present}
    with contextlib.suppress(OSError):
        keys |= {str(link) for link in _BY_ID.iterdir() if os.path.realpath(link) == present}
    return keys
