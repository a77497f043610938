"""How many instructions the timer interrupt takes until the outputs are set, counted step by step
in the emulator.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from firmware_iface.drivers.pump_board import PumpBoard
from tests.board.film_wire import FilmWire
from tests.board.gdb_wire import StoppedBoard, stopped
from tests.board.qemu_board import addresses, built_image, qemu_board
from tests.board.still_film import StillFilm

pytestmark = [pytest.mark.campaign, pytest.mark.real_time]

_TICKS = 3  # while we step, time passes: each of them samples the sensors
_MOST = 3000  # instructions; with two clocks each at 25 MHz they take a quarter of the millisecond
_PROGRAM_COUNTER = 15


async def _steps(board: StoppedBoard, begin: int, end: int) -> int:
    """Instructions from one address to the other, the next time that the processor comes by."""
    await board.run_to(begin)
    count = 0
    while await board.register(_PROGRAM_COUNTER) != end:
        await board.step()
        count += 1
    return count


async def test_the_timer_interrupt_is_short(tmp_path: Path) -> None:
    image = built_image(tmp_path)
    symbols = addresses(image)
    wire = FilmWire(StillFilm())
    await wire.start()
    gdb = tmp_path / "gdb"
    async with qemu_board(
        image, tmp_path, wire.port, "-gdb", f"unix:{gdb},server=on,wait=off"
    ) as board:
        driver = PumpBoard(board.url, timeout_s=2.0, watchdog_s=10.0)
        await driver.open()
        while math.isnan((await driver.read()).gauge_pressure_pa):
            continue  # a channel without a value takes less
        await driver.close()
        async with stopped(gdb) as chip:
            counts = [
                await _steps(chip, symbols["mps2_timer0"], symbols["hal_watchdog_feed"])
                for _ in range(_TICKS)
            ]
    await wire.stop()
    print(f"instructions from the interrupt until the outputs are set: {counts}")
    assert 500 < max(counts) < _MOST
