"""`safe`: stops the pump, whichever program runs it, and keeps it stopped until a person clears the latch.

For operators in doubt, and for `ExecStopPost`. It works even if the control process is dead or hangs. It claims no
device, arms no watchdog and opens no sensor.
"""

import asyncio
import getpass
import math
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.roles import BenchReading, LinkError
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.instruments import bench
from membrane_ctrl.model.errors import DeviceError, Exit, InputError, os_reason
from membrane_ctrl.run_files.latched_fault import LatchedFault, LatchedFile

_CAUSE = "made safe by hand"
_REMEDY = "ask the person who made it safe whether the mirror may move"
_LOOK_S = 0.1
_LAPSE_S = 1.0  # beyond a watchdog period the board will not stop the pump any more


def make_safe(config: Config, source: str, logs_dir: Path | None = None, latch: bool = True) -> int:
    """Stop the pump of a configuration from `source`; leave the vent as it is.

    With `latch`, nothing runs the pump until a person clears the latch: at the board, in a running hold and in the
    next one. Without it, a program that has the devices keeps running.

    Raises InputError without devices, DeviceError if the pump could not be stopped or latched.
    """
    if config.devices is None:
        raise InputError(f"{source}: devices: missing; nothing to make safe")
    if not latch:
        with bench.locked(bench.device_names(config.devices)):
            print(asyncio.run(_after_a_run(config.devices)), file=sys.stderr)
        return Exit.DONE
    folder = logs_dir or Path(config.recording.logs_dir)
    stopped = _tried(config.devices)
    told = _hold_told(config, folder)
    if not stopped.lasts:  # the hold may have commanded the pump again before it was latched
        stopped = _tried(config.devices)
    if stopped.problem and not told:
        raise DeviceError(f"{stopped.problem}; cut the pump's power if it runs")
    for line in (stopped.words, told):
        if line:
            print(line, file=sys.stderr)
    _keep(LatchedFile(folder))
    return Exit.DONE


@dataclass(frozen=True, slots=True)
class _Stopped:
    """The result; `lasts` means that the board itself keeps the pump stopped."""

    words: str = ""
    problem: str = ""
    lasts: bool = False


def _tried(devices: DevicesConfig) -> _Stopped:
    try:
        return asyncio.run(_stop(devices))
    except DeviceError as error:
        return _Stopped(problem=str(error))


async def _stop(devices: DevicesConfig) -> _Stopped:
    """Stop the pump at the device. Raises DeviceError."""
    if devices.board is None:
        return await _stop_instrument(devices)
    board = bench.pump_board(devices, devices.board)
    try:
        identity = await bench.patiently(board.identify, devices.board)
        await board.stop()
        reading = await board.read()
    except LinkError as error:
        raise DeviceError(str(error)) from None
    finally:
        await board.close()
    return _Stopped(_words(devices, reading), lasts=identity.map_version > 1)


async def _stop_instrument(devices: DevicesConfig) -> _Stopped:
    """Stop the pump alone: an unplugged laser must not keep it running."""
    pump = bench.role_devices(devices).pump
    try:
        await bench.patiently(pump.open, "pump")
        await pump.set_pump(0.0)
        fraction = await pump.pump_fraction()
    except LinkError as error:
        raise DeviceError(f"pump: {error}") from None
    finally:
        await pump.close()
    return _Stopped(f"{devices.name}: pump {fraction:g}")


def _words(devices: DevicesConfig, reading: BenchReading) -> str:
    latched = f", faults latched {reading.latched_faults:#x}" if reading.latched_faults else ""
    return f"{devices.name}: pump {reading.pump_fraction:g}, vent {reading.vent_fraction:.2f}{latched}"


async def _after_a_run(devices: DevicesConfig) -> str:
    """Make sure that the pump stands after a hold, without a latch; wait for the board's watchdog after a killed
    hold.

    Raises DeviceError.
    """
    if devices.board is None:
        return (await _stop_instrument(devices)).words
    board = bench.pump_board(devices, devices.board)
    try:
        identity = await bench.patiently(board.identify, devices.board)
        if identity.map_version == 1:
            await board.stop()
        return _words(devices, await _standing(board, devices.watchdog_s))
    except LinkError as error:
        raise DeviceError(f"{error}; the board's watchdog stops the pump by itself") from None
    finally:
        await board.close()


async def _standing(board: PumpBoard, watchdog_s: float) -> BenchReading:
    """Reading of a stopped pump; a pump still running after the watchdog period is stopped, which latches."""
    for _ in range(math.ceil((watchdog_s + _LAPSE_S) / _LOOK_S)):
        if (reading := await board.read()).pump_fraction == 0.0:
            return reading
        await asyncio.sleep(_LOOK_S)
    await board.stop()
    return await board.read()


def _hold_told(config: Config, folder: Path) -> str:
    """Latch a running hold; returns the result, empty if none answers."""
    path = config.port.socket_in(folder)
    if not config.port.enabled or not path.exists():
        return ""
    from membrane_ctrl.control_port import client  # only now: the pump is stopped sooner without

    try:
        with client.PortClient.unix(path, notice=lambda _: None) as hold:
            answer = hold.ask(do="latch", text=_CAUSE, why="membrane-ctrl safe")
            run = str(hold.greeting.get("run", ""))
    except DeviceError as error:
        print(f"the running hold could not be latched: {error}", file=sys.stderr)
        return ""
    if not answer.get("ok"):
        print(f"the running hold refused to latch: {answer.get('refused', '')}", file=sys.stderr)
        return ""
    return f"run {run}: latched, until `membrane-ctrl ctl ack`"


def _keep(file: LatchedFile) -> None:
    """Write the latch, which blocks holds until a person clears it. Raises DeviceError."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        file.path.parent.mkdir(parents=True, exist_ok=True)
        file.add(LatchedFault("locked", _CAUSE, f"by {getpass.getuser()}", _REMEDY, now, "none"))
    except OSError as error:
        reason = os_reason(error)
        raise DeviceError(f"{file.path}: the pump is stopped, but not latched ({reason})") from None
    print(f"{file.path}: no hold before `membrane-ctrl hold --clear-faults` or `ctl ack`", file=sys.stderr)
