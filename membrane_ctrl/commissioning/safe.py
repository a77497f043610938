"""`safe`: stops the pump, whichever program runs it, and locks its devices until a person removes
the lock.

For operators in doubt, and for `ExecStopPost`. It works even if the control process is dead or
hangs. It claims no device, arms no watchdog and opens no sensor.
"""

import asyncio
import math
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.roles import BenchReading, LinkError
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments import (
    bench,
    bench_connection,
    device_claim,
    device_names,
    lock_keys,
    lock_store,
    role_drivers,
)
from membrane_ctrl.model.account import account_name
from membrane_ctrl.model.errors import DeviceError, Exit, InputError, os_reason
from membrane_ctrl.model.lock import Lock

_TEXT = "made safe by hand"
_LOOK_S = 0.1
_LAPSE_S = 1.0  # beyond a watchdog period the board will not stop the pump any more


def make_safe(config: Config, source: str, logs_dir: Path | None = None, latch: bool = True) -> int:
    """Stop the pump of a configuration; leave the vent as it is.

    Parameters
    ----------
    config : Config
        With the devices.
    source : str
        Its file, for messages.
    logs_dir : Path or None
        Folder of the runs.
    latch : bool
        The board latches its stop and the devices are locked: nothing runs the pump until a person
        removes the lock. Without it, a program that has the devices keeps running.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        There are no devices.
    DeviceError
        The pump could not be stopped or locked.
    """
    if config.devices is None:
        raise InputError(f"{source}: devices: missing; nothing to make safe")
    if not latch:
        with device_claim.claim_devices(device_names.list_device_names(config.devices)):
            print(asyncio.run(_after_a_run(config.devices)), file=sys.stderr)
        return Exit.DONE
    folder = logs_dir or Path(config.recording.logs_dir)
    # First the gas, at the device itself: this works without any other program. Then the hold, if
    # one runs, which would command the pump again with its next tick.
    stopped = _try_to_stop(config.devices)
    by_hold = _lock_hold(config, folder)
    if not stopped.lasts:  # the hold may have commanded the pump again before it was locked
        stopped = _try_to_stop(config.devices)
    # One of the two is enough: a hold that is locked has stopped its pump.
    if stopped.problem and not by_hold.locked:
        raise DeviceError(f"{stopped.problem}; cut the pump's power if it runs")
    for line in (stopped.words, by_hold.words):
        if line:
            print(line, file=sys.stderr)
    # The lock on the disk keeps later programs from the devices, too.
    if not by_hold.stored:
        _store_lock(config.devices)
    return Exit.DONE


@dataclass(frozen=True, slots=True)
class _Stopped:
    """The result; `lasts` means that the board itself keeps the pump stopped."""

    words: str = ""
    problem: str = ""
    lasts: bool = False


def _try_to_stop(devices: DevicesConfig) -> _Stopped:
    try:
        return asyncio.run(_stop_pump(devices))
    except DeviceError as error:
        return _Stopped(problem=str(error))


async def _stop_pump(devices: DevicesConfig) -> _Stopped:
    """Stop the pump at the device. Raises DeviceError."""
    if devices.board is None:
        return await _stop_instrument(devices)
    board = bench.make_pump_board(devices, devices.board)
    try:
        identity = await bench_connection.retry_connecting(board.identify, devices.board)
        await board.stop()
        reading = await board.read()
    except LinkError as error:
        raise DeviceError(str(error)) from None
    finally:
        await board.close()
    return _Stopped(_describe_reading(devices, reading), lasts=identity.map_version > 1)


async def _stop_instrument(devices: DevicesConfig) -> _Stopped:
    """Stop the pump alone: an unplugged laser must not keep it running."""
    pump = role_drivers.make_role_devices(devices).pump
    try:
        await bench_connection.retry_connecting(pump.open, "pump")
        await pump.set_pump(0.0)
        fraction = await pump.pump_fraction()
    except LinkError as error:
        raise DeviceError(f"pump: {error}") from None
    finally:
        await pump.close()
    return _Stopped(f"{devices.name}: pump {fraction:g}")


def _describe_reading(devices: DevicesConfig, reading: BenchReading) -> str:
    latched = f", faults latched {reading.latched_faults:#x}" if reading.latched_faults else ""
    return (
        f"{devices.name}: pump {reading.pump_fraction:g}, vent {reading.vent_fraction:.2f}{latched}"
    )


async def _after_a_run(devices: DevicesConfig) -> str:
    """Make sure that the pump is off after a hold, without a latch; wait for the board's watchdog
    after a killed hold.

    Raises DeviceError.
    """
    if devices.board is None:
        return (await _stop_instrument(devices)).words
    board = bench.make_pump_board(devices, devices.board)
    try:
        identity = await bench_connection.retry_connecting(board.identify, devices.board)
        if identity.map_version == 1:
            await board.stop()
        return _describe_reading(devices, await _read_stopped_board(board, devices.watchdog_s))
    except LinkError as error:
        raise DeviceError(f"{error}; the board's watchdog stops the pump by itself") from None
    finally:
        await board.close()


async def _read_stopped_board(board: PumpBoard, watchdog_s: float) -> BenchReading:
    """Reading of a stopped pump; a pump still running after the watchdog period is stopped, which
    latches.
    """
    # Wait for the watchdog instead of stopping at once: a stop is a latched fault, which a person
    # would have to clear after every ordinary end of a hold.
    for _ in range(math.ceil((watchdog_s + _LAPSE_S) / _LOOK_S)):
        if (reading := await board.read()).pump_fraction == 0.0:
            return reading
        await asyncio.sleep(_LOOK_S)
    await board.stop()
    return await board.read()


@dataclass(frozen=True, slots=True)
class _LockedByHold:
    """What a running hold has done; `stored` means that its lock is on the disk."""

    words: str = ""
    locked: bool = False
    stored: bool = False


def _lock_hold(config: Config, folder: Path) -> _LockedByHold:
    """Lock a running hold, if one answers."""
    path = config.port.socket_in(folder)
    if not config.port.enabled or not path.exists():
        return _LockedByHold()
    from membrane_ctrl.control_port import client  # only now: the pump is stopped sooner without

    try:
        with client.PortClient.unix(path, notice=lambda _: None) as hold:
            answer = hold.ask(do="latch", text=_TEXT, why="membrane-ctrl safe")
            run = str(hold.greeting.get("run", ""))
    except DeviceError as error:
        print(f"the running hold could not be locked: {error}", file=sys.stderr)
        return _LockedByHold()
    if not answer.get("ok"):
        print(f"the running hold refused the lock: {answer.get('refused', '')}", file=sys.stderr)
        return _LockedByHold()
    lock = answer.get("lock")
    word = str(lock.get("word", "")) if isinstance(lock, dict) else ""
    words = f"run {run}: locked, until `membrane-ctrl ctl unlock {word}`"
    return _LockedByHold(words, locked=True, stored=answer.get("stored") is True)


def _store_lock(devices: DevicesConfig) -> None:
    """Store a lock on the devices, which keeps every command down until a person removes it. Raises
    DeviceError.
    """
    store = lock_store.LockStore.of_machine()
    keys = lock_keys.list_device_keys(devices)
    account = f"unix:{account_name()}"
    word = lock_store.draw_word({each.lock.word for each in store.find_locks()})
    set_utc = datetime.now(UTC).isoformat(timespec="seconds")
    lock = Lock(word, _TEXT, account, account, "membrane-ctrl safe", set_utc)
    try:
        file = store.write_lock(lock, keys)
    except OSError as error:
        raise DeviceError(
            f"{error.filename or 'the locks'}: the pump is stopped, but not locked "
            f"({os_reason(error)})"
        ) from None
    print(
        f"{file}: nothing moves the mirror before `membrane-ctrl locks remove {word}`",
        file=sys.stderr,
    )
