"""Links that are slow, refuse or cut their answers: the fault names the link, not laser or machine.

Supervisor, controller, driver and link are those of a hold; the line is memory and time is virtual.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import cast

import pytest

from firmware_iface import roles
from firmware_iface.drivers.keyence_dl_rs1a import KeyenceDlRs1a
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.links.modbus_rtu import RtuBus
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.role_bench import RoleBench, RoleDevices
from firmware_iface.settings import KeyenceDlRs1aConfig
from membrane_ctrl.config.schema import Config, ShapeConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.hold.supervisor import Supervisor, Wiring
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.event_base import Event
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.run_events import Link, SensorLink
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.support.virtual_time import run_virtual, stand_still
from tests.worlds.faulty_devices import KeyenceDlRs1aEmulator, MemoryWire, RtuBusEmulator

CONFIG = Config(
    twin=TwinConfig(seed=1, scenario="calm", start_error_um=-5.0),
    shape=ShapeConfig(enabled=False),
)
BEFORE_S, AFTER_S = 5.0, 6.0
LATE_S = 0.35


class LoopClock:
    """A `RunClock` that reads the event loop's time."""

    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def utc(self, mono_s: float) -> datetime:
        return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=mono_s)


class BoardOnALine:
    """The twin's board as the slave of a serial bus; its time is the loop's."""

    def __init__(self, timeout_s: float, watchdog_s: float) -> None:
        self.virtual = VirtualBench(Plant(CONFIG.twin, CONFIG.pump), watchdog_s)
        self._at_s = 0.0
        self.bus = RtuBusEmulator(SerialSettings(115_200), {1: self._respond})
        self.wire = MemoryWire(self.bus)
        link = RtuBus(self.wire, quiet_s=0.05).device(1, timeout_s)
        self.bench = PumpBoard("", watchdog_s=watchdog_s, link=link)

    def _respond(self, pdu: bytes) -> bytes:
        now_s = asyncio.get_running_loop().time()
        self.virtual.advance(now_s - self._at_s)
        self._at_s = now_s
        reply = answer_request(pdu, self.virtual.board)
        self.virtual.drive_actuators()
        return reply


@dataclass
class Run:
    """What a run reported after its line got the fault."""

    events: list[Event] = field(default_factory=list)

    @property
    def faults(self) -> list[Fault]:
        return [event for event in self.events if isinstance(event, Fault)]

    @property
    def links(self) -> list[Link | SensorLink]:
        return [event for event in self.events if isinstance(event, Link | SensorLink)]


async def hold(
    bench: roles.Bench,
    spoil: Callable[[], None],
    before_s: float = BEFORE_S,
    after_s: float = AFTER_S,
) -> Run:
    """Run a hold, spoil its line, and return what followed."""
    run = Run()
    await bench.open()
    controller = Controller(CONFIG, zernike_projection())
    supervisor = Supervisor(controller, Wiring(bench), cast(RunClock, LoopClock()), 50.0)
    supervisor.record_event = run.events.append  # type: ignore[method-assign]
    supervisor.queue_command(Command("hold", "test"))
    task = asyncio.create_task(supervisor.run(None))
    await asyncio.sleep(before_s)
    assert not run.faults
    run.events.clear()
    spoil()
    await asyncio.sleep(after_s)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await bench.close()
    return run


def hold_board(
    spoil: Callable[[BoardOnALine], None],
    timeout_s: float = 0.2,
    watchdog_s: float = 0.5,
    before_s: float = BEFORE_S,
    after_s: float = AFTER_S,
) -> Run:
    async def run() -> Run:
        board = BoardOnALine(timeout_s, watchdog_s)
        return await hold(board.bench, partial(spoil, board), before_s, after_s)

    return run_virtual(run())


def be_late(board: BoardOnALine) -> None:
    board.bus.faults.delay_s = LATE_S


def test_late_replies_that_are_awaited_are_a_slow_link() -> None:
    """Not `late`: it is not this machine."""
    run = hold_board(be_late, timeout_s=0.5, watchdog_s=5.0)
    assert [fault.name for fault in run.faults] == ["link_slow"]
    assert "this machine is not the cause" in run.faults[0].remedy
    assert "of waiting for the device" in run.faults[0].seen


def test_late_replies_keep_the_sensors_from_being_checked() -> None:
    run = hold_board(be_late, timeout_s=0.5, watchdog_s=5.0, before_s=0.2, after_s=20.0)
    assert [fault.name for fault in run.faults] == ["overdue"]
    assert "ms of waiting for the device" in run.faults[0].seen


def test_a_watchdog_that_late_replies_starve_is_the_links_fault() -> None:
    run = hold_board(be_late, timeout_s=0.5)
    assert run.faults[0].name == "watchdog_by_link"


def test_a_stopped_program_is_not_a_slow_link() -> None:
    """The process does not run for a while, in the middle of an exchange as well."""

    def stop_now_and_then(board: BoardOnALine) -> None:
        answer = board.bus.answer

        def answer_after_a_stop(unit: int, pdu: bytes) -> bytes:
            stand_still(0.4)
            return answer(unit, pdu)

        board.bus.answer = answer_after_a_stop  # type: ignore[method-assign]

    run = hold_board(stop_now_and_then, timeout_s=5.0, watchdog_s=5.0)
    assert [fault.name for fault in run.faults] == ["late"]


def test_replies_after_the_time_out_are_named_with_their_delay() -> None:
    run = hold_board(be_late)
    assert run.faults[0].name in ("no_answer", "device_silent")
    assert "answers come late, the last one 0.3" in run.faults[-1].seen
    assert any("answers come late, the last one 0.3" in event.message for event in run.links)


@pytest.mark.parametrize("code", [10, 11])
def test_a_gateways_exception_is_not_the_lasers_fault(code: int) -> None:
    def refuse(board: BoardOnALine) -> None:
        board.bus.exception_code = code

    run = hold_board(refuse)
    names = [fault.name for fault in run.faults]
    assert names == ["no_answer", "device_silent"]
    assert f"exception {code}" in run.faults[0].seen
    assert "gateway" in run.faults[0].seen
    assert "laser's aim" not in run.faults[0].remedy


def test_failures_are_counted_not_listed() -> None:
    def refuse(board: BoardOnALine) -> None:
        board.bus.exception_code = 11

    run = hold_board(refuse)
    assert len(run.links) < 12
    counted = sum(event.count or 1 for event in run.links)
    assert counted > 4 * len(run.links)
    assert run.links[0].count is None


def test_a_link_that_recovers_is_reported_once_and_can_fail_again() -> None:
    def refuse_twice(board: BoardOnALine) -> None:
        board.bus.exception_code = 4
        loop = asyncio.get_running_loop()
        loop.call_later(0.1, setattr, board.bus, "exception_code", 0)
        loop.call_later(AFTER_S - 0.1, setattr, board.bus, "exception_code", 4)

    run = hold_board(refuse_twice)
    ups = [event.up for event in run.links]
    assert ups.count(True) == 1
    assert (ups[0], ups[-1]) == (False, False)


class MirrorWithAPump:
    """The twin's mirror: its pump and its gauge, which always answer, and what a laser sees."""

    def __init__(self) -> None:
        self._plant = Plant(CONFIG.twin, CONFIG.pump)
        self._fraction = self._at_s = 0.0

    def _advance(self) -> Plant:
        now_s = asyncio.get_running_loop().time()
        self._plant.advance(now_s - self._at_s)
        self._at_s = now_s
        return self._plant

    def displacement_um(self) -> float:
        plant = self._advance()
        return plant.sample_of(plant.truth()).displacement_um

    async def open(self) -> roles.DeviceIdentity:
        return roles.DeviceIdentity("mirror", "", "")

    async def close(self) -> None:
        pass

    def describe(self) -> dict[str, str]:
        return {}

    async def set_pump(self, fraction: float) -> None:
        self._advance().actuate(fraction, 0.0)
        self._fraction = fraction

    async def pump_fraction(self) -> float:
        return self._fraction

    async def gauge_pressure_pa(self) -> float:
        plant = self._advance()
        return plant.sample_of(plant.truth()).gauge_pressure_pa


def hold_keyence(spoil: Callable[[KeyenceDlRs1aEmulator], None], timeout_s: float) -> Run:
    """Hold with a laser on a serial line of its own."""

    async def run() -> Run:
        mirror = MirrorWithAPump()
        emulator = KeyenceDlRs1aEmulator(mirror.displacement_um, baud=38_400)
        settings = KeyenceDlRs1aConfig(
            driver="keyence_dl_rs1a", port="/memory", baud=38_400, timeout_s=timeout_s
        )
        laser = KeyenceDlRs1a(settings, MemoryWire(emulator))
        clock = asyncio.get_running_loop().time
        bench = RoleBench(RoleDevices(laser, mirror, mirror), 5.0, clock)
        return await hold(bench, partial(spoil, emulator))

    return run_virtual(run())


def test_a_silent_laser_is_not_a_laser_without_a_target() -> None:
    def fall_silent(emulator: KeyenceDlRs1aEmulator) -> None:
        emulator.faults.silent = True

    run = hold_keyence(fall_silent, timeout_s=0.02)
    assert run.faults[0].name == "no_answer"
    assert "no answer within 0.02 s" in run.faults[0].seen
    assert {event.role for event in run.links if isinstance(event, SensorLink)} == {"displacement"}
    assert len(run.links) < 10


def test_a_laser_that_answers_late_is_named_as_the_device_that_is_waited_for() -> None:
    def be_late(emulator: KeyenceDlRs1aEmulator) -> None:
        emulator.faults.delay_s = LATE_S

    run = hold_keyence(be_late, timeout_s=0.5)
    assert run.faults[0].name == "link_slow"
    assert "waiting for displacement" in run.faults[0].seen
