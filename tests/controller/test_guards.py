"""The end of each guard of the program is a fault of the running hold."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from firmware_iface.role_bench import RoleBench, RoleDevices
from firmware_iface.roles import (
    BenchCommand,
    BenchIdentity,
    BenchReading,
    DeviceBusyError,
    DeviceIdentity,
    DisplacementSample,
    LinkDownError,
    LinkWaitsError,
)
from membrane_ctrl.config.schema import Config, DevicesConfig, LoopConfig, ShapeConfig
from membrane_ctrl.control_port.server import Port
from membrane_ctrl.control_port.sockets import Listeners
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.hold.child_processes import ChildProcesses, make_rings
from membrane_ctrl.hold.closing_words import RunEnd
from membrane_ctrl.hold.fault_latch import FaultLatch
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.lock_keeper import LockKeeper
from membrane_ctrl.hold.start_checks import BoardAtStart
from membrane_ctrl.hold.supervisor import Supervisor, Wiring
from membrane_ctrl.hold.systemd_notify import SystemdNotify
from membrane_ctrl.hold.tick_run import HoldResources, run_ticks
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.model.run_events import LatchFailed
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.run_files.latched_fault import LatchedFile, ResumeLog
from tests.support.virtual_time import run_virtual

CONFIG = Config(
    devices=DevicesConfig(board="tcp://192.0.2.1"),
    loop=LoopConfig(rate_hz=10.0),
    shape=ShapeConfig(enabled=False),
)
BREAKS_S = 3.0


class LoopClock:
    """A `RunClock` that reads the event loop's time."""

    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def utc(self, mono_s: float) -> datetime:
        return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=mono_s)


class Instrument:
    """Fills any role of an idle bench."""

    def __init__(self, value: float = 0.0) -> None:
        self.value, self.samples = value, 0

    async def open(self) -> DeviceIdentity:
        return DeviceIdentity("instrument", "1", "1.0")

    async def close(self) -> None:
        pass

    def describe(self) -> dict[str, str]:
        return {}

    async def displacement(self) -> DisplacementSample:
        self.samples += 1
        return DisplacementSample(1e-3 * (self.samples % 7), 0, self.samples, 0.1 * self.samples)

    async def set_pump(self, fraction: float) -> None:
        self.value = fraction

    async def pump_fraction(self) -> float:
        return self.value

    gauge_pressure_pa = pump_fraction


class Bench:
    """A composed bench, and the run of a hold on it."""

    def __init__(self, folder: Path) -> None:
        self.pump = Instrument()
        roles = RoleDevices(Instrument(), self.pump, Instrument(600.0))
        self.bench = RoleBench(roles, 0.5, lambda: asyncio.get_running_loop().time())
        self.folder = folder
        self.events: list[EventLine] = []
        self.reports: Callable[[], list[Event]] = list
        self.children = SimpleNamespace(read_reports=lambda: self.reports())

    def hold(self, breaks: Callable[[Bench], None]) -> Exit:
        """Hold in standby until something breaks after three seconds, and a stop after twenty."""
        options = HoldOptions(
            CONFIG, "lab.toml", False, 20.0, "test", self.folder, False, False, standby=True
        )
        latched = partial(
            FaultLatch, LatchedFile(self.folder), ResumeLog(self.folder), "run", LoopClock().utc
        )
        port = partial(Port, CONFIG.port, Listeners(), "run")
        with ExitStack() as stack:
            rings = make_rings(CONFIG, None, stack)
            events = RingReader(rings.events)
            stack.callback(events.close)

            async def run() -> Exit:
                asyncio.get_running_loop().call_later(BREAKS_S, breaks, self)
                children, clock = cast(ChildProcesses, self.children), cast(RunClock, LoopClock())
                closing = RunEnd()
                parts = HoldResources(
                    bench=self.bench,
                    config=CONFIG,
                    options=options,
                    clock=clock,
                    rings=rings,
                    children=children,
                    twin=None,
                    figure_mode=None,
                    board=BoardAtStart(),
                    make_port=port,
                    make_latch=latched,
                    make_keeper=partial(LockKeeper, None),
                )
                await run_ticks(parts, closing)
                assert closing.exit is not None
                return closing.exit

            exit_code = run_virtual(run())
            self.events = [json.loads(message) for message in events.drain()]
        return exit_code


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr("membrane_ctrl.processes.priority.raise_priority", lambda: "ordinary")
    return Bench(tmp_path)


def raises(*_: Any) -> None:
    raise RuntimeError("broken")


def cancel_watchdog(bench: Bench) -> None:
    assert bench.bench._watchdog is not None
    bench.bench._watchdog.cancel()


def breaking(monkeypatch: pytest.MonkeyPatch, kind: type, method: str) -> Callable[[Bench], None]:
    """Let a listener raise from `BREAKS_S` on."""
    whole = getattr(kind, method)
    broken = False

    def listen(self: object, outputs: TickOutputs) -> None:
        (raises if broken else whole)(self, outputs)

    def breaks(_: Bench) -> None:
        nonlocal broken
        broken = True

    monkeypatch.setattr(kind, method, listen)
    return breaks


def judged(bench: Bench, exit_code: Exit, name: str) -> None:
    assert exit_code == Exit.SAFETY_TRIP
    (fault,) = [event for event in bench.events if event["kind"] == "fault"]
    assert fault["name"] == "dead_task"
    assert name in fault["seen"]
    assert fault["mono_s"] == pytest.approx(BREAKS_S, abs=0.6)
    assert bench.pump.value == 0.0


def test_without_a_fault_the_hold_ends_as_requested(bench: Bench) -> None:
    assert bench.hold(lambda bench: None) == Exit.DONE
    assert not [event for event in bench.events if event["kind"] == "fault"]


def test_a_start_passes_the_resumes_of_the_day_to_the_controller(bench: Bench) -> None:
    for hours in (30.0, 2.0, 1.0):
        ResumeLog(bench.folder).add_resume(datetime.now(UTC) - timedelta(hours=hours))
    bench.hold(lambda bench: None)
    events = [event["value"] for event in bench.events if event.get("command") == "resumed"]
    assert events == [pytest.approx(7200.0, abs=60.0), pytest.approx(3600.0, abs=60.0)]


def test_a_software_watchdog_that_ended_is_a_fault(bench: Bench) -> None:
    judged(bench, bench.hold(cancel_watchdog), "software watchdog")
    latched = LatchedFile(bench.folder).read()
    assert latched is not None
    assert latched.name == "dead_task"


@pytest.mark.parametrize(
    ("kind", "name"),
    [(Port, "control port"), (FaultLatch, "latched-fault file"), (SystemdNotify, "systemd")],
)
def test_a_listener_that_raises_is_a_fault(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, kind: type, name: str
) -> None:
    exit_code = bench.hold(breaking(monkeypatch, kind, "handle_tick"))
    judged(bench, exit_code, f"{name} (RuntimeError: broken)")


def test_an_error_in_the_supervision_of_children_is_a_fault(bench: Bench) -> None:
    exit_code = bench.hold(lambda bench: setattr(bench, "reports", raises))
    judged(bench, exit_code, "children (RuntimeError: broken)")


def test_the_last_command_of_every_run_is_pump_off_with_the_vent_unchanged() -> None:
    """An error that nothing catches, in the middle of a hold."""
    commands: list[BenchCommand] = []

    class Recording(RoleBench):
        async def write(self, command: BenchCommand) -> None:
            commands.append(command)

    class Failing:
        def tick(self, inputs: TickInputs) -> TickOutputs:
            if len(commands) == 3:
                raise ZeroDivisionError
            row = TelemetryRow(**dict.fromkeys(FIELDS, 1.0))
            return TickOutputs(BenchCommand(0.7, 0.3), row, (), None)

    async def run() -> None:
        bench = Recording(RoleDevices(Instrument(), Instrument(), Instrument(600.0)), 0.5)
        await bench.open()
        with ExitStack() as stack:
            writer = RingWriter(stack.enter_context(open_ring(16, ROW_BYTES)))
            stack.callback(writer.close)
            wiring, clock = Wiring(bench, writer, writer), cast(RunClock, LoopClock())
            with pytest.raises(ZeroDivisionError):
                await Supervisor(cast(Controller, Failing()), wiring, clock, 10.0).run(None)
        await bench.close()

    run_virtual(run())
    assert commands == [BenchCommand(0.7, 0.3)] * 3 + [BenchCommand(0.0, 0.3)]


def test_a_thread_that_raises_is_reported(tmp_path: Path) -> None:
    """Nobody sees what a thread raises: any error is reported as a disk error is."""
    events: list[EventLine] = []
    with FaultLatch(
        LatchedFile(tmp_path), None, "run", LoopClock().utc, events.append
    ) as fault_latch:
        fault_latch._disk.submit(fault_latch._try_write, raises)
    assert events[0] == LatchFailed("broken")


def test_missed_deadlines_are_skipped_and_lateness_is_reported_in_milliseconds() -> None:
    """The third reading of a run at 10 Hz takes 0.35 s."""
    seen: list[TickInputs] = []

    class Slow(RoleBench):
        async def read(self) -> BenchReading:
            if len(seen) == 2:
                await asyncio.sleep(0.35)
            return await super().read()

    class Noting:
        def tick(self, inputs: TickInputs) -> TickOutputs:
            seen.append(inputs)
            row = TelemetryRow(**dict.fromkeys(FIELDS, 1.0))
            return TickOutputs(
                BenchCommand(0.0, 0.0), row, (), Exit.DONE if len(seen) == 6 else None
            )

    async def run() -> None:
        bench = Slow(RoleDevices(Instrument(), Instrument(), Instrument(600.0)), 0.5)
        await bench.open()
        with ExitStack() as stack:
            writer = RingWriter(stack.enter_context(open_ring(16, ROW_BYTES)))
            stack.callback(writer.close)
            wiring, clock = Wiring(bench, writer, writer), cast(RunClock, LoopClock())
            await Supervisor(cast(Controller, Noting()), wiring, clock, 10.0).run(None)
        await bench.close()

    run_virtual(run())
    assert [inputs.now_s for inputs in seen] == pytest.approx([0.1, 0.2, 0.3, 0.65, 0.7, 0.8])
    assert [inputs.lateness_ms for inputs in seen] == pytest.approx(
        [0.0, 0.0, 0.0, 250.0, 0.0, 0.0], abs=1e-6
    )
    assert [inputs.missed_ticks for inputs in seen] == [0, 0, 0, 2, 2, 2]


def test_the_reason_for_a_failing_reconnection_is_reported_once() -> None:
    """The link breaks in the third tick; then another program holds the board, and leaves it."""
    reads, opened = 0, 0

    class Taken(RoleBench):
        async def open(self) -> BenchIdentity:
            nonlocal opened
            opened += 1
            if reads and opened % 2:
                raise LinkWaitsError("not yet time")
            if reads and opened < 8:
                raise DeviceBusyError("another program holds the board")
            return await super().open()

        async def read(self) -> BenchReading:
            nonlocal reads
            reads += 1
            if reads == 3:
                raise LinkDownError("the board has gone")
            return await super().read()

    class Ending:
        def tick(self, inputs: TickInputs) -> TickOutputs:
            row = TelemetryRow(**dict.fromkeys(FIELDS, 1.0))
            return TickOutputs(BenchCommand(0.0, 0.0), row, (), Exit.DONE if reads == 5 else None)

    async def run() -> list[str]:
        bench = Taken(RoleDevices(Instrument(), Instrument(), Instrument(600.0)), 0.5)
        await bench.open()
        with ExitStack() as stack:
            address = stack.enter_context(open_ring(16, 4096))
            writer, reader = RingWriter(address), RingReader(address)
            telemetry = RingWriter(stack.enter_context(open_ring(16, ROW_BYTES)))
            for end in (writer, reader, telemetry):
                stack.callback(end.close)
            wiring, clock = Wiring(bench, telemetry, writer), cast(RunClock, LoopClock())
            await Supervisor(cast(Controller, Ending()), wiring, clock, 10.0).run(None)
            events = [json.loads(line) for line in reader.drain()]
        await bench.close()
        return [event["message"] for event in events if event["kind"] == "link"]

    assert run_virtual(run()) == [
        "the board has gone",
        "another program holds the board",
        "connected again",
    ]
