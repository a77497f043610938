"""The twin behind its emulated pump board in virtual time, with the hands of a person.

The board is that of `VirtualBench`: the same driver, registers, watchdog and latches as a real one;
requests take no time. The controller is that of a hold. Configured single instruments are emulated
by `instrument_lab` where they are probed.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from firmware_iface import roles
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.optical_roles import Pixels
from membrane_ctrl.acquisition.mirror_pictures import MirrorPictures, take_mirror_pictures
from membrane_ctrl.commissioning import check
from membrane_ctrl.commissioning.devices import FoundDevice
from membrane_ctrl.commissioning.guide import instrument_lab
from membrane_ctrl.commissioning.guide.bench_access import (
    Action,
    HandAct,
    HandMotion,
    OpenBench,
)
from membrane_ctrl.commissioning.guide.emulated_optics import EmulatedLens, EmulatedOptics
from membrane_ctrl.commissioning.guide.real_bench import stop_outputs
from membrane_ctrl.commissioning.guide.session_state import CONFIGURATION
from membrane_ctrl.commissioning.guide.shown_program import OWN_PROGRAM, run_shown
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.sessions.live_hold import HoldLink
from membrane_ctrl.sim import plant, virtual_bench
from membrane_ctrl.sim.virtual_interlocks import VirtualInterlocks

T = TypeVar("T")
AlterPicture = Callable[[Pixels], Pixels]
MakeHold = Callable[[Config, virtual_bench.VirtualBench, str, AlterPicture | None], HoldLink]
_TICK_S = 0.02
_HAND_PA = 20.0  # what a hand on the film adds


class EmulatedBench:
    """A `BenchAccess` to the twin.

    Parameters
    ----------
    make_hold : callable
        Starts a hold of a configuration on a virtual bench, with a name and, if it measures figures
        from rendered frames, what alters these (`hold/virtual_hold.py`).

    Attributes
    ----------
    laser_sign : int
        -1: the laser is mounted or configured the wrong way round.
    lens : EmulatedLens
        Of the rendered camera, which a hand can turn out of focus.
    """

    simulated = True

    def __init__(self, make_hold: MakeHold) -> None:
        self._make_hold = make_hold
        self._made: virtual_bench.VirtualBench | None = None
        self._interlocks = VirtualInterlocks()
        self.laser_sign = 1
        self.lens = EmulatedLens()

    @property
    def bench(self) -> virtual_bench.VirtualBench:
        """The bench, once it has been used. Raises DeviceError before."""
        if self._made is None:
            raise DeviceError("the emulated bench has not been used yet")
        return self._made

    def use_mirror(self, bench: virtual_bench.VirtualBench) -> None:
        """Use another bench than the twin of the session's configuration, which begins flat."""
        self._made = bench

    def _use_bench(self, config: Config) -> virtual_bench.VirtualBench:
        """The bench with the circuits that are configured now; the mirror is flat at first."""
        if config.devices is None:
            raise DeviceError("no devices are configured")
        if self._made is None:
            twin = config.twin.model_copy(update={"from_flat": True})
            mirror = plant.Plant(twin, config.pump)
            self._made = virtual_bench.VirtualBench(mirror, config.devices.watchdog_s)
        interlocks = VirtualInterlocks(config.interlocks)
        interlocks.open_names = self._interlocks.open_names
        interlocks.lost_names = self._interlocks.lost_names
        self._interlocks = interlocks
        self._made.interlocks = interlocks
        self._made.advance(_TICK_S)
        return self._made

    def find_devices(self) -> list[FoundDevice]:
        """The emulated board."""
        return [FoundDevice("board", "emulated pump board", 'board = "tcp://127.0.0.1:5020"')]

    def probe_devices(self, config: Config) -> list[check.DeviceProbe]:
        """Probe the emulated devices as `check` does."""
        bench = self._use_bench(config)
        devices = config.devices
        assert devices is not None
        if devices.board is None:
            return asyncio.run(instrument_lab.probe_instruments(bench.plant, devices))
        board = PumpBoard("", link=virtual_bench.MemoryLink(bench))
        return [asyncio.run(check.probe_board(board, devices.board, not config.by_optics))]

    def probe_optics(self, config: Config) -> list[check.DeviceProbe]:
        """Probe the emulated screen with the rendered camera."""
        if config.devices is None or config.devices.screen is None:
            return []
        return [self._make_optics(config).probe_bench()]

    def photograph(self, config: Config) -> MirrorPictures:
        """Render the mirror with the screen white and black. Raises DeviceError."""
        try:
            return take_mirror_pictures(self._make_optics(config).bench)
        except roles.LinkError as error:
            raise DeviceError(str(error)) from None

    def _make_optics(self, config: Config) -> EmulatedOptics:
        self.lens.full_scale_adu = float((1 << config.optics.camera.bits) - 1)
        return EmulatedOptics(config, self._use_bench(config).plant, self.lens)

    def act(self, config: Config, action: Action[T]) -> T:
        """Open the board, do something with it, and leave it with the pump off.

        Parameters
        ----------
        config : Config
            Of the session; its interlocks are applied, and the bench stays the one that the first
            call has made.
        action : Action[T]
            Gets the opened bench, whose time passes only in its `sleep`.

        Returns
        -------
        T
            What the action returns.

        Raises
        ------
        DeviceError
            The bench does not open, for example with a pulled cable.
        """
        return asyncio.run(self._act(self._use_bench(config), action))

    async def _act(self, bench: virtual_bench.VirtualBench, action: Action[T]) -> T:
        opened = _BoardInMemory(bench)
        try:
            identity = await opened.open()
        except roles.LinkError as error:
            raise DeviceError(str(error)) from None
        try:
            return await action(OpenBench(opened, identity, self._sleep, self._now_s))
        finally:
            await stop_outputs(opened)
            await opened.close()

    async def _sleep(self, duration_s: float) -> None:
        for _ in range(max(1, round(duration_s / _TICK_S))):
            self.bench.advance(_TICK_S)

    def _now_s(self) -> float:
        return self.bench.plant.time_s

    def move_hand(self, motion: HandMotion) -> None:
        """Do what the person was asked to do."""
        wrong = self.bench.wrong
        match motion.act:
            case HandAct.PRESS_FILM:
                wrong.gauge_offset_pa += _HAND_PA
            case HandAct.RELEASE_FILM:
                wrong.gauge_offset_pa -= _HAND_PA
            case HandAct.MOVE_CARD:
                wrong.laser_offset_um += self.laser_sign * motion.distance_um
            case HandAct.REMOVE_CARD:
                wrong.laser_offset_um = 0.0
            case HandAct.PULL_CABLE:
                wrong.unreachable = True
            case HandAct.PLUG_CABLE:
                wrong.unreachable = False
            case HandAct.OPEN_CIRCUIT:
                self._interlocks.open_names.add(motion.name)
            case HandAct.LOSE_SIGNAL:
                self._interlocks.lost_names.add(motion.name)
            case HandAct.CLOSE_CIRCUIT:
                self._interlocks.open_names.discard(motion.name)
                self._interlocks.lost_names.discard(motion.name)
            case HandAct.TURN_FOCUS:
                self.lens.turn_ring()
                return  # a hold runs, whose time passes only with its ticks
        self.bench.advance(1.0)

    @contextlib.contextmanager
    def start_hold(
        self, folder: Path, config: Config, name: str, by_frames: bool = False
    ) -> Iterator[HoldLink]:
        """Start the controller in standby, in virtual time.

        Parameters
        ----------
        folder : Path
            Of the session; not used: a virtual hold records no run.
        config : Config
            The configuration of the hold.
        name : str
            Of the run.
        by_frames : bool
            Measure figures from rendered frames instead of simulated figures; each costs seconds of
            processor time.
        """
        alter = self.lens.alter_picture if by_frames else None
        link = self._make_hold(config, self._use_bench(config), name, alter)
        try:
            yield link
        finally:
            link.close()

    def find_latched_fault(self, folder: Path) -> str:
        """None: a virtual hold keeps nothing for the next one."""
        return ""

    def run_tuning(
        self, folder: Path, config: Config, command: str, show: Callable[[str], None]
    ) -> int:
        """Run `tune` on a twin of its own; its gains are not saved.

        Parameters
        ----------
        folder : Path
            Of the session; has the configuration, and gets the tuning session.
        config : Config
            Not used: the program reads the file in `folder`.
        command : str
            `run` or `pump`.
        show : callable
            Gets each printed line.

        Returns
        -------
        int
            The program's exit code, 0 if it is done.
        """
        configuration = str(folder / CONFIGURATION)
        # Its own folder: `tune run` would continue the session of `tune pump`, whose curve the
        # configuration has not.
        logs = str(folder / "logs" / command)
        arguments = [*OWN_PROGRAM, "tune", command, "--twin"]
        arguments += ["--config", configuration, "--logs", logs, "--yes"]
        return run_shown(arguments, show)


class _BoardInMemory:
    """A `roles.Bench` on a virtual bench."""

    def __init__(self, bench: virtual_bench.VirtualBench) -> None:
        self._bench = bench

    async def open(self) -> roles.BenchIdentity:
        return self._bench.open()

    async def read(self) -> roles.BenchReading:
        return self._bench.read()

    async def write(self, command: roles.BenchCommand) -> None:
        self._bench.write(command)

    async def clear_faults(self, mask: int) -> None:
        self._bench.clear_faults(mask)

    def dead_guards(self) -> tuple[str, ...]:
        return ()

    def link_state(self) -> roles.LinkState:
        return roles.NO_LINK_STATE

    async def close(self) -> None:
        self._bench.close()
