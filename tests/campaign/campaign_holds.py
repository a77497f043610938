"""Stories with the real supervisor, drivers and files.

The matrix runs `hold.virtual_run` instead of the supervisor. This is the supervisor itself, over
the board and over a bench of single instruments, with its way out, its guards, its latched-fault
file and its software watchdog.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from campaign_lab import Instruments, TableLink
from campaign_times import HOLD_FLOW_S, RAMP_S, RATE_HZ, TICK_S, WATCHDOG_S
from campaign_world import WatchedPlant, World
from hold_rig import BoardBench, HoldRig, LoopClock, a_hold, board_of, on_board

from firmware_iface.drivers.bronkhorst import BronkhorstFlow
from firmware_iface.drivers.bronkhorst_modbus import ModbusParameters
from firmware_iface.emulators.pumps import BronkhorstRegisters, Instrument
from firmware_iface.roles import Bench, BenchCommand, DeviceRefusedError
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.fault_latch import FaultLatch
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.events import CommandTaken, Event
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.run_files.latched_fault import NAME, LatchedFile
from tests.support.virtual_time import run_virtual as in_virtual_time


async def the_program_ends_in_a_hold() -> list[str]:
    """However the program ends, the last write is pump 0, at once and not by the watchdog."""
    violations = []
    for way in ("cancelled", "a driver raises"):
        async with a_hold(on_board) as rig:
            if way == "cancelled":
                rig.task.cancel()
            board_of(rig).raises = way != "cancelled"
            await asyncio.sleep(2.5 * TICK_S)
            rig.now()
            rig.must(rig.task.done(), "the run continues")
            rig.must(not rig.still(), "the program ended and left the pump running")
            violations += [f"{way}: {what}" for what in rig.violations]
    return violations


def _raise(outputs: TickOutputs) -> None:
    raise RuntimeError("a listener that must not raise")


async def cancelled_while_it_vents() -> list[str]:
    """Ending the program does not shut the vent of a mirror that is being vented."""
    async with a_hold(on_board) as rig:
        board_of(rig).virtual.wrong.gauge_offset_pa = 60.0
        await rig.until(State.FAULT)
        await rig.wait(1.0)
        rig.task.cancel()
        await rig.wait(1.0, rig.still)
        rig.must(rig.plant.vent_given == 1.0, "the program ended and shut the vent")
        return rig.violations


async def a_guard_ends() -> list[str]:
    """A guard of the bench, or a listener to the ticks, ends: the pump stops."""
    violations = []
    for what in ("guard", "listener"):
        async with a_hold(on_board) as rig:
            board_of(rig).guards = ("software watchdog",) if what == "guard" else ()
            rig.listeners += [_raise] if what == "listener" else []
            await rig.wait(4 * TICK_S)
            await rig.wait(5.0, rig.still)
            rig.must(rig.state == State.FAULT, "no fault")
            violations += [f"{what}: {found}" for found in rig.violations]
    return violations


async def a_slow_board() -> list[str]:
    """Answers take 0.2 s: the loop cannot run, the pump ramps down; one of 0.4 s causes no burst of
    ticks.
    """
    async with a_hold(on_board) as rig:
        board_of(rig).slow_s = 0.4
        await asyncio.sleep(0.4)
        board_of(rig).slow_s = 0.0
        await asyncio.sleep(0.5)
        before = rig.supervisor.ticks
        await asyncio.sleep(1.0)
        rig.must(
            rig.supervisor.ticks - before < RATE_HZ * 1.1, "missed ticks are made up in a burst"
        )
        writes = [
            b.row.mono_s - a.row.mono_s for a, b in zip(rig.heard, rig.heard[1:], strict=False)
        ]
        rig.must(min(writes) > 0.2 * TICK_S, f"two ticks {1e3 * min(writes):.1f} ms apart")
    async with a_hold(on_board) as slow:
        board_of(slow).slow_s = 0.2
        await slow.wait(RAMP_S + 6.0)
        await slow.wait(3.0, slow.still)
        return rig.violations + slow.violations


async def a_slow_link_starves_the_watchdog() -> list[str]:
    """Answers become slower than the board's watchdog waits: it stops the pump, by the link."""
    async with a_hold(on_board) as rig:
        board_of(rig).slow_s = 0.2
        await asyncio.sleep(0.3)
        board_of(rig).slow_s = 2.0 * WATCHDOG_S
        await rig.until(State.FAULT)
        await rig.wait(RAMP_S + 6.0)
        await rig.wait(3.0, rig.still)
        return rig.violations


async def a_board_that_latched_stays_latched() -> list[str]:
    """Without an acknowledgement the board's over-pressure stays latched, whatever the supervisor
    does.
    """
    async with a_hold(on_board) as rig:
        board_of(rig).virtual.wrong.gauge_offset_pa = 300.0
        await rig.wait(1.0)
        board_of(rig).virtual.wrong.gauge_offset_pa = 0.0
        await rig.wait(20.0, rig.still)
        rig.must(board_of(rig).virtual.read().latched_faults & 2 != 0, "the board's latch is gone")
        rig.must(rig.plant.vent_given == 1.0, "the vent is shut")
        return rig.violations


async def the_network_comes_back() -> list[str]:
    """The network is cut: the fault trips, the link reopens, and the next hold works."""
    async with a_hold(on_board) as rig:
        wrong = board_of(rig).virtual.wrong
        wrong.unreachable = True
        await rig.wait(3.0)
        rig.must(rig.state == State.FAULT, "no fault without a network")
        wrong.unreachable = False
        await rig.wait(5.0, rig.still)
        rig.must(
            math.isfinite(rig.heard[-1].row.gauge_pressure_pa), "the link was not opened again"
        )
        rig.ask("ack")
        await rig.until(State.STANDBY, 10.0)
        rig.ask("hold")
        await rig.until(State.HOLD)
        rig.near()
        return rig.violations


async def faults_that_outlive_the_run() -> list[str]:
    """A trip is in the file; an unreadable file is a fault; a refused acknowledgement clears
    nothing.
    """
    from membrane_ctrl.hold.hold_options import HoldOptions
    from membrane_ctrl.hold.start_checks import open_latched_fault

    with tempfile.TemporaryDirectory() as folder:
        file = LatchedFile(Path(folder))
        options = HoldOptions(Config(), "lab.toml", False, None, "campaign", None, False, False)

        def refused() -> bool:
            try:
                open_latched_fault(Config(), Path(folder), options)
            except DeviceError:
                return True
            return False

        async with a_hold(on_board) as rig:
            with FaultLatch(file, None, "run", LoopClock().utc, rig.events.append) as fault_latch:
                rig.listeners.append(fault_latch.handle_tick)
                board_of(rig).virtual.wrong.late_ms = 0.0
                board_of(rig).virtual.wrong.gauge_offset_pa = 60.0
                await rig.until(State.FAULT)
                await rig.wait(1.0)
            first = file.read()
            rig.must(first is not None and first.name == "over_pressure", f"in the file: {first}")
            rig.must(refused(), "the next hold starts over a latched fault")
            with FaultLatch(file, None, "run", LoopClock().utc, rig.events.append) as fault_latch:
                locked = CommandTaken("latch", "somebody", "", text="later")
                denied = CommandTaken("ack", "somebody", "", refused="not now")
                for event in (locked, denied):
                    fault_latch.handle_tick(cast(TickOutputs, _Told(rig.heard[-1], (event,))))
            rig.must(
                file.read() == first,
                "the first cause was replaced, or cleared by a refused acknowledgement",
            )
            for content in ("", "{", "[]", '{"schema": "other"}', "null"):
                (Path(folder) / NAME).write_text(content)
                rig.must(refused(), f"a file that holds {content!r} is no fault")
            return rig.violations


@dataclass
class _Told:
    """A tick that reported one event."""

    of: TickOutputs
    events: tuple[Event, ...]

    @property
    def row(self) -> Any:
        """As in the tick."""
        return self.of.row


async def a_board_that_is_latched_at_the_start() -> list[str]:
    """The resume rule may clear a watchdog's trip at the start, and nothing else."""
    from membrane_ctrl.config.schema import DevicesConfig, ResumeConfig
    from membrane_ctrl.hold.hold_options import HoldOptions
    from membrane_ctrl.hold.start_checks import identify_board

    config, devices = Config(), DevicesConfig(board="tcp://127.0.0.1:1")
    asked = config.model_copy(
        update={"devices": devices, "resume": ResumeConfig(faults=("watchdog_tripped",))}
    )
    options = HoldOptions(asked, "lab.toml", False, None, "campaign", None, False, False)
    bench = BoardBench(WatchedPlant(World(), config.twin, config.pump))
    bench.virtual.wrong.gauge_offset_pa = 300.0
    await asyncio.sleep(0.1)
    bench.now()
    bench.virtual.wrong.gauge_offset_pa = 0.0
    try:
        await identify_board(bench, asked, options)
    except DeviceError:
        return []
    return ["a hold starts on a board that has latched over-pressure"]


def _composed(
    bronkhorst: bool, made: list[Instruments]
) -> Callable[[WatchedPlant], tuple[Bench, Callable[[], object]]]:
    def make(plant: WatchedPlant) -> tuple[Bench, Callable[[], object]]:
        made.append(Instruments(plant, bronkhorst))
        return made[-1].bench, made[-1].now

    return make


@contextlib.asynccontextmanager
async def instruments(bronkhorst: bool) -> AsyncIterator[tuple[HoldRig, Instruments]]:
    """A supervisor over single instruments."""
    made: list[Instruments] = []
    async with a_hold(_composed(bronkhorst, made)) as rig:
        yield rig, made[-1]


async def _both(story: Callable[[HoldRig, Instruments], Awaitable[None]]) -> list[str]:
    violations = []
    for bronkhorst in (False, True):
        async with instruments(bronkhorst) as (rig, lab):
            await story(rig, lab)
            violations += [
                f"{'Bronkhorst' if bronkhorst else 'Modbus'}: {what}" for what in rig.violations
            ]
    return violations


async def instruments_hold_a_mirror() -> list[str]:
    """Commands arrive, measurements are reported, and the mirror is held."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        await rig.wait(10.0)
        rig.near()
        for _ in range(50):
            await asyncio.sleep(TICK_S)
            lab.now()
            row, truth = rig.heard[-1].row, rig.plant.truth()
            off = rig.plant.pump_given - row.pump_fraction
            rig.must(
                abs(off) < 2e-3,
                f"commanded {row.pump_fraction:.3f}, given {rig.plant.pump_given:.3f}",
            )
            rig.must(
                abs(row.gauge_pressure_pa - truth.gauge_pressure_pa) < 4.0,
                "the reported pressure is not the true one",
            )
            readback = row.pump_readback_fraction
            rig.must(abs(readback - rig.plant.pump_given) < 0.2, f"read-back {readback:.2f}")

    return await _both(story)


async def over_pressure_of_instruments() -> list[str]:
    """Too much pressure: the pump stops and the vent opens."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        lab.offset_pa = 60.0
        await rig.wait(5 * TICK_S)
        await rig.wait(3.0, rig.still)
        rig.must(rig.plant.vent_given > 0.99, "over-pressure, and the vent is shut")

    return await _both(story)


async def a_gauge_out_of_its_range() -> list[str]:
    """A gauge that shows a value outside its range has no value."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        lab.offset_pa = -900.0
        await rig.wait(RAMP_S + 1.5)
        await rig.wait(3.0, rig.still)

    return await _both(story)


async def a_laser_is_unplugged() -> list[str]:
    """The mean flow is held for its time, then the pump stops."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        lab.laser.plugged = False
        before_um = lab.now().truth().displacement_um
        await rig.wait(HOLD_FLOW_S + RAMP_S + 1.0)
        went_um = lab.now().truth().displacement_um - before_um
        rig.must(went_um < 30.0, f"blind, and the bowl went {went_um:.0f} µm deeper")
        await rig.wait(5.0, rig.still)

    return await _both(story)


async def the_supervisor_hangs() -> list[str]:
    """Ticks cease: the software watchdog stops the pump, and only a person starts it again."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        hung = asyncio.Event()
        write = lab.bench.write

        async def hang(command: BenchCommand) -> None:
            await hung.wait()
            await write(command)  # the write that was under way when it hung

        lab.bench.write = hang  # type: ignore[method-assign]
        await rig.wait(WATCHDOG_S * 1.5 + 2 * TICK_S)
        await rig.wait(3.0, rig.still)
        lab.bench.write = write  # type: ignore[method-assign]
        hung.set()
        await rig.wait(4 * TICK_S, rig.still)
        rig.must(rig.state == State.FAULT, "a trip of the software watchdog is no fault")
        await rig.wait(20.0, rig.still)

    return await _both(story)


async def the_software_watchdog_ends() -> list[str]:
    """The software watchdog itself ends: the pump stops."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        next(
            task for task in asyncio.all_tasks() if task.get_name() == "software watchdog"
        ).cancel()
        await rig.wait(4 * TICK_S)
        await rig.wait(5.0, rig.still)
        rig.must(rig.state == State.FAULT, "a bench without its watchdog is no fault")

    return await _both(story)


async def a_pump_that_gives_no_answer() -> list[str]:
    """The pump's line is dead: a fault, and pump 0 as soon as it is back."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        lab.pump.lose = 10**9
        await rig.wait(3.0)
        rig.must(rig.state == State.FAULT, "a pump that does not answer is no fault")
        lab.pump.lose = 0
        await rig.wait(1.0)
        await rig.wait(5.0, rig.still)

    return await _both(story)


async def a_pump_that_hears_nothing() -> list[str]:
    """The pump answers reads but takes no command: a fault at once, not at the next stop."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        lab.pump.deaf = True
        await rig.wait(2.0)
        rig.must(rig.state == State.FAULT, "a pump that takes no command is no fault")
        lab.pump.deaf = False
        await rig.wait(1.0)
        await rig.wait(5.0, rig.still)

    return await _both(story)


async def the_pump_does_not_hear_the_last_write() -> list[str]:
    """The last write is lost: closing the bench stops the pump."""

    async def story(rig: HoldRig, lab: Instruments) -> None:
        await asyncio.sleep(0.37 * TICK_S)
        lab.pump.lose = 1
        rig.task.cancel()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        await lab.bench.close()
        rig.must(not rig.still(), "the bench is closed and the pump runs")

    return await _both(story)


async def another_instrument_in_its_place() -> list[str]:
    """A gauge is unplugged and another one plugged in: the new one is not used."""
    async with instruments(True) as (rig, lab):
        other = Instrument("DEPC", "M9", 10.0, "mbar(g)", lambda: 1.0)
        lab.gauge.plugged = False
        await rig.wait(0.2)
        lab.gauge.table, lab.gauge.plugged = BronkhorstRegisters(other), True
        await rig.wait(2.0)
        rig.must(math.isnan(rig.heard[-1].row.gauge_pressure_pa), "another gauge's value is used")
        await rig.wait(RAMP_S)
        await rig.wait(3.0, rig.still)
        return rig.violations


async def a_lab_with_another_serial_number() -> list[str]:
    """The configuration names one instrument, and another one answers."""
    answers = Instrument("DMFC", "M7", 360.0, "mln/min")
    port = ModbusParameters(TableLink("p", BronkhorstRegisters(answers)))
    try:
        await BronkhorstFlow(port, "M1").open()
    except DeviceRefusedError:
        return []
    return ["another flow controller is taken"]


def run_hold_story(story: Callable[[], Awaitable[list[str]]]) -> list[str]:
    """Run a story of a rig."""
    return in_virtual_time(cast(Any, story()))


HOLDS: Sequence[Callable[[], Awaitable[list[str]]]] = (
    the_program_ends_in_a_hold,
    cancelled_while_it_vents,
    a_guard_ends,
    a_slow_board,
    a_slow_link_starves_the_watchdog,
    a_board_that_latched_stays_latched,
    the_network_comes_back,
    faults_that_outlive_the_run,
    a_board_that_is_latched_at_the_start,
    instruments_hold_a_mirror,
    over_pressure_of_instruments,
    a_gauge_out_of_its_range,
    a_laser_is_unplugged,
    the_supervisor_hangs,
    the_software_watchdog_ends,
    a_pump_that_gives_no_answer,
    a_pump_that_hears_nothing,
    the_pump_does_not_hear_the_last_write,
    another_instrument_in_its_place,
    a_lab_with_another_serial_number,
)
