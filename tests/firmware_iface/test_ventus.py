"""The Ventus pump: driver against emulated driver board; whatever is commanded is read back."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.drivers.ventus import Ventus
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import VentusConfig
from tests.support.memory_bench import run_on_bench
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import MemoryWire, SerialFaults, VentusEmulator


class Bench:
    """A pump and its driver in memory."""

    def __init__(self, streaming: bool = False, **settings: Any) -> None:
        self.driven: list[float] = []
        self.emulator = VentusEmulator(self.driven.append, streaming=streaming)
        self.wire = MemoryWire(self.emulator)
        self.driver = Ventus(VentusConfig(port="memory", **settings), self.wire)


def on_bench(test: Callable[[Bench], Coroutine[Any, Any, None]], **settings: Any) -> None:
    run_on_bench(lambda: Bench(**settings), test)


def test_frames() -> None:
    async def test() -> None:
        bytes_sent: list[bytes] = []
        emulator = VentusEmulator(lambda fraction: None)
        emulator.attach(bytes_sent.append)
        emulator.receive(b"#W23,123.456\n#R23\n#R37\n#X\n#R99\n#W31,5\n#R31\n")
        await asyncio.sleep(0.1)
        assert b"".join(bytes_sent) == b"#R23,123.456\n#R37,3\n#R31,0\n"

    run_virtual(test())


@pytest.mark.parametrize("streaming", [False, True])
def test_it_is_stopped_and_set_when_opened(streaming: bool) -> None:
    async def test() -> None:
        bench = Bench(streaming=streaming)
        bench.emulator.registers.update({11: 0.0, 23: 800.0})  # it runs when we come
        identity = await bench.driver.open()
        assert (identity.kind, identity.firmware) == ("Ventus smart pump module", "2.7")
        assert bench.driven[0] == 0.8
        assert bench.driven[-1] == 0.0
        assert bench.emulator.registers[0] == 0.0
        assert bench.emulator.registers[2] == 0.0
        await bench.driver.close()

    run_virtual(test())


def test_commands_are_read_back() -> None:
    async def test(bench: Bench) -> None:
        for fraction in (0.25, 1.0, 0.123_456_7, 0.0):
            await bench.driver.set_pump(fraction)
            assert bench.driven[-1] == pytest.approx(fraction, abs=1e-6)
            assert await bench.driver.pump_fraction() == pytest.approx(fraction, abs=1e-6)

    on_bench(test)


def test_full_drive_is_the_configured_power() -> None:
    async def test(bench: Bench) -> None:
        await bench.driver.set_pump(0.5)
        assert bench.emulator.registers[23] == 300.0
        assert bench.emulator.registers[1] == 600.0

    on_bench(test, power_max_mw=600.0)


@pytest.mark.parametrize("fraction", [-0.1, 1.1, float("nan")])
def test_what_is_no_fraction_is_not_sent(fraction: float) -> None:
    async def test(bench: Bench) -> None:
        with pytest.raises(ValueError, match="not within"):
            await bench.driver.set_pump(fraction)
        assert bench.driven[-1] == 0.0

    on_bench(test)


def test_closing_stops_the_pump() -> None:
    async def test(bench: Bench) -> None:
        await bench.driver.set_pump(0.5)
        await bench.driver.close()
        assert bench.driven[-1] == 0.0

    on_bench(test)


def test_a_power_cycle_is_seen_and_healed() -> None:
    async def test(bench: Bench) -> None:
        await bench.driver.set_pump(0.5)
        bench.emulator.power_cycle()  # enabled at what an analogue input says
        with pytest.raises(
            LinkDownError, match=r"commanded 500\.000 mW, the pump has 250 mW.*restarted"
        ):
            await bench.driver.pump_fraction()
        await bench.driver.open()
        await bench.driver.set_pump(0.5)
        assert await bench.driver.pump_fraction() == 0.5

    on_bench(test)


@pytest.mark.parametrize(
    ("register", "value"), [(1, 1.0), (10, 1.0), (11, 3.0), (0, 0.0), (23, 900.0)]
)
def test_a_setting_that_moved_is_seen(register: int, value: float) -> None:
    async def test(bench: Bench) -> None:
        await bench.driver.set_pump(0.5)
        bench.emulator.registers[register] = value
        with pytest.raises(LinkDownError):
            await bench.driver.pump_fraction()

    on_bench(test)


def test_a_damaged_answer_is_requested_again() -> None:
    async def test(bench: Bench) -> None:
        await bench.driver.set_pump(0.5)
        spoilt = iter([600.0])
        read = bench.emulator._read

        def once(number: int) -> None:
            true = bench.emulator.registers[number]
            if number == 23:
                bench.emulator.registers[23] = next(spoilt, true)
            read(number)
            bench.emulator.registers[number] = true

        bench.emulator._read = once  # type: ignore[method-assign]
        assert await bench.driver.pump_fraction() == 0.5

    on_bench(test)


def test_an_error_of_the_pump_is_reported() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.registers[31] = 4.0
        with pytest.raises(LinkError, match="reports error 4"):
            await bench.driver.pump_fraction()
        bench.emulator.registers[31] = 0.0

    on_bench(test)


@pytest.mark.parametrize(
    "faults",
    [
        SerialFaults(silent=True),
        SerialFaults(deaf=True),
        SerialFaults(delay_s=0.3),
        SerialFaults(garbage_bytes=9),
        SerialFaults(cut_bytes=1),
    ],
)
def test_each_fault_is_an_error_and_passes(faults: SerialFaults) -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.faults = faults
        for _ in range(2):
            with pytest.raises(LinkError):
                await bench.driver.set_pump(0.3)
        bench.emulator.faults = SerialFaults()
        await asyncio.sleep(1.0)  # the late answer comes and is discarded
        await bench.driver.set_pump(0.4)
        assert bench.driven[-1] == 0.4

    on_bench(test)


def test_another_device_is_refused() -> None:
    async def test() -> None:
        bench = Bench()
        bench.emulator.registers[37] = 1.0
        with pytest.raises(DeviceRefusedError, match="device type 1"):
            await bench.driver.open()

    run_virtual(test())


def test_more_power_than_pumps_take_is_refused() -> None:
    with pytest.raises(ValueError, match="less than or equal to 1400"):
        VentusConfig(port="/dev/null", power_max_mw=5000.0)


async def test_through_the_kernel_with_a_replug(tmp_path: Path) -> None:
    driven: list[float] = []
    wire = PtyWire(VentusEmulator(driven.append), tmp_path / "tty")
    wire.plug()
    driver = Ventus(VentusConfig(port=str(wire.path)))
    await driver.open()
    await driver.set_pump(0.5)
    wire.unplug()
    with pytest.raises(LinkDownError):
        await driver.set_pump(0.6)
    assert driven[-1] == 0.5  # no watchdog: it runs on
    wire.plug()
    await driver.open()
    assert driven[-1] == 0.0
    await driver.close()
    wire.unplug()
