"""The far end of a simulated board's film wire (board/port_bench/bench_line.h): a plant in place of
transducers.
"""

from __future__ import annotations

import asyncio
import math

from firmware_iface.board_settings import CHANNELS
from firmware_iface.emulators.pump_board import BoardPlant
from firmware_iface.register_map import load_default_map
from tests.board.virtual_board import NO_VALUE

_PERIOD_S = 0.01  # the age that a sample may have


class FilmWire:
    """Listens for one board. The pump's enable drops out when the board has not renewed it for
    `enable_s`.
    """

    def __init__(self, plant: BoardPlant, enable_s: float = 0.1) -> None:
        self._plant = plant
        self._enable_s = enable_s
        self._server: asyncio.Server | None = None
        self._task: asyncio.Task[None] | None = None
        self._said_s = -math.inf
        self._outputs = (0.0, 0.0)
        self.port = 0

    async def start(self) -> None:
        """Listen on any free port of localhost."""
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Hang up."""
        assert self._server is not None
        self._server.close()
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._task = asyncio.current_task()
        sender = asyncio.create_task(self._send(writer))
        try:
            while line := await reader.readline():
                self._heard(line.decode("ascii").split())
        except ConnectionError:
            pass  # the emulator ended
        finally:
            sender.cancel()
            writer.close()

    async def _send(self, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write(sample_line(self._plant).encode())
            await asyncio.sleep(_PERIOD_S)
            if asyncio.get_running_loop().time() - self._said_s > self._enable_s:
                self._drive(0.0, self._outputs[1])

    def _heard(self, words: list[str]) -> None:
        if len(words) == 3 and words[0] == "O":
            self._said_s = asyncio.get_running_loop().time()
            self._drive(int(words[1]) / 50_000, int(words[2]) / 50_000)

    def _drive(self, pump: float, vent: float) -> None:
        if (pump, vent) != self._outputs:
            self._outputs = pump, vent
            self._plant.actuate(pump, vent)


def sample_line(plant: BoardPlant) -> str:
    """The newest sample as the wire carries it: counts of the registers."""
    sample = plant.sample()
    registers = load_default_map()
    counts = [
        _counts(getattr(sample, name), registers.register(name).counts_per_unit)
        for name in CHANNELS
    ]
    return (
        f"I {' '.join(map(str, counts))} {sample.displacement_quality} {sample.interlock_inputs}\n"
    )


def _counts(value: float, counts_per_unit: int) -> int:
    return NO_VALUE if math.isnan(value) else round(value * counts_per_unit)
