"""The Keyence DL-RS1A: frames of its manual, and driver against emulated unit with each fault."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.drivers.keyence_dl_rs1a import (
    QUALITY_AMPLIFIER_ERROR,
    QUALITY_OUT_OF_RANGE,
    KeyenceDlRs1a,
)
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import KeyenceDlRs1aConfig
from tests.support.memory_bench import run_on_bench
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import KeyenceDlRs1aEmulator, MemoryWire, SerialFaults


class Bench:
    """A unit and its driver in memory."""

    def __init__(self, amplifiers: int = 1, **settings: Any) -> None:
        self.displacement_um = -123.0
        self.emulator = KeyenceDlRs1aEmulator(lambda: self.displacement_um, amplifiers=amplifiers)
        self.wire = MemoryWire(self.emulator)
        self.driver = KeyenceDlRs1a(KeyenceDlRs1aConfig(port="memory", **settings), self.wire)


def on_bench(test: Callable[[Bench], Coroutine[Any, Any, None]], **settings: Any) -> None:
    run_on_bench(lambda: Bench(**settings), test)


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"M0\r\n", b"M0,+00.123\r\n"),
        (b"M0\r", b"M0,+00.123\r\n"),
        (b"SR,00,038\r\n", b"SR,00,038,+00.123\r\n"),
        (b"SR,00,033\r\n", b"SR,00,033,00000\r\n"),
        (b"SW,00,001,1\r\n", b"SW,00,001\r\n"),
        (b"SR,06,101\r\n", b"ER,SR,65\r\n"),
        (b"SR,00\r\n", b"ER,SR,21\r\n"),
        (b"SR,00,999\r\n", b"ER,SR,22\r\n"),
        (b"SW,00,038,1\r\n", b"ER,SW,22\r\n"),
        (b"XX\r\n", b"ER,XX,00\r\n"),
    ],
)
def test_frames(command: bytes, answer: bytes) -> None:
    async def test() -> None:
        bytes_sent: list[bytes] = []
        emulator = KeyenceDlRs1aEmulator(lambda: -123.0)
        emulator.attach(bytes_sent.append)
        emulator.receive(command)
        await asyncio.sleep(0.1)
        assert b"".join(bytes_sent) == answer

    run_virtual(test())


def test_identity_and_reading() -> None:
    async def test(bench: Bench) -> None:
        first = await bench.driver.displacement()
        assert (first.displacement_um, first.quality, first.sample_counter) == (-123.0, 0, 1)
        bench.displacement_um = -121.4
        second = await bench.driver.displacement()
        assert second.displacement_um == -121.0  # steps of 1 µm
        assert second.sample_counter == 2
        assert second.device_time_s > first.device_time_s
        assert "9600 8N1" in bench.driver.describe()["port"]

    on_bench(test)


def test_another_amplifier_of_the_unit() -> None:
    async def test(bench: Bench) -> None:
        sample = await bench.driver.displacement()
        assert sample.displacement_um == pytest.approx(-1000 * (11.0 - 10.5))

    on_bench(test, amplifiers=3, amplifier=1, zero_mm=10.5)


def test_a_zero_shift_at_the_keys_moves_nothing() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.zero_shift_mm = 0.1
        assert (await bench.driver.displacement()).displacement_um == -123.0

    on_bench(test)


@pytest.mark.parametrize(
    ("displacement_um", "quality"),
    [
        (math.nan, QUALITY_AMPLIFIER_ERROR),
        (2e5, QUALITY_OUT_OF_RANGE),
        (-2e5, QUALITY_OUT_OF_RANGE),
    ],
)
def test_what_is_no_value(displacement_um: float, quality: int) -> None:
    async def test(bench: Bench) -> None:
        bench.displacement_um = displacement_um
        sample = await bench.driver.displacement()
        assert sample.quality == quality
        assert math.isnan(sample.displacement_um)

    on_bench(test)


def test_a_jump_is_accepted_when_repeated() -> None:
    async def test(bench: Bench) -> None:
        bench.displacement_um = -100.0
        with pytest.raises(LinkError, match="jump to -100 µm"):
            await bench.driver.displacement()
        assert (await bench.driver.displacement()).displacement_um == -100.0

    on_bench(test)


@pytest.mark.parametrize(
    "faults",
    [
        SerialFaults(silent=True),
        SerialFaults(deaf=True),
        SerialFaults(delay_s=0.3),
        SerialFaults(garbage_bytes=19),
        SerialFaults(cut_bytes=2),
        SerialFaults(cut_bytes=4),
        SerialFaults(bit_errors=20),
    ],
)
def test_each_fault_is_an_error_and_passes(faults: SerialFaults) -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.faults = faults
        for _ in range(2):
            with pytest.raises(LinkError):
                await bench.driver.displacement()
        bench.emulator.faults = SerialFaults()
        assert (await bench.driver.displacement()).displacement_um == -123.0

    on_bench(test)


@pytest.mark.parametrize(
    ("settings", "error_state", "message"),
    [
        ({"amplifier": 2}, 0, "there are only 1"),
        ({"step_max_um": 0.5}, 0, "steps of 1 µm"),
        ({}, 5, "0000000000000101"),
    ],
)
def test_another_unit_is_refused(settings: dict[str, Any], error_state: int, message: str) -> None:
    async def test() -> None:
        bench = Bench(**settings)
        bench.emulator.error_state = error_state
        with pytest.raises(DeviceRefusedError, match=message):
            await bench.driver.open()

    run_virtual(test())


def test_a_pulled_plug() -> None:
    async def test(bench: Bench) -> None:
        bench.wire.unplug()
        with pytest.raises(LinkDownError):
            await bench.driver.displacement()
        bench.wire.plugged = True
        before_s = asyncio.get_running_loop().time()
        await bench.driver.open()
        await bench.driver.displacement()
        assert asyncio.get_running_loop().time() - before_s < 1.0

    on_bench(test)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"baud": 115_200}, "baud"),
        ({"amplifier": 15}, "amplifier"),
        ({"direction": 2}, "direction"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        KeyenceDlRs1aConfig(port="/dev/null", **settings)


async def test_through_the_kernel(tmp_path: Path) -> None:
    wire = PtyWire(KeyenceDlRs1aEmulator(lambda: 5.0, baud=38_400), tmp_path / "tty")
    wire.plug()
    driver = KeyenceDlRs1a(KeyenceDlRs1aConfig(port=str(wire.path), baud=38_400))
    await driver.open()
    assert (await driver.displacement()).displacement_um == 5.0
    await driver.close()
    wrong = KeyenceDlRs1a(KeyenceDlRs1aConfig(port=str(wire.path), baud=9600))
    with pytest.raises(LinkError, match=r"no answer.*set to 9600 8N1"):
        await wrong.open()
    wire.unplug()
