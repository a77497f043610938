"""The real supervisor over a bench in memory, on an event loop in virtual time, observed from
outside.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any, cast

from campaign_run import config_of
from campaign_times import RATE_HZ, TICK_S, WATCHDOG_S
from campaign_world import WatchedPlant, World

from firmware_iface.roles import (
    NO_LINK_STATE,
    Bench,
    BenchCommand,
    BenchIdentity,
    BenchReading,
    LinkError,
    LinkState,
)
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.supervisor import Supervisor, Wiring
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.telemetry import ROW_BYTES, State
from membrane_ctrl.processes.ring import RingWriter, open_ring
from membrane_ctrl.sim.virtual_bench import VirtualBench

_LOOK_S = 0.01


class LoopClock:
    """A `RunClock` that reads the event loop's time."""

    def now(self) -> float:
        """Virtual seconds."""
        return asyncio.get_running_loop().time()

    def utc(self, mono_s: float) -> datetime:
        """Some day."""
        return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=mono_s)


class BoardBench:
    """The board in memory, advanced to the event loop's time at every access."""

    def __init__(self, plant: WatchedPlant) -> None:
        self.virtual = VirtualBench(plant, WATCHDOG_S)
        self._at_s = 0.0
        self.slow_s = 0.0
        self.raises = False
        self.guards: tuple[str, ...] = ()

    def now(self) -> VirtualBench:
        """The board as it is now."""
        now_s = asyncio.get_running_loop().time()
        if now_s > self._at_s:
            self.virtual.advance(now_s - self._at_s)
            self._at_s = now_s
        return self.virtual

    async def open(self) -> BenchIdentity:
        self.now().open()
        return cast(BenchIdentity, None)  # nobody asks who it is

    async def read(self) -> BenchReading:
        await asyncio.sleep(self.slow_s)
        if self.raises:
            raise ZeroDivisionError("a driver's own mistake")
        return self.now().read()

    def dead_guards(self) -> tuple[str, ...]:
        return self.guards

    def link_state(self) -> LinkState:
        return NO_LINK_STATE

    async def write(self, command: BenchCommand) -> None:
        self.now().write(command)

    async def clear_faults(self, mask: int) -> None:
        self.now().clear_faults(mask)

    async def close(self) -> None:
        self.now().close()


@dataclass
class HoldRig:
    """A running supervisor, observed from outside; `violations` lists what was wrong."""

    plant: WatchedPlant
    bench: Bench
    now: Callable[[], object]
    config: Config
    heard: list[TickOutputs] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    listeners: list[Callable[[TickOutputs], None]] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    supervisor: Supervisor = field(init=False)
    task: asyncio.Task[Exit] = field(init=False)

    @property
    def state(self) -> State:
        """The controller's."""
        return State(int(self.heard[-1].row.state)) if self.heard else State.STANDBY

    def must(self, true: bool, what: str) -> None:
        """Note a violation unless this is true."""
        if not true and len(self.violations) < 3:
            now_s = asyncio.get_running_loop().time()
            self.violations.append(f"{now_s:.2f} s in {self.state.name.lower()}: {what}")

    async def wait(self, seconds: float, check: Callable[[], str] | None = None) -> None:
        """Let time pass, and look every 10 ms."""
        for _ in range(round(seconds / _LOOK_S)):
            await asyncio.sleep(_LOOK_S)
            self.now()
            if check is not None and (wrong := check()):
                self.must(False, wrong)

    async def until(self, state: State, most_s: float = 120.0) -> None:
        """Wait for a state."""
        for _ in range(round(most_s / TICK_S)):
            if self.state == state or self.task.done():
                return
            await asyncio.sleep(TICK_S)
        self.must(False, f"{state.name} did not come within {most_s:g} s")

    def still(self) -> str:
        """The violation if the pump is driven."""
        return (
            f"the pump is driven with {self.plant.pump_given:.2f}"
            if self.plant.pump_given > 0
            else ""
        )

    def near(self) -> None:
        """The mirror is at its setpoint."""
        off_um = self.plant.truth().displacement_um
        self.must(abs(off_um) < 10.0, f"the mirror is {off_um:.1f} µm off")

    def ask(self, *kinds: str) -> None:
        """Commands for the next tick."""
        for kind in kinds:
            self.supervisor.queue_command(Command(cast(Any, kind), "story"))


@contextlib.asynccontextmanager
async def a_hold(
    make: Callable[[WatchedPlant], tuple[Bench, Callable[[], object]]],
) -> AsyncIterator[HoldRig]:
    """A supervisor that is about to hold a mirror."""
    config = config_of(1, World(), False)
    plant = WatchedPlant(World(), config.twin, config.pump)
    bench, now = make(plant)
    rig = HoldRig(plant, bench, now, config)
    with ExitStack() as stack:
        rings = {
            name: stack.enter_context(open_ring(16, size))
            for name, size in (("t", ROW_BYTES), ("e", 4096))
        }
        telemetry, events = (RingWriter(rings[name]) for name in ("t", "e"))
        stack.callback(telemetry.close)
        stack.callback(events.close)
        wiring = Wiring(bench, telemetry, events)
        wiring.tick_listeners = {
            "rows": rig.heard.append,
            "listeners": lambda outputs: _tell_all(rig, outputs),
        }
        rig.supervisor = Supervisor(
            Controller(config, zernike_projection()), wiring, cast(RunClock, LoopClock()), RATE_HZ
        )
        await bench.open()
        rig.ask("hold")
        rig.task = asyncio.create_task(rig.supervisor.run(None))
        try:
            await rig.until(State.HOLD)
            yield rig
        finally:
            await asyncio.sleep(0.37 * TICK_S)  # not in the middle of an exchange
            rig.task.cancel()
            with contextlib.suppress(asyncio.CancelledError, LinkError, ZeroDivisionError):
                await rig.task
            await bench.close()


def _tell_all(rig: HoldRig, outputs: TickOutputs) -> None:
    for listener in rig.listeners:
        listener(outputs)


def on_board(plant: WatchedPlant) -> tuple[Bench, Callable[[], object]]:
    """The pump board."""
    bench = BoardBench(plant)
    return bench, bench.now


def board_of(rig: HoldRig) -> BoardBench:
    """The rig's board."""
    assert isinstance(rig.bench, BoardBench)
    return rig.bench
