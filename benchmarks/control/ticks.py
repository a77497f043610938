"""Reading and commanding the pump board tick by tick: how late ticks begin, and how long one takes.

The reference for lateness is a bare asyncio loop of the same rate, measured just before. Modbus RTU
is paced as a line of 115200 baud. Board, line and driver share one process, so the figures include
their cost.
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

import numpy as np

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.emulators.pump_board import BoardSample
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import BenchCommand
from tests.support.figures import Figure, at_most
from tests.worlds.faulty_board import PumpBoardEmulator
from tests.worlds.faulty_devices import RtuBusEmulator

DURATION_S = 30.0
TCP_HZ, RTU_HZ = 50.0, 25.0
BAUD = 115_200


class _StillPlant:
    """Always the same."""

    def sample(self) -> BoardSample:
        return BoardSample(
            0.0, 0, 600.0, 101_325.0, 20.0, 20.0, round(time.monotonic() * 200), time.monotonic()
        )

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Nothing moves."""


async def _nothing() -> None:
    """The tick of a bare loop."""


async def lateness_ms(
    rate_hz: float, duration_s: float, tick: Callable[[], Awaitable[None]]
) -> tuple[float, float]:
    """p99 of how late a tick begins, and of how long it takes, both in ms."""
    deadline_s, late_ms, took_ms = time.monotonic(), [], []
    for _ in range(round(rate_hz * duration_s)):
        deadline_s += 1 / rate_hz
        await asyncio.sleep(max(0.0, deadline_s - time.monotonic()))
        begin_s = time.monotonic()
        await tick()
        late_ms.append(1e3 * (begin_s - deadline_s))
        took_ms.append(1e3 * (time.monotonic() - begin_s))
    return float(np.percentile(late_ms, 99)), float(np.percentile(took_ms, 99))


async def _board(url: str, rate_hz: float, duration_s: float) -> tuple[float, float]:
    driver = PumpBoard(url)
    await driver.open()

    async def tick() -> None:
        await driver.read()
        await driver.write(BenchCommand(0.1, 0.0))

    try:
        return await lateness_ms(rate_hz, duration_s, tick)
    finally:
        await driver.close()


async def _measure(duration_s: float) -> list[Figure]:
    emulator = PumpBoardEmulator(_StillPlant(), port=0)
    await emulator.start()
    bus = RtuBusEmulator(
        SerialSettings(BAUD, parity="E"), {1: partial(answer_request, table=emulator.state)}
    )
    figures = []
    with tempfile.TemporaryDirectory() as folder:
        wire = PtyWire(bus, Path(folder) / "tty")
        wire.plug()
        urls = {
            "Modbus TCP": (f"tcp://127.0.0.1:{emulator.port}", TCP_HZ),
            "Modbus RTU": (f"rtu://{wire.path}?baud={BAUD}&parity=E", RTU_HZ),
        }
        for name, (url, rate_hz) in urls.items():
            bare_ms, _ = await lateness_ms(rate_hz, duration_s, _nothing)
            late_ms, took_ms = await _board(url, rate_hz, duration_s)
            what = f"{name}, {rate_hz:g} Hz"
            figures += [
                at_most(
                    f"{what}: tick lateness p99", late_ms, "ms", 5.0, "bare asyncio loop", bare_ms
                ),
                at_most(f"{what}: read and write p99", took_ms, "ms", None, "tick", 1e3 / rate_hz),
            ]
        wire.unplug()
    await emulator.stop()
    return figures


def run(duration_s: float = DURATION_S) -> list[Figure]:
    """Figures of both links."""
    return asyncio.run(_measure(duration_s))
