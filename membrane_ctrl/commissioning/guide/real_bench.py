"""The configured devices, and a hold of their own program."""

import asyncio
import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from firmware_iface import roles
from membrane_ctrl.acquisition import optical_bench
from membrane_ctrl.acquisition.mirror_pictures import MirrorPictures, take_mirror_pictures
from membrane_ctrl.acquisition.waiting_clock import WaitingClock
from membrane_ctrl.commissioning import check
from membrane_ctrl.commissioning.devices import (
    FoundDevice,
    find_cameras,
    find_displays,
    find_drivers,
    find_ports,
)
from membrane_ctrl.commissioning.guide.bench_access import Action, HandMotion, OpenBench
from membrane_ctrl.commissioning.guide.session_state import CONFIGURATION
from membrane_ctrl.commissioning.guide.shown_program import OWN_PROGRAM, run_shown
from membrane_ctrl.config.port import SOCKET_NAME
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.instruments import (
    bench,
    bench_connection,
    device_claim,
    device_names,
    lock_keys,
    lock_store,
)
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.run_files.latched_fault import LatchedFile
from membrane_ctrl.sessions.live_hold import HoldLink, live_hold

T = TypeVar("T")
_STARTS_S = 90.0
_OWN_END_S = 10.0
_ENDS_S = 120.0
_POLL_S = 0.2
_CLIENT = "commission"


class RealBench:
    """A `BenchAccess` to the configured devices."""

    simulated = False

    def find_devices(self) -> list[FoundDevice]:
        """What is connected to this machine."""
        cameras, _ = find_cameras()
        return [*find_ports(), *cameras, *find_displays(), *find_drivers()]

    def probe_devices(self, config: Config) -> list[check.DeviceProbe]:
        """Probe the configured devices without writing to them."""
        probes, _ = check.probe_all_devices(config)
        return [probe for probe in probes if probe.role != "camera"]

    def probe_optics(self, config: Config) -> list[check.DeviceProbe]:
        """Probe camera and screen together."""
        return check.probe_optics(config)

    def photograph(self, config: Config) -> MirrorPictures:
        """Take the mirror with the screen white and black. Raises DeviceError."""
        try:
            optics = optical_bench.configured_bench(config, WaitingClock(RunClock.start()))
        except roles.LinkError as error:
            raise DeviceError(str(error)) from None
        try:
            return take_mirror_pictures(optics)
        except roles.LinkError as error:
            raise DeviceError(str(error)) from None
        finally:
            optics.close()

    def act(self, config: Config, action: Action[T]) -> T:
        """Open the bench, do something with it, and leave it with the pump off.

        Parameters
        ----------
        config : Config
            With the devices.
        action : Action[T]
            Gets the opened bench.

        Returns
        -------
        T
            What the action returns.

        Raises
        ------
        DeviceError
            No devices are configured, another program uses them, a lock forbids it, or one does
            not open.
        LinkError
            The bench fails meanwhile.
        """
        devices = config.devices
        if devices is None:
            raise DeviceError("no devices are configured")
        with device_claim.claim_devices(device_names.list_device_names(devices)):
            lock_store.require_unlocked(
                lock_store.LockStore.of_machine(), lock_keys.list_device_keys(devices)
            )
            return asyncio.run(self._act(devices, action))

    async def _act(self, devices: DevicesConfig, action: Action[T]) -> T:
        made = bench.make_bench(devices)
        identity = await bench_connection.connect_bench(made, devices)
        loop = asyncio.get_running_loop()
        try:
            return await action(OpenBench(made, identity, asyncio.sleep, loop.time))
        finally:
            await stop_outputs(made)
            await made.close()

    def move_hand(self, motion: HandMotion) -> None:
        """Do nothing: the person has moved the real thing."""

    @contextlib.contextmanager
    def start_hold(
        self, folder: Path, config: Config, name: str, by_frames: bool = False
    ) -> Iterator[HoldLink]:
        """Start `hold --standby` with the session's configuration, and stop it at the end.

        Parameters
        ----------
        folder : Path
            Of the session: its `lab.toml` is the configuration, `logs` gets the run, `NAME.log`
            what the hold prints.
        config : Config
            Not used: the program reads the file in `folder`.
        name : str
            Last part of the run folder's name.
        by_frames : bool
            Not used: a real hold always measures with its camera.

        Raises
        ------
        DeviceError
            The hold does not start, or does not end.
        """
        logs = _find_logs(folder)
        logs.mkdir(parents=True, exist_ok=True)
        command = [
            *OWN_PROGRAM,
            "hold",
            "--config",
            str(folder / CONFIGURATION),
            "--standby",
            "--name",
            name,
            "--logs",
            str(logs),
            "--no-service",
        ]
        output = (folder / f"{name}.log").open("ab")
        with output:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output
            )
        try:
            _wait_for_socket(process, logs / SOCKET_NAME, folder / f"{name}.log")
            with live_hold(Where(logs=logs), take_over=False, session=_CLIENT) as link:
                yield link
        finally:
            _end_process(process)

    def find_latched_fault(self, folder: Path) -> str:
        """The fault that the session's runs have latched; empty if there is none."""
        latched = LatchedFile(_find_logs(folder)).read()
        return "" if latched is None else str(latched)

    def run_tuning(
        self, folder: Path, config: Config, command: str, show: Callable[[str], None]
    ) -> int:
        """Run `tune` on the hold that runs; save what it finds in the session's configuration.

        Parameters
        ----------
        folder : Path
            Of the session; its `logs` has the hold's socket.
        config : Config
            Not used: the program takes the configuration of the hold.
        command : str
            `run` or `pump`.
        show : callable
            Gets each printed line.

        Returns
        -------
        int
            The exit code of the first program that fails, else 0.
        """
        logs = str(_find_logs(folder))
        arguments = [*OWN_PROGRAM, "tune", command, "--logs", logs, "--yes", "--take-over"]
        code = run_shown(arguments, show)
        if code == 0:
            configuration = str(folder / CONFIGURATION)
            saved = [*OWN_PROGRAM, "tune", "save", "--logs", logs, "--config", configuration]
            code = run_shown([*saved, "--yes"], show)
        return code


def _find_logs(folder: Path) -> Path:
    """Where a session's holds record their runs."""
    return folder / "logs"


async def stop_outputs(open_bench: roles.Bench) -> None:
    """Switch the pump off and close the vent; the watchdog stops a bench that does not answer."""
    with contextlib.suppress(roles.LinkError):
        await open_bench.write(roles.BenchCommand(0.0, 0.0))


def _wait_for_socket(process: "subprocess.Popen[bytes]", socket: Path, log: Path) -> None:
    """Wait until the hold listens. Raises DeviceError if it ends before, or takes too long."""
    until_s = time.monotonic() + _STARTS_S
    while not socket.exists():
        if process.poll() is not None:
            lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
            last = lines[-1] if lines else "no message"
            raise DeviceError(f"the hold does not start: {last} ({log})")
        if time.monotonic() > until_s:
            raise DeviceError(f"the hold does not listen within {_STARTS_S:g} s ({log})")
        time.sleep(_POLL_S)


def _end_process(process: "subprocess.Popen[bytes]") -> None:
    """End the hold as Ctrl-C does, and wait until it has stopped safely.

    A Ctrl-C of the terminal has reached it already: then it only needs time. Raises DeviceError if
    it does not end.
    """
    with contextlib.suppress(subprocess.TimeoutExpired):
        if isinstance(sys.exc_info()[1], KeyboardInterrupt):
            process.wait(_OWN_END_S)
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(_ENDS_S)
    except subprocess.TimeoutExpired:
        raise DeviceError(
            f"the hold has not ended within {_ENDS_S:g} s: run `membrane-ctrl safe`, then end it"
        ) from None
