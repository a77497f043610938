"""The twin's film in real time behind one of two boards: `python -m tests.board.film_bench
qemu|python FOLDER`.

Prints the board's URL, runs until it is stopped, then writes the true displacement to
FOLDER/truth.txt, one line a sample. `qemu`: the C firmware on an emulated Cortex-M3; `python`: the
Python emulator. Both speak Modbus RTU.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path

from firmware_iface.emulators.pump_board import PumpBoardEmulator
from firmware_iface.emulators.rtu_bus import RtuBusEmulator
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.serial_port import SerialSettings
from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.sim.bench import BenchSpec, LiveBench
from membrane_ctrl.sim.truth import Truth
from tests.board.film_wire import FilmWire
from tests.board.qemu_board import built_image, qemu_board

_PERIOD_S = 0.004


@contextlib.asynccontextmanager
async def _python_board(plant: LiveBench, folder: Path) -> AsyncIterator[str]:
    board = PumpBoardEmulator(plant)
    await board.start()
    line = RtuBusEmulator(SerialSettings(115_200, 8, "N"), {1: lambda pdu: board.answer(pdu).pdu})
    wire = PtyWire(line, folder / "tty")
    wire.plug()
    yield f"rtu://{wire.path}?baud=115200&parity=N"
    wire.unplug()
    await board.stop()


@contextlib.asynccontextmanager
async def _qemu_board(plant: LiveBench, folder: Path) -> AsyncIterator[str]:
    film = FilmWire(plant)
    await film.start()
    async with qemu_board(built_image(folder), folder, film.port) as board:
        yield board.url
    await film.stop()


class _Truths(list[str]):
    """Takes what the bench would publish to its ring: time and displacement."""

    def put(self, packed: bytes) -> None:
        truth = Truth.unpack(packed)
        self.append(f"{truth.time_s:.3f} {truth.displacement_um:.4f}\n")


async def main(kind: str, folder: Path) -> None:
    """Serve until SIGTERM."""
    stopped = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stopped.set)
    truths = _Truths()
    bench = LiveBench(BenchSpec(TwinConfig(seed=5), PumpConfig(), RunClock.start(), port=0), truths)
    board = _python_board if kind == "python" else _qemu_board
    async with board(bench, folder) as url:
        print(url, flush=True)
        while not stopped.is_set():
            bench.catch_up()
            await asyncio.sleep(_PERIOD_S)
    (folder / "truth.txt").write_text("".join(truths))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], Path(sys.argv[2])))
