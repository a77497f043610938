"""How many instructions the timer interrupt takes, counted by the emulator: its load, and the delay that it adds."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.board.film_wire import FilmWire
from tests.board.gdb_wire import StoppedBoard, stopped
from tests.board.qemu_board import addresses, built_image, qemu_board
from tests.board.still_film import StillFilm

pytestmark = [pytest.mark.campaign, pytest.mark.real_time]

_COUNTER = 0x4002_8018  # microseconds of the emulated clock
_SHIFT = 6  # QEMU: an instruction takes 2^6 ns, so that a microsecond has 16
_TICKS = 12  # two samples and more
_MOST = 8000  # instructions; at 25 MHz and three clocks each, the interrupt would fill its millisecond


async def _spent(board: StoppedBoard, begin: int, end: int) -> int:
    """Instructions from one address to the other, the next time that the processor comes by."""
    times_us = []
    for address in (begin, end):
        await board.run_to(address)
        times_us.append(int.from_bytes(await board.read(_COUNTER, 4), "little"))
    return round((times_us[1] - times_us[0]) * 1000 / 2**_SHIFT)


async def test_the_timer_interrupt_is_short(tmp_path: Path) -> None:
    image = built_image(tmp_path)
    symbols = addresses(image)
    wire = FilmWire(StillFilm())
    await wire.start()
    gdb = tmp_path / "gdb"
    options = ("-icount", f"shift={_SHIFT}", "-gdb", f"unix:{gdb},server=on,wait=off")
    async with qemu_board(image, tmp_path, wire.port, *options), stopped(gdb) as processor:
        to_outputs = [await _spent(processor, symbols["mps2_timer0"], symbols["hal_outputs"]) for _ in range(_TICKS)]
        whole = [await _spent(processor, symbols["mps2_timer0"], symbols["hal_watchdog_feed"]) for _ in range(_TICKS)]
    await wire.stop()
    print(f"instructions from the interrupt to the outputs: {max(to_outputs)}, to the end: {max(whole)}")
    assert 100 < max(to_outputs) <= max(whole) < _MOST
