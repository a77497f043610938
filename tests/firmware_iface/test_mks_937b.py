"""The MKS 937B: the manual's own bytes, and driver against emulated controller with each fault."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.drivers.mks_937b import Mks937b
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import Mks937bConfig
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import MemoryWire, Mks937bEmulator, SerialDevice, SerialFaults


class Bench:
    """A controller with a manometer, and its driver, in memory."""

    def __init__(self, config: dict[str, Any], emulator: dict[str, Any]) -> None:
        self.pressure_pa = 600.0
        self.emulator = Mks937bEmulator(lambda: self.pressure_pa, **emulator)
        self.wire = MemoryWire(self.emulator)
        self.driver = Mks937b(Mks937bConfig(port="memory", **config), self.wire)

    async def read_pa(self) -> float:
        return await self.driver.gauge_pressure_pa()


def on_bench(
    test: Callable[[Bench], Coroutine[Any, Any, None]], opened: bool = True, **config: Any
) -> None:
    async def run() -> None:
        bench = Bench(
            config, {key: config[key] for key in ("address", "channel", "parity") if key in config}
        )
        if opened:
            await bench.driver.open()
        await test(bench)
        await bench.driver.close()

    run_virtual(run())


# What the 937B manual prints on page 86 (PR1), and the other questions answered in its form
PAGES = {
    b"@003PR1?;FF": b"@003ACK7.602E+2;FF",
    b"@003MD?;FF": b"@003ACK937B;FF",
    b"@003SN?;FF": b"@003ACK1234567890;FF",
    b"@003FV6?;FF": b"@003ACK1.27;FF",
    b"@003STA?;FF": b"@003ACKCMNG;FF",
    b"@003U!PASCAL;FF": b"@003ACKPASCAL;FF",
    b"@003U?;FF": b"@003ACKPASCAL;FF",
}


class Manual(SerialDevice):
    """Answers by the book."""

    def received(self, data: bytes) -> None:
        if data != b";FF":
            self.send_answer(PAGES[data])


def test_the_bytes_of_the_manual() -> None:
    async def test() -> None:
        driver = Mks937b(
            Mks937bConfig(port="memory", address=3), MemoryWire(Manual(SerialSettings(115_200)))
        )
        identity = await driver.open()
        assert (identity.kind, identity.serial, identity.firmware) == (
            "MKS 937B",
            "1234567890",
            "1.27",
        )
        assert await driver.gauge_pressure_pa() == 760.2
        await driver.close()

    run_virtual(test())


@pytest.mark.parametrize("channel", range(1, 7))
def test_identity_and_reading_of_each_channel(channel: int) -> None:
    async def test(bench: Bench) -> None:
        identity = await bench.driver.open()
        assert identity.detail == f"channel {channel}"
        assert identity.shows == (-1333.0, 1333.0)
        assert bench.emulator.unit == "PASCAL"
        for pressure_pa in (600.0, 588.8, 561.25, 0.123, -2.5):
            bench.pressure_pa = pressure_pa
            if pressure_pa == 0.123:
                with pytest.raises(LinkError, match="jump"):
                    await bench.read_pa()
            assert await bench.read_pa() == pytest.approx(pressure_pa, rel=1e-3)

    on_bench(test, opened=False, channel=channel, address=7, range_pa=1333.0, parity="E")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "901P"}, "901P is not a 937B or 946"),
        ({"sensors": ["PR", "CM", "CM", "CM", "CM", "CM"]}, "channel 1 has the sensor PR, not CM"),
        ({"locked": True}, r"U!PASCAL is refused \(NAK 169\)"),
        ({"serial": "77"}, "serial number 77, expected 0123456789"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_an_unsuitable_controller_is_refused(change: dict[str, Any], words: str) -> None:
    async def test(bench: Bench) -> None:
        for name, value in change.items():
            setattr(bench.emulator, name, value)
        with pytest.raises(DeviceRefusedError, match=words):
            await bench.driver.open()

    on_bench(test, opened=False, serial="0123456789")


def test_over_range_and_no_sensor_are_no_pressure() -> None:
    async def test(bench: Bench) -> None:
        bench.pressure_pa = math.nan
        assert math.isnan(await bench.read_pa())
        bench.emulator.sensors = ["NG"] * 6
        assert math.isnan(await bench.read_pa())

    on_bench(test)


def test_a_unit_changed_at_the_panel_gives_no_false_pressure_and_is_set_back() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.unit = "TORR"
        with pytest.raises(LinkError, match="jump"):
            await bench.read_pa()
        with pytest.raises(LinkDownError, match="its unit is TORR, not PASCAL"):
            await bench.read_pa()
        await bench.driver.open()
        assert await bench.read_pa() == pytest.approx(600.0)

    on_bench(test)


def test_a_true_step_passes_with_its_second_reading() -> None:
    async def test(bench: Bench) -> None:
        bench.pressure_pa = 900.0
        with pytest.raises(LinkError, match=r"jump to 900\.0 Pa"):
            await bench.read_pa()
        assert await bench.read_pa() == pytest.approx(900.0)

    on_bench(test)


@pytest.mark.parametrize(
    "faults",
    [
        SerialFaults(silent=True),
        SerialFaults(delay_s=0.5),
        SerialFaults(garbage_bytes=18),
        SerialFaults(cut_bytes=3),
        SerialFaults(bit_errors=1),
        SerialFaults(bit_errors=4),
        SerialFaults(question_bit_errors=1),
    ],
    ids=str,
)
def test_with_each_fault_no_false_pressure(faults: SerialFaults) -> None:
    """Off by a step of the gate at most: a corrupted last digit cannot be distinguished from noise
    without a checksum.
    """

    async def test(bench: Bench) -> None:
        bench.emulator.faults = faults
        for _ in range(200):
            try:
                pressure_pa = await bench.read_pa()
            except LinkDownError:
                await asyncio.sleep(0.1)
                bench.emulator.faults = SerialFaults()
                await bench.driver.open()
                bench.emulator.faults = faults
            except LinkError:
                continue
            else:
                assert math.isnan(pressure_pa) or abs(pressure_pa - 600.0) <= 50.0
        bench.emulator.faults = SerialFaults()
        await asyncio.sleep(1.0)
        await bench.driver.open()
        assert await bench.read_pa() == pytest.approx(600.0)

    on_bench(test)


def test_a_late_answer_is_never_the_next_reading() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.faults = SerialFaults(delay_s=0.11)
        bench.pressure_pa = 610.0
        with pytest.raises(LinkError, match="no answer"):
            await bench.read_pa()
        bench.emulator.faults = SerialFaults()
        bench.pressure_pa = 630.0
        assert await bench.read_pa() == pytest.approx(630.0)

    on_bench(test)


async def test_through_the_kernel(tmp_path: Path) -> None:
    wire = PtyWire(Mks937bEmulator(lambda: 600.0, baud=9600), tmp_path / "tty")
    wire.plug()
    driver = Mks937b(Mks937bConfig(port=str(wire.path), baud=9600, timeout_s=2.0))
    await driver.open()
    assert await driver.gauge_pressure_pa() == pytest.approx(600.0)
    await driver.close()
    wire.unplug()
