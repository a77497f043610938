"""The firmware on an emulated Cortex-M3: it conforms, and stops the pump when processor, code,
memory or line fail.

The emulator has no brown-out and no real time: docs/how-to/board.md has the times, and here only
the order of events counts.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from firmware_iface.conformance import examine
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.roles import BenchCommand, LinkDownError, LinkError
from tests.board.film_wire import FilmWire
from tests.board.gdb_wire import StoppedBoard, stopped
from tests.board.qemu_board import QemuBoard, addresses, built_image, qemu_board
from tests.board.still_film import StillFilm

pytestmark = [pytest.mark.campaign, pytest.mark.real_time]

_LONG_S = 10.0  # the host's watchdog period: what stops the pump earlier is the board
_PATIENCE_S = 8.0
_FOREVER = bytes.fromhex("fee7")  # b .
_STACK_POINTER = 13


@dataclass
class _Rig:
    film: StillFilm
    board: QemuBoard
    gdb: Path
    symbols: dict[str, int]

    async def running(self) -> PumpBoard:
        """A claimed board whose pump runs."""
        driver = PumpBoard(self.board.url, timeout_s=2.0, watchdog_s=_LONG_S)
        await driver.open()
        await driver.write(BenchCommand(0.5, 0.25))
        await self.film.until(lambda: (self.film.pump, self.film.vent) == (0.5, 0.25))
        return driver


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built_image(tmp_path_factory.mktemp("image"))


@pytest.fixture(scope="module")
def symbols(image: Path) -> dict[str, int]:
    return addresses(image)


@pytest.fixture
async def rig(
    request: pytest.FixtureRequest, image: Path, symbols: dict[str, int], tmp_path: Path
) -> AsyncIterator[_Rig]:
    film = StillFilm()
    wire = FilmWire(film, enable_s=getattr(request, "param", math.inf))
    await wire.start()
    gdb = tmp_path / "gdb"
    async with qemu_board(
        image, tmp_path, wire.port, "-gdb", f"unix:{gdb},server=on,wait=off"
    ) as board:
        yield _Rig(film, board, gdb, symbols)
    await wire.stop()


async def test_it_conforms(rig: _Rig) -> None:
    findings = await examine(rig.board.url, timeout_s=2.0)
    assert [(found.check, found.problem) for found in findings if found.problem] == []
    assert len(findings) == 22


async def test_sensors_arrive_and_outputs_leave(rig: _Rig) -> None:
    driver = await rig.running()
    reading = await driver.read()
    assert (reading.displacement_um, reading.gauge_pressure_pa) == (12.5, 100.0)
    assert (reading.ambient_pressure_pa, reading.air_temperature_c, reading.gas_temperature_c) == (
        101_325,
        21,
        22,
    )
    assert (reading.pump_fraction, reading.vent_fraction) == (0.5, 0.25)
    rig.film.gauge_pressure_pa = 801.0
    await rig.film.until(lambda: (rig.film.pump, rig.film.vent) == (0.0, 1.0))
    await driver.close()


async def test_a_host_that_falls_silent_within_a_frame_stops_the_pump(rig: _Rig) -> None:
    driver = PumpBoard(rig.board.url, timeout_s=2.0, watchdog_s=0.3)
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.25))
    await rig.film.until(lambda: rig.film.pump == 0.5)
    line = os.open(rig.board.rtu, os.O_WRONLY | os.O_NOCTTY)
    os.write(line, bytes.fromhex("01100038"))
    os.close(line)
    await rig.film.until(lambda: rig.film.safe)
    assert rig.film.vent == 0.25
    assert (await driver.read()).watchdog_tripped
    await driver.close()


@pytest.mark.parametrize("rig", [0.1], indirect=True)
async def test_a_stopped_emulator_drops_the_pump_s_enable(rig: _Rig) -> None:
    driver = await rig.running()
    await rig.board.monitor("stop")
    await rig.film.until(lambda: rig.film.safe)
    await rig.board.monitor("cont")
    await driver.close()


async def _freeze_main_loop(rig: _Rig, board: StoppedBoard) -> None:
    await board.write(rig.symbols["rtu_poll"], _FOREVER)


async def _freeze_interrupts(rig: _Rig, board: StoppedBoard) -> None:
    await board.write(rig.symbols["board_tick"], _FOREVER)


async def _damage_registers(rig: _Rig, board: StoppedBoard) -> None:
    (byte,) = await board.read(rig.symbols["now"] + 200, 1)
    await board.write(rig.symbols["now"] + 200, bytes([byte ^ 0x10]))


async def _overflow_stack(rig: _Rig, board: StoppedBoard) -> None:
    assert await board.register(_STACK_POINTER) > rig.symbols["main_stack_guard"], (
        "stopped within an interrupt"
    )
    await board.set_register(_STACK_POINTER, rig.symbols["main_stack_guard"] + 16)


async def _run_wild(rig: _Rig, board: StoppedBoard) -> None:
    await board.write(rig.symbols["rtu_poll"], b"\xff\xff")  # not an instruction


async def _restarted(driver: PumpBoard) -> None:
    """Read until the driver says that the board has lost its settings."""
    give_up_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < give_up_s:
        try:
            await driver.read()
        except LinkDownError:
            return
        except LinkError:
            continue  # no answer while it restarts
    raise AssertionError("the board did not restart")


@pytest.mark.parametrize(
    "damage", [_freeze_main_loop, _freeze_interrupts, _damage_registers, _overflow_stack, _run_wild]
)
async def test_a_damaged_board_stops_the_pump_and_restarts(
    rig: _Rig, damage: Callable[[_Rig, StoppedBoard], Awaitable[None]]
) -> None:
    driver = await rig.running()
    async with stopped(rig.gdb) as board:
        await damage(rig, board)
    took_s = await rig.film.until(lambda: rig.film.safe)
    print(f"{damage.__name__}: the film's wire said pump 0 after {1000 * took_s:.0f} ms")
    await rig.film.until(lambda: (rig.film.pump, rig.film.vent) == (0.0, 0.0))
    await _restarted(driver)
    await driver.open()  # as the host does then
    await driver.write(BenchCommand(0.5, 0.25))
    await rig.film.until(lambda: rig.film.pump == 0.5)
    await driver.close()
