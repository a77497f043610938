"""The Vaisala PTB330: its messages, and driver against emulated instrument with each fault."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.drivers.vaisala_ptb330 import VaisalaPtb330
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import VaisalaPtb330Config
from tests.support.memory_bench import run_on_bench
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import MemoryWire, SerialFaults, VaisalaPtb330Emulator


class Bench:
    """A barometer and its driver in memory."""

    def __init__(self, **emulator: Any) -> None:
        self.pressure_pa = 101_325.0
        self.emulator = VaisalaPtb330Emulator(lambda: self.pressure_pa, **emulator)
        self.wire = MemoryWire(self.emulator)
        self.driver = VaisalaPtb330(VaisalaPtb330Config(port="memory"), self.wire)

    async def after(self, seconds: float) -> float:
        await asyncio.sleep(seconds)
        return await self.driver.ambient_pressure_pa()


def on_bench(test: Callable[[Bench], Coroutine[Any, Any, None]], **emulator: Any) -> None:
    run_on_bench(lambda: Bench(**emulator), test)


def test_frames() -> None:
    async def test() -> None:
        bytes_sent: list[bytes] = []
        emulator = VaisalaPtb330Emulator(lambda: 101_325.0)
        emulator.attach(bytes_sent.append)
        emulator.receive(b"ECHO OFF\r\nFORM 4.3 P #r #n\r\nSEND\r\nFORM ?\r\nERRS\r\nVERS\r\n")
        await asyncio.sleep(2.0)
        assert b"".join(bytes_sent) == (
            b"ECHO OFF\r\nEcho           : OFF\r\n"
            + b"OK\r\n1013.250\r\nOutput format  : 4.3 P \\r \\n\r\n"
            b"PASS\r\nNo errors\r\nPTB330 / 1.01\r\n"
        )

    run_virtual(test())


def test_a_message_carries_its_checksum() -> None:
    async def test() -> None:
        bytes_sent: list[bytes] = []
        emulator = VaisalaPtb330Emulator(lambda: 99_800.0)
        emulator.attach(bytes_sent.append)
        emulator.receive(b'ECHO OFF\r\nFORM 4.3 P " " U3 " " CS4 #r #n\r\nSEND\r\n')
        await asyncio.sleep(1.0)
        message = bytes_sent[-1]
        assert message[:13] == b" 998.000 hPa "
        assert int(message[13:17], 16) == sum(message[:13])

    run_virtual(test())


@pytest.mark.parametrize("running", [False, True])
def test_identity_and_reading(running: bool) -> None:
    async def test() -> None:
        bench = Bench(running=running)
        identity = await bench.driver.open()
        assert identity.kind == "Vaisala PTB330"
        assert (identity.serial, identity.firmware, identity.detail) == (
            "A1234567",
            "1.01",
            "No errors",
        )
        assert await bench.driver.ambient_pressure_pa() == pytest.approx(101_325.0)
        bench.pressure_pa = 99_876.54
        assert await bench.after(0.5) == pytest.approx(99_876.54, abs=0.051)
        assert "4800 7E1" in bench.driver.describe()["port"]
        await bench.driver.close()

    run_virtual(test())


def test_a_unit_set_by_someone_else_is_no_pressure_and_set_back() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator._unit = "kPa"
        with pytest.raises(LinkDownError, match=r"101\.325 kPa"):
            await bench.after(4.0)
        await asyncio.sleep(1.0)
        await bench.driver.open()
        assert await bench.driver.ambient_pressure_pa() == pytest.approx(101_325.0)

    on_bench(test)


@pytest.mark.parametrize("pressure_pa", [math.nan, 40_000.0, 120_000.0])
def test_what_is_no_pressure(pressure_pa: float) -> None:
    async def test(bench: Bench) -> None:
        bench.pressure_pa = pressure_pa
        assert math.isnan(await bench.after(4.0))

    on_bench(test)


def test_a_module_in_error_is_no_pressure() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.error_flags = "010"
        assert math.isnan(await bench.after(0.5))
        bench.emulator.error_flags = "0"  # of an instrument with one module
        assert await bench.after(0.5) == pytest.approx(101_325.0)

    on_bench(test)


@pytest.mark.parametrize(
    "faults",
    [
        SerialFaults(frozen=True),
        SerialFaults(silent=True),
        SerialFaults(delay_s=5.0),
        SerialFaults(garbage_bytes=25),
        SerialFaults(cut_bytes=3),
        SerialFaults(bit_errors=1),
        SerialFaults(bit_errors=3),
    ],
)
def test_with_each_fault_the_value_grows_old_and_is_gone(faults: SerialFaults) -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.faults = faults
        bench.pressure_pa = 90_000.0
        assert await bench.after(0.5) == pytest.approx(101_325.0)
        with contextlib.suppress(LinkDownError):  # by then it may have been given up
            assert math.isnan(await bench.after(3.5))
        bench.emulator.faults = SerialFaults()
        await asyncio.sleep(10.0)
        await bench.driver.open()
        assert await bench.after(0.5) == pytest.approx(90_000.0)

    on_bench(test)


def test_after_a_pulled_plug_it_is_known_again_at_once() -> None:
    async def test(bench: Bench) -> None:
        bench.wire.unplug()
        with pytest.raises(LinkDownError):
            await bench.driver.ambient_pressure_pa()
        bench.wire.plugged = True
        before_s = asyncio.get_running_loop().time()
        identity = await bench.driver.open()
        assert await bench.driver.ambient_pressure_pa() == pytest.approx(101_325.0)
        assert asyncio.get_running_loop().time() - before_s < 1.0
        assert identity.serial == "A1234567"

    on_bench(test)


def test_another_instrument_in_its_place_is_identified_again() -> None:
    async def test(bench: Bench) -> None:
        bench.wire.unplug()
        bench.emulator.serial = "B7654321"
        bench.wire.plugged = True
        assert (await bench.driver.open()).serial == "B7654321"

    on_bench(test)


def test_another_instrument_is_refused() -> None:
    async def test() -> None:
        bench = Bench(model="PTB220")
        with pytest.raises(DeviceRefusedError, match="not a PTB330"):
            await bench.driver.open()

    run_virtual(test())


def test_silence_is_reported() -> None:
    async def test() -> None:
        bench = Bench()
        bench.emulator.faults.deaf = True
        with pytest.raises(LinkError, match="no answer within"):
            await bench.driver.open()

    run_virtual(test())


async def test_through_the_kernel(tmp_path: Path) -> None:
    wire = PtyWire(VaisalaPtb330Emulator(lambda: 100_000.0, baud=9600), tmp_path / "tty")
    wire.plug()
    driver = VaisalaPtb330(VaisalaPtb330Config(port=str(wire.path), baud=9600))
    await driver.open()
    assert await driver.ambient_pressure_pa() == pytest.approx(100_000.0)
    await driver.close()
    wire.unplug()
