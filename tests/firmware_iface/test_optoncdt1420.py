"""The optoNCDT 1420: bytes of its manual, and driver against emulated sensor with each fault."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.drivers.optoncdt1420 import (
    Optoncdt1420,
    StreamParser,
    distance_mm,
    mean_of_middle,
)
from firmware_iface.drivers.step_gate import StepGate
from firmware_iface.emulators.optoncdt1420 import NO_PEAK, encode_three_bytes
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from firmware_iface.settings import Optoncdt1420Config
from tests.support.memory_bench import run_on_bench
from tests.support.virtual_time import run_virtual, stand_still
from tests.worlds.faulty_devices import MemoryWire, Optoncdt1420Emulator

STEP_UM = 50_000 * 1.02 / 65_520  # a digital step at 50 mm range


class Bench:
    """A sensor and its driver in memory."""

    def __init__(self, **settings: Any) -> None:
        self.displacement_um = 12.0
        self.emulator = Optoncdt1420Emulator(lambda: self.displacement_um)
        self.wire = MemoryWire(self.emulator)
        self.driver = Optoncdt1420(Optoncdt1420Config(port="memory", **settings), self.wire)

    async def tick(self) -> float:
        await asyncio.sleep(0.02)
        return (await self.driver.displacement()).displacement_um


def on_bench(test: Callable[[Bench], Coroutine[Any, Any, None]], **settings: Any) -> None:
    run_on_bench(lambda: Bench(**settings), test)


def measurement(raw: int, counter: int) -> bytes:
    return encode_three_bytes(raw, first=True) + encode_three_bytes(counter, first=False)


def test_the_marks_of_the_three_bytes() -> None:
    assert encode_three_bytes(0b101010_110011_001111, first=True) == bytes(
        [0b00_001111, 0b01_110011, 0b10_101010]
    )
    assert encode_three_bytes(0, first=False) == bytes([0, 0x40, 0xC0])


@pytest.mark.parametrize(
    ("raw", "distance"), [(0, -0.5), (32_760, 25.0), (65_520, 50.5), (643, 0.0005), (64_877, 50.0)]
)
def test_digital_values(raw: int, distance: float) -> None:
    assert distance_mm(raw, 50.0) == pytest.approx(distance, abs=0.0006)


def test_the_stream_in_any_portions() -> None:
    raw = np.arange(1000, 1200)
    data = b"".join(measurement(int(value), 7 + k) for k, value in enumerate(raw))
    for portion in (1, 2, 5, 6, 7, 100):
        parser = StreamParser()
        found = np.concatenate(
            [parser.feed(data[i : i + portion]) for i in range(0, len(data), portion)]
        )
        np.testing.assert_array_equal(found, raw[1:])  # the first has none before it
        assert (parser.bytes_lost, parser.untrusted) == (0, 1)


def test_a_value_joined_from_two_is_not_trusted() -> None:
    data = b"".join(measurement(1000 if k < 5 else 60_000, k) for k in range(10))
    for lost_from in range(12, 42):
        for lost in range(1, 13):
            values = StreamParser().feed(data[:lost_from] + data[lost_from + lost :])
            assert set(values.tolist()) <= {1000, 60_000}


def test_the_counter_runs_over() -> None:
    parser = StreamParser()
    data = b"".join(measurement(5, counter % 2**18) for counter in range(2**18 - 3, 2**18 + 3))
    assert len(parser.feed(data)) == 5


def test_the_middle_of_many_ignores_a_quarter() -> None:
    values = np.array([100] * 30 + [101] * 30 + [60_000] * 20)
    assert 100.0 < mean_of_middle(values) < 102.0
    assert mean_of_middle(np.array([1, 2, 60_000])) == 2.0


def test_the_gate_wants_a_second_reading() -> None:
    gate = StepGate(10.0)
    assert [gate.passes(v) for v in (0, 3, 500, 5, 8, 300, 303, 301)] == [
        False,
        True,
        False,
        True,
        True,
        False,
        True,
        True,
    ]


def test_identity_settings_and_readings() -> None:
    async def test() -> None:
        bench = Bench(range_mm=50)
        identity = await bench.driver.open()
        assert (identity.kind, identity.serial, identity.firmware) == (
            "ILD1420-50",
            "15030002",
            "001.010",
        )
        before = await bench.driver.displacement()
        assert before.displacement_um == pytest.approx(12.0, abs=STEP_UM)
        bench.displacement_um = 40.0
        await bench.tick()
        after = await bench.driver.displacement()
        assert after.displacement_um == pytest.approx(40.0, abs=STEP_UM)
        assert after.quality == 0
        assert after.sample_counter > before.sample_counter + 80
        assert after.device_time_s > before.device_time_s
        assert "0.0" not in bench.driver.describe()["settings"]
        await bench.driver.close()

    run_virtual(test())


def test_readings_that_arrived_while_the_process_was_stopped_are_used() -> None:
    async def test() -> None:
        bench = Bench()
        bench.emulator.faults.delay_s = 0.1
        opened = asyncio.create_task(bench.driver.open())
        await asyncio.sleep(0.05)
        stand_still(1.0)
        await opened
        bench.emulator.faults.delay_s = 0.0
        await bench.driver.displacement()
        read = asyncio.create_task(bench.driver.displacement())
        await asyncio.sleep(0)
        stand_still(1.0)
        assert (await read).displacement_um == pytest.approx(12.0, abs=STEP_UM)
        await bench.driver.close()

    run_virtual(test())


def test_the_mean_resolves_less_than_a_step() -> None:
    async def test() -> None:
        emulator = Optoncdt1420Emulator(lambda: 12.3, noise_um=1.0)
        driver = Optoncdt1420(Optoncdt1420Config(port="memory"), MemoryWire(emulator))
        await driver.open()
        found = []
        for _ in range(50):
            await asyncio.sleep(0.02)
            found.append((await driver.displacement()).displacement_um)
        assert np.mean(found) == pytest.approx(12.3, abs=0.1)
        assert np.std(found) < 0.25
        await driver.close()

    run_virtual(test())


def test_a_deeper_bowl_is_nearer() -> None:
    async def test() -> None:
        emulator = Optoncdt1420Emulator(lambda: 1000.0, direction=1)
        driver = Optoncdt1420(
            Optoncdt1420Config(port="memory", direction=-1, zero_mm=25.0), MemoryWire(emulator)
        )
        await driver.open()
        assert (await driver.displacement()).displacement_um == pytest.approx(-1000.0, abs=STEP_UM)
        await driver.close()

    run_virtual(test())


@pytest.mark.parametrize(
    ("displacement_um", "code"),
    [(math.nan, NO_PEAK), (26_000.0, NO_PEAK + 1), (-26_000.0, NO_PEAK + 2)],
)
def test_error_codes_are_the_quality(displacement_um: float, code: int) -> None:
    async def test(bench: Bench) -> None:
        bench.displacement_um = displacement_um
        await bench.tick()
        await asyncio.sleep(0.02)
        sample = await bench.driver.displacement()
        assert sample.quality == code
        assert math.isnan(sample.displacement_um)

    on_bench(test)


def test_the_reserve_is_no_measuring_range() -> None:
    async def test(bench: Bench) -> None:
        bench.displacement_um = 25_200.0
        for _ in range(3):
            await asyncio.sleep(0.02)
            try:
                sample = await bench.driver.displacement()
            except LinkError:
                continue  # the jump to it
        assert 0 < sample.quality < 643
        assert math.isnan(sample.displacement_um)

    on_bench(test)


def test_a_jump_is_accepted_when_repeated() -> None:
    async def test(bench: Bench) -> None:
        await bench.tick()
        bench.displacement_um = 500.0
        await asyncio.sleep(0.02)
        with pytest.raises(LinkError, match=r"jump to 499\.7 µm"):
            await bench.tick()
        assert await bench.tick() == pytest.approx(500.0, abs=STEP_UM)

    on_bench(test)


def test_lost_bytes_change_nothing() -> None:
    async def test(bench: Bench) -> None:
        bench.emulator.lose_bytes_every = 10
        for _ in range(100):
            assert await bench.tick() == pytest.approx(12.0, abs=STEP_UM)

    on_bench(test)


def test_a_frozen_sensor_gives_no_value() -> None:
    async def test(bench: Bench) -> None:
        await bench.tick()
        bench.emulator.faults.frozen = True
        with pytest.raises(LinkError, match="no value within"):
            await bench.driver.displacement()

    on_bench(test)


@pytest.mark.parametrize("how", ["power", "silence"])
def test_a_sensor_that_stops_is_to_be_opened_again(how: str) -> None:
    async def test(bench: Bench) -> None:
        await bench.tick()
        if how == "power":
            bench.emulator.power_cycle()  # it forgets that it was streaming
        else:
            bench.emulator.faults.silent = True
        for kind in (LinkError, LinkError, LinkDownError):
            with pytest.raises(kind, match="no value within"):
                await bench.driver.displacement()
        bench.emulator.faults.silent = False
        await bench.driver.open()
        assert await bench.tick() == pytest.approx(12.0, abs=STEP_UM)

    on_bench(test)


def test_a_pulled_plug_is_noticed_while_waiting() -> None:
    async def test(bench: Bench) -> None:
        await bench.tick()
        waiting = asyncio.create_task(bench.driver.displacement())
        await asyncio.sleep(0)
        bench.wire.unplug()
        with pytest.raises(LinkDownError):
            await waiting
        with pytest.raises(LinkDownError, match="no such port"):
            await bench.driver.open()

    on_bench(test)


@pytest.mark.parametrize(
    ("emulator", "settings", "message"),
    [
        ({"name": "ILD1750-50"}, {}, "'ILD1750-50' is not an optoNCDT 1420"),
        ({"range_mm": 10}, {"range_mm": 50}, "measures 10 mm, range_mm = 50"),
    ],
)
def test_another_sensor_is_refused(
    emulator: dict[str, Any], settings: dict[str, Any], message: str
) -> None:
    async def test() -> None:
        wire = MemoryWire(Optoncdt1420Emulator(lambda: 0.0, **emulator))
        driver = Optoncdt1420(Optoncdt1420Config(port="memory", **settings), wire)
        with pytest.raises(DeviceRefusedError, match=message):
            await driver.open()

    run_virtual(test())


def test_half_a_command_of_someone_else_is_not_in_the_way() -> None:
    async def test() -> None:
        bench = Bench()
        bench.emulator.received(b"MEASR")
        await bench.driver.open()
        assert await bench.tick() == pytest.approx(12.0, abs=STEP_UM)
        await bench.driver.close()

    run_virtual(test())


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"silent": True}, "no answer"),
        ({"garbage_bytes": 40}, "wrong baud rate"),
        ({"delay_s": 1.0}, "no answer"),
    ],
)
def test_open_names_the_fault(faults: dict[str, Any], message: str) -> None:
    async def test() -> None:
        bench = Bench()
        for name, value in faults.items():
            setattr(bench.emulator.faults, name, value)
        with pytest.raises(LinkError, match=message):
            await bench.driver.open()

    run_virtual(test())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rate_khz": 3.0}, "rate_khz = 3"),
        ({"baud": 115_200, "rate_khz": 4.0}, "cannot carry"),
        ({"direction": 0}, "direction"),
        ({"port": "COM3"}, "usb:VID:PID"),
    ],
)
def test_settings_that_cannot_be(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Optoncdt1420(Optoncdt1420Config(**{"port": "/dev/null", **settings}))


async def test_through_the_kernel_with_a_replug(tmp_path: Path) -> None:
    wire = PtyWire(Optoncdt1420Emulator(lambda: 12.0), tmp_path / "tty")
    wire.plug()
    driver = Optoncdt1420(Optoncdt1420Config(port=str(wire.path)))
    await driver.open()
    assert (await driver.displacement()).displacement_um == pytest.approx(12.0, abs=STEP_UM)
    wire.unplug()
    with contextlib.suppress(LinkDownError):
        await driver.displacement()  # what came before the plug was pulled may still be there
    with pytest.raises(LinkDownError):
        await driver.displacement()
    wire.plug()
    await driver.open()
    assert (await driver.displacement()).displacement_um == pytest.approx(12.0, abs=STEP_UM)
    await driver.close()
    wire.unplug()
