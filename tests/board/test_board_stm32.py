"""The board on an STM32F4: its image in QEMU, and the parser of its laser against the emulated
sensor.

QEMU (netduinoplus2) has the processor, its UARTs, timers and interrupts. It has neither clock tree,
pins, DMA, watchdog nor brown-out: what depends on them was not run anywhere
(docs/how-to/board-hardware.md).
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import itertools
import math
import os
import random
import shutil
import subprocess
import sys
import tomllib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from firmware_iface import conformance, roles
from firmware_iface.board_settings import make_record
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.optoncdt1420 import encode_three_bytes
from tests.board.gdb_wire import StoppedBoard, stopped
from tests.board.qemu_board import addresses
from tests.support.machine_needs import require

PORT = Path(__file__).parents[2] / "firmware_iface" / "board" / "port_stm32f4"
NO_VALUE = -(2**31)
START_S = 30.0
PWM_STEPS = 4200
CCR1, CCR2 = 0x40000434, 0x40000438


def make(folder: Path, *targets: str) -> list[Path]:
    """Build targets of the port's Makefile in a folder."""
    require("make", "arm-none-eabi-gcc", "qemu-system-arm")
    paths = [folder / target for target in targets]
    words = ["make", "--silent", "-C", PORT, f"OUT={folder}", f"PYTHON={sys.executable}", *paths]
    subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True)
    return paths


@dataclass
class Stm32:
    """The image running; `line` is its Modbus, `log` what it wrote to hardware that QEMU does not
    have.
    """

    url: str
    log: Path
    laser: asyncio.StreamWriter
    monitor_in: asyncio.StreamReader
    monitor_out: asyncio.StreamWriter

    async def word(self, address: int) -> int:
        """A register, read by QEMU."""
        self.monitor_out.write(f"xp /1wx {address:#x}\n".encode())
        wanted = f"{address:016x}: 0x".encode()
        heard = b""
        while wanted not in heard or not heard.endswith(b"(qemu) "):
            heard += await asyncio.wait_for(self.monitor_in.read(4096), START_S)
        return int(heard.partition(wanted)[2][:8], 16)

    async def drives(self, pump: int, vent: int) -> None:
        """Wait until the outputs have these compare values: they follow with the next tick of a
        busy emulator.
        """
        async with asyncio.timeout(START_S):
            while (await self.word(CCR1), await self.word(CCR2)) != (pump, vent):  # noqa: ASYNC110
                await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def stm32(folder: Path) -> AsyncIterator[Stm32]:
    """Build the image for QEMU, start it, end it afterwards.

    Its settings are those of the port, without the gauge: QEMU has no converter that could read
    one.
    """
    image, settings = make(folder, "stm32f4-qemu.bin", "settings.bin")
    table = tomllib.loads((PORT / "board.toml").read_text(encoding="utf-8"))
    settings.write_bytes(make_record({**table, "gauge_fitted": False}))
    lasers: asyncio.Queue[asyncio.StreamWriter] = asyncio.Queue()
    server = await asyncio.start_server(lambda _, writer: lasers.put_nowait(writer), "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    words = [
        "qemu-system-arm",
        "-M",
        "netduinoplus2",
        "-display",
        "none",
        "-kernel",
        image,
        "-device",
        f"loader,file={settings},addr=0x0800C000,force-raw=on",
        "-serial",
        f"tcp:127.0.0.1:{port}",
        "-serial",
        "pty",
        "-gdb",
        f"unix:{folder}/gdb,server=on,wait=off",
        "-d",
        "unimp,guest_errors",
        "-D",
        folder / "log",
        "-monitor",
        f"unix:{folder}/monitor,server=on,wait=off",
    ]
    process = await asyncio.create_subprocess_exec(
        *map(str, words), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    try:
        assert process.stdout is not None
        output = (await asyncio.wait_for(process.stdout.readline(), START_S)).decode()
        line = next(word for word in output.split() if word.startswith("/dev/"))
        kept = os.open(
            line, os.O_RDWR | os.O_NOCTTY
        )  # QEMU takes a second to notice a new client, and loses answers
        laser = await asyncio.wait_for(lasers.get(), START_S)
        monitor = await asyncio.open_unix_connection(folder / "monitor")
        yield Stm32(f"rtu://{line}?baud=115200&parity=N", folder / "log", laser, *monitor)
        monitor[1].close()
        laser.close()
        os.close(kept)
    finally:
        process.terminate()
        await asyncio.wait_for(process.communicate(), START_S)
        server.close()
        await server.wait_closed()


def written(log: Path) -> list[tuple[str, int, int]]:
    """Writes to hardware that QEMU does not have, in order: device, offset, value."""
    found = []
    for line in log.read_text(errors="replace").splitlines():
        device, mark, rest = line.partition(": unimplemented device write (size 4, offset ")
        if mark:
            offset, _, value = rest.rstrip(")").partition(", value ")
            found.append((device, int(offset, 16), int(value, 16)))
    return found


def frames(displacement_raw: int, first: int, count: int) -> bytes:
    """What the sensor streams: distance and counter, six bytes a value."""
    return b"".join(
        encode_three_bytes(displacement_raw, first=True)
        + encode_three_bytes((first + n) % 2**18, first=False)
        for n in range(count)
    )


@pytest.mark.real_time
async def test_the_image_starts_safe_answers_and_drives_its_outputs(tmp_path: Path) -> None:
    async with stm32(tmp_path) as board:
        driver = PumpBoard(board.url, timeout_s=4.0, watchdog_s=10.0)
        identity = await driver.identify()
        assert (identity.map_version, identity.firmware, identity.gauge_fitted) == (
            3,
            "1.1.0",
            False,
        )
        assert identity.gauge_pressure_limit_pa == 800.0
        reading = await driver.read()
        assert (await board.word(CCR1), await board.word(CCR2)) == (0, 0)
        assert reading.pump_fraction == reading.vent_fraction == 0.0
        assert not reading.watchdog_tripped
        assert math.isnan(
            reading.gauge_pressure_pa
        )  # no DMA in QEMU: never an old or invented value
        assert math.isnan(reading.displacement_um)
        assert reading.displacement_quality != 0
        assert reading.interlock_inputs == 0  # no pins in QEMU: open
        await driver.open()
        board.laser.write(frames(32_760, 1, 100))
        await driver.write(roles.BenchCommand(0.25, 1.0))
        await board.drives(PWM_STEPS // 4, PWM_STEPS)
        await driver.write(roles.BenchCommand(0.0, 0.0))
        await board.drives(0, 0)
        await driver.close()
    first = written(board.log)
    assert [each[:2] for each in first[:4]] == [
        ("RCC", 0x30),
        ("GPIOA", 0x18),
        ("GPIOB", 0x18),
        ("GPIOA", 0x00),
    ]
    assert (
        first[1][2] == 0x01C0_0000
    )  # pump, vent and the line's driver low before they become outputs
    assert first[2][2] == 0x0020_0000  # the enable as well
    enable = [value for device, offset, value in first[5:] if (device, offset) == ("GPIOB", 0x18)]
    assert set(enable) == {0x20, 0x20_0000}
    assert all(one != other for one, other in itertools.pairwise(enable))  # a square wave, no level


@pytest.mark.real_time
async def test_the_laser_reaches_the_host(tmp_path: Path) -> None:
    async with stm32(tmp_path) as board:
        driver = PumpBoard(board.url, timeout_s=4.0, watchdog_s=10.0)
        await driver.identify()
        counter = 1
        reading = await driver.read()
        for _ in range(200):
            board.laser.write(frames(32_760, counter, 10))
            counter += 10
            await asyncio.sleep(0.02)
            reading = await driver.read()
            if reading.displacement_quality == 0:
                break
        assert reading.displacement_um == pytest.approx(0.0, abs=1.0)  # the middle of the range
        board.laser.write(frames(262_076, counter, 10))  # no peak
        for _ in range(200):
            reading = await driver.read()
            if reading.displacement_quality == 4:
                break
        assert math.isnan(reading.displacement_um)
        await driver.close()


@pytest.mark.campaign
async def test_the_image_conforms(tmp_path: Path) -> None:
    async with stm32(tmp_path) as board:
        findings = await conformance.examine(board.url, 1, 4.0)
        assert [each for each in findings if each.problem] == []
        assert len(findings) > 15


async def _damage_memory(board: StoppedBoard, at: dict[str, int]) -> None:
    (byte,) = await board.read(at["now"] + 200, 1)
    await board.write(at["now"] + 200, bytes([byte ^ 0x10]))


async def _overflow_the_stack(board: StoppedBoard, at: dict[str, int]) -> None:
    assert await board.register(13) > at["main_stack_guard"], "stopped within an interrupt"
    await board.set_register(13, at["main_stack_guard"] + 16)


async def _run_wild(board: StoppedBoard, at: dict[str, int]) -> None:
    await board.write(at["rtu_poll"], bytes.fromhex("ffff"))  # not an instruction


@pytest.mark.campaign
@pytest.mark.parametrize("damage", [_damage_memory, _overflow_the_stack, _run_wild])
async def test_a_damaged_board_drives_its_outputs_low_and_restarts(
    tmp_path: Path, damage: Callable[[StoppedBoard, dict[str, int]], Awaitable[None]]
) -> None:
    """As far as QEMU goes: what only the hardware watchdog ends, such as a stuck tick,
    is not here.
    """
    async with stm32(tmp_path) as board:
        driver = PumpBoard(board.url, timeout_s=4.0, watchdog_s=10.0)
        await driver.open()
        await driver.write(roles.BenchCommand(0.25, 1.0))
        await board.drives(PWM_STEPS // 4, PWM_STEPS)
        async with stopped(tmp_path / "gdb") as processor:
            await damage(processor, addresses(tmp_path / "stm32f4-qemu.elf"))
        await board.drives(0, 0)
        async with asyncio.timeout(START_S):
            while [each[:2] for each in written(board.log)].count(("RCC", 0x30)) < 2:  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        await driver.close()
    wrote = written(board.log)
    start = [each[:2] for each in wrote].index(("RCC", 0x30), 1)
    assert ("GPIOB", 0x18, 0x20_0000) in wrote[
        start - 4 : start
    ]  # low before the reset, not only by it
    assert ("GPIOA", 0x18, 0x01C0_0000) in wrote[start - 4 : start]


@pytest.mark.campaign
async def test_a_main_loop_that_hangs_stops_the_pump(tmp_path: Path) -> None:
    """The vent stays as it was; on silicon the watchdog, no longer fed, then resets the board."""
    async with stm32(tmp_path) as board:
        driver = PumpBoard(board.url, timeout_s=4.0, watchdog_s=10.0)
        await driver.open()
        await driver.write(roles.BenchCommand(0.25, 1.0))
        await board.drives(PWM_STEPS // 4, PWM_STEPS)
        async with stopped(tmp_path / "gdb") as processor:
            await processor.write(
                addresses(tmp_path / "stm32f4-qemu.elf")["rtu_poll"], bytes.fromhex("fee7")
            )  # b .
        await board.drives(0, PWM_STEPS)
        await driver.close()


HOST = """
#include "hal.h"
uint32_t hal_lock(void) { return 0u; }
void hal_unlock(uint32_t before) { (void)before; }
"""


@pytest.fixture(scope="module")
def laser_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """laser.c for this machine."""
    require("cc")
    folder = tmp_path_factory.mktemp("laser")
    (folder / "host.c").write_text(HOST)
    words = [
        "cc",
        "-shared",
        "-fPIC",
        "-O1",
        f"-I{PORT.parent / 'core'}",
        f"-I{PORT}",
        f"-I{PORT.parent / 'port_cortex_m'}",
        "-Wno-int-to-pointer-cast",
    ]
    subprocess.run(
        [*words, "-o", str(folder / "laser.so"), str(PORT / "laser.c"), str(folder / "host.c")],
        check=True,
    )
    return folder / "laser.so"


class Laser:
    """A fresh copy of the parser, whose state is static."""

    def __init__(self, library: Path, folder: Path) -> None:
        copy = folder / "laser.so"
        shutil.copy(library, copy)
        self._c = ctypes.CDLL(str(copy))
        self.now_us = 0

    def take(self, data: bytes) -> None:
        for byte in data:
            self._c.laser_take(byte, self.now_us)

    def sample(self, after_us: int = 5000) -> tuple[int, int]:
        self.now_us += after_us
        return self._c.laser_displacement(self.now_us), self._c.laser_quality()


@pytest.fixture
def laser(laser_library: Path, tmp_path: Path) -> Laser:
    return Laser(laser_library, tmp_path)


def test_values_are_averaged_between_samples(laser: Laser) -> None:
    assert laser.sample() == (NO_VALUE, 1)
    laser.take(frames(1000, 5, 1))  # the first counter has none before it
    assert laser.sample() == (NO_VALUE, 1)
    laser.take(frames(1000, 6, 1) + frames(1001, 7, 1))
    assert laser.sample() == (16_008, 0)
    assert laser.sample() == (16_008, 0)  # not yet late
    assert laser.sample(101_000) == (NO_VALUE, 1)


def test_the_counter_wraps(laser: Laser) -> None:
    laser.take(frames(65_520, 2**18 - 2, 2))
    assert laser.sample() == (16 * 65_520, 0)
    laser.take(frames(400, 0, 1))
    assert laser.sample() == (16 * 400, 0)


def test_no_peak_is_an_error_code_and_no_value(laser: Laser) -> None:
    laser.take(frames(1000, 1, 3) + frames(262_076, 4, 1))
    assert laser.sample() == (NO_VALUE, 4)
    laser.take(frames(1000, 5, 1))
    assert laser.sample() == (16_000, 0)


@pytest.mark.parametrize("seed", range(5))
def test_lost_bytes_give_no_false_value(laser: Laser, seed: int) -> None:
    """A hundred thousand bytes of a ramp, one in fifty lost: what is taken is what was sent."""
    chosen = random.Random(seed)
    taken = 0
    for counter in range(1, 17_000):
        raw = counter % 60_000
        laser.take(bytes(byte for byte in frames(raw, counter, 1) if chosen.randrange(50)))
        value, quality = laser.sample(2000)
        if quality == 0:
            taken += 1
            assert abs(value - 16 * raw) <= 16 * 50  # the newest good one, at most 100 ms old
    assert taken > 14_000


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_rarely_a_value(laser: Laser, seed: int) -> None:
    laser.take(random.Random(seed).randbytes(100_000))
    assert laser.sample() == (NO_VALUE, 1)
