"""Connects the devices of a bench; retries while one is absent or claimed by another program."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from firmware_iface import roles
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.model.errors import DeviceError

# A booting board or a starting network gets this long before the command gives up
_PATIENCE_S = 5.0
_PAUSE_S = 0.25
_LAPSE_S = 1.0  # beyond the longest life of an abandoned claim
T = TypeVar("T")


async def connect_bench(bench: roles.Bench, devices: DevicesConfig) -> roles.BenchIdentity:
    """Open the bench; retry while a device is absent, fail at once if it is the wrong device.

    Parameters
    ----------
    bench : Bench
        As `make_bench` makes it.
    devices : DevicesConfig
        For the messages.

    Raises
    ------
    DeviceError
        Naming the device and the problem in one line.
    """
    # a bench of roles names the role itself
    return await retry_connecting(bench.open, devices.board or "devices")


async def retry_connecting(attempt: Callable[[], Awaitable[T]], where: str) -> T:
    """Repeat an attempt to connect, as in `connect_bench`.

    Parameters
    ----------
    attempt : async callable
        Connects, or raises LinkError. It is tried for 5 s; while another program has claimed the
        device, until that claim would have lapsed; not again if it is the wrong device.
    where : str
        The device, for the message.

    Raises
    ------
    DeviceError
        With the last failure that names a cause.
    """
    loop = asyncio.get_running_loop()
    begin_s, patience_s = loop.time(), _PATIENCE_S
    failure = ""
    while True:
        try:
            return await attempt()
        except roles.LinkError as error:
            if not (isinstance(error, roles.LinkWaitsError) and failure):
                failure = str(error).removeprefix(f"{where}: ")
            # a killed program's claim lapses with its watchdog
            if isinstance(error, roles.DeviceBusyError):
                patience_s = max(patience_s, error.lapses_in_s + _LAPSE_S)
            if isinstance(error, roles.DeviceRefusedError) or loop.time() > begin_s + patience_s:
                raise DeviceError(f"{where}: {failure}") from None
        await asyncio.sleep(_PAUSE_S)
