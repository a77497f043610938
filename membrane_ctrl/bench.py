"""From the configuration's words to a bench of devices."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.role_bench import RoleBench
from firmware_iface.roles import Bench, BenchIdentity, DeviceBusyError, DeviceRefusedError, LinkError, LinkWaitsError
from membrane_ctrl.config import DevicesConfig
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.role_devices import role_devices

# A board that boots or a network that comes up is given this long before the command gives up
_PATIENCE_S = 5.0
_PAUSE_S = 0.25
_LAPSE_S = 1.0  # after the last moment at which a claim that nobody feeds has lapsed

T = TypeVar("T")


def open_bench(devices: DevicesConfig) -> Bench:
    """The bench that the configuration names, not yet connected. Raises InputError for what no device can be."""
    if devices.board is None:
        return RoleBench(role_devices(devices), devices.watchdog_s)
    return pump_board(devices, devices.board)


def pump_board(devices: DevicesConfig, url: str) -> PumpBoard:
    """The board at this URL, not yet connected. Raises InputError."""
    try:
        return PumpBoard(url, devices.unit_id, devices.timeout_s, devices.watchdog_s)
    except ValueError as error:
        raise InputError(f"devices.board: {error}") from None


async def connect(bench: Bench, devices: DevicesConfig) -> BenchIdentity:
    """Open the bench, with patience for a device that is not there yet and none for one that is the wrong one.

    Raises
    ------
    DeviceError
        One line that names the device and what is wrong.
    """
    return await patiently(bench.open, devices.board or "devices")  # a composed bench names the role itself


async def patiently(attempt: Callable[[], Awaitable[T]], where: str) -> T:
    """Connect by this attempt, again and again; see `connect`."""
    loop = asyncio.get_running_loop()
    begin_s, patience_s = loop.time(), _PATIENCE_S
    failure = ""
    while True:
        try:
            return await attempt()
        except LinkError as error:
            if not (isinstance(error, LinkWaitsError) and failure):
                failure = str(error).removeprefix(f"{where}: ")
            if isinstance(error, DeviceBusyError):  # the claim of a program that was killed lapses with its watchdog
                patience_s = max(patience_s, error.lapses_in_s + _LAPSE_S)
            if isinstance(error, DeviceRefusedError) or loop.time() > begin_s + patience_s:
                raise DeviceError(f"{where}: {failure}") from None
        await asyncio.sleep(_PAUSE_S)
