"""A bench of single devices: what each failure becomes, and the software watchdog; all in virtual
time.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Coroutine
from typing import Any

import pytest

from firmware_iface.role_bench import NO_ANSWER, RoleBench, RoleDevices
from firmware_iface.roles import (
    ALL_FAULTS,
    BenchCommand,
    DeviceIdentity,
    DeviceRefusedError,
    DisplacementSample,
    LinkDownError,
    LinkError,
)
from tests.support.virtual_time import run_virtual

WATCHDOG_S = 0.5


class FakeDevice:
    """Fills any role; `error` is what every call of it raises."""

    def __init__(self, kind: str, log: list[str]) -> None:
        self.kind = kind
        self.error: Exception | None = None
        self.value = 0.0
        self.samples = 0
        self.opened = 0
        self.serial = "1"
        self.took_s = 0.0
        self._log = log

    async def _do(self) -> float:
        await asyncio.sleep(self.took_s)
        if self.error is not None:
            raise self.error
        return self.value

    async def open(self) -> DeviceIdentity:
        await self._do()
        self.opened += 1
        self._log.append(f"open {self.kind}")
        return DeviceIdentity(self.kind, self.serial, "1.0")

    async def close(self) -> None:
        self._log.append(f"close {self.kind}")

    def describe(self) -> dict[str, str]:
        return {"port": self.kind}

    async def displacement(self) -> DisplacementSample:
        value_um = await self._do()
        self.samples += 1
        return DisplacementSample(value_um, 0, self.samples, self.samples / 10)

    async def set_pump(self, fraction: float) -> None:
        await self._do()
        self.value = fraction

    set_vent = set_pump

    async def pump_fraction(self) -> float:
        return await self._do()

    gauge_pressure_pa = ambient_pressure_pa = air_temperature_c = vent_fraction = pump_fraction


class Devices:
    """Six fakes and their bench."""

    def __init__(self, vent: bool = True, laser: bool = True) -> None:
        self.log: list[str] = []
        self.laser, self.pump, self.gauge, self.barometer, self.air, self.vent = (
            FakeDevice(kind, self.log)
            for kind in ("laser", "pump", "gauge", "barometer", "air", "vent")
        )
        self.laser.value, self.gauge.value, self.barometer.value = 7.0, 600.0, 101_325.0
        roles = RoleDevices(
            self.laser if laser else None,
            self.pump,
            self.gauge,
            self.vent if vent else None,
            {"barometer": self.barometer, "thermometer": self.air},
        )
        self.bench = RoleBench(roles, WATCHDOG_S, lambda: asyncio.get_running_loop().time())


def virtual(run: Coroutine[Any, Any, None]) -> None:
    run_virtual(run)


def test_a_reading_has_every_role_and_takes_as_long_as_the_slowest() -> None:
    async def run() -> None:
        devices = Devices()
        identity = await devices.bench.open()
        assert "displacement laser" in identity.kind
        for device in (
            devices.laser,
            devices.pump,
            devices.gauge,
            devices.barometer,
            devices.air,
            devices.vent,
        ):
            device.took_s = 0.01
        await devices.bench.write(BenchCommand(0.5, 0.25))
        begin_s = asyncio.get_running_loop().time()
        reading = await devices.bench.read()
        assert asyncio.get_running_loop().time() - begin_s == pytest.approx(0.01)
        assert (reading.displacement_um, reading.gauge_pressure_pa, reading.sample_counter) == (
            7.0,
            600.0,
            1,
        )
        assert (reading.pump_fraction, reading.vent_fraction) == (0.5, 0.25)
        assert (reading.latched_faults, reading.watchdog_tripped) == (0, False)
        await devices.bench.close()

    virtual(run())


def test_actuators_are_opened_last_and_the_pump_is_closed_first() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.close()
        assert devices.log[4:6] == ["open vent", "open pump"]
        assert devices.log[6] == "close pump"

    virtual(run())


def test_a_device_that_does_not_open_is_named_by_its_role_and_all_are_closed() -> None:
    async def run() -> None:
        devices = Devices()
        devices.gauge.error = DeviceRefusedError("a kettle answers")
        with pytest.raises(DeviceRefusedError, match="gauge_pressure: a kettle answers"):
            await devices.bench.open()
        assert "close laser" in devices.log
        assert "open pump" not in devices.log

    virtual(run())


@pytest.mark.parametrize("error", [LinkError("noise"), LinkDownError("unplugged")])
def test_a_failed_sensor_is_a_missing_value_and_no_old_one(error: LinkError) -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        before = await devices.bench.read()
        for device in (devices.laser, devices.gauge, devices.barometer, devices.air):
            device.error = error
        reading = await devices.bench.read()
        assert math.isnan(reading.displacement_um)
        assert reading.displacement_quality == NO_ANSWER
        assert reading.sample_counter == before.sample_counter  # stands still: seen as frozen
        for value in (
            reading.gauge_pressure_pa,
            reading.ambient_pressure_pa,
            reading.air_temperature_c,
        ):
            assert math.isnan(value)
        await devices.bench.close()

    virtual(run())


def test_a_lost_sensor_is_opened_again_and_read_within_a_fifth_of_a_second() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        devices.laser.error = LinkDownError("unplugged")
        for _ in range(20):
            assert math.isnan((await devices.bench.read()).displacement_um)
            await asyncio.sleep(0.05)
        devices.laser.error = None
        await asyncio.sleep(0.2)
        assert (await devices.bench.read()).displacement_um == 7.0
        assert devices.laser.opened == 2
        await devices.bench.close()

    virtual(run())


def test_a_lost_laser_does_not_stop_the_clock_of_a_bench_whose_gauge_answers() -> None:
    """The bench may be held by its optics; the laser's first sample afterwards is a new one,
    whatever its number.
    """

    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        seen = [await devices.bench.read()]
        devices.laser.error = LinkError("no answer")
        for _ in range(2):
            await asyncio.sleep(0.02)
            seen.append(await devices.bench.read())
        devices.laser.error = None
        seen.append(await devices.bench.read())
        assert [math.isnan(reading.displacement_um) for reading in seen] == [
            False,
            True,
            True,
            False,
        ]
        assert len({reading.sample_counter for reading in seen}) == 4
        assert len({reading.device_time_s for reading in seen}) == 4
        await devices.bench.close()

    virtual(run())


def test_another_sensor_in_its_place_is_not_used() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        devices.laser.error = LinkDownError("unplugged")
        await devices.bench.read()
        devices.laser.error, devices.laser.serial = None, "2"
        for _ in range(10):
            await asyncio.sleep(0.1)
            assert math.isnan((await devices.bench.read()).displacement_um)
        await devices.bench.close()

    virtual(run())


@pytest.mark.parametrize("name", ["pump", "vent"])
def test_a_lost_actuator_is_a_lost_bench_but_the_other_one_is_still_commanded(name: str) -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        lost, other = (
            (devices.pump, devices.vent) if name == "pump" else (devices.vent, devices.pump)
        )
        lost.error = LinkDownError("unplugged")
        with pytest.raises(LinkDownError):
            await devices.bench.read()
        with pytest.raises(LinkDownError):
            await devices.bench.write(BenchCommand(0.25, 0.25))
        assert other.value == 0.25
        await devices.bench.close()

    virtual(run())


def test_without_a_laser_the_bench_still_advances() -> None:
    """It is held by its optics (`estimator.process_value`)."""

    async def run() -> None:
        bench = Devices(laser=False).bench
        assert (await bench.open()).displacement_range_um == (-math.inf, math.inf)
        first = await bench.read()
        await asyncio.sleep(0.02)
        second = await bench.read()
        assert math.isnan(second.displacement_um)
        assert second.displacement_quality != 0
        assert second.sample_counter != first.sample_counter
        assert second.device_time_s > first.device_time_s
        await bench.close()

    virtual(run())


def test_without_a_vent_its_read_back_is_nan() -> None:
    async def run() -> None:
        devices = Devices(vent=False)
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 1.0))
        reading = await devices.bench.read()
        assert reading.pump_fraction == 0.5
        assert math.isnan(reading.vent_fraction)
        await devices.bench.close()

    virtual(run())


@pytest.mark.parametrize(
    "command", [BenchCommand(math.nan, 0.0), BenchCommand(0.5, 1.01), BenchCommand(-0.1, 0.0)]
)
def test_an_impossible_command_reaches_no_device(command: BenchCommand) -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        with pytest.raises(ValueError, match="is not within"):
            await devices.bench.write(command)
        assert (devices.pump.value, devices.vent.value) == (0.0, 0.0)
        await devices.bench.close()

    virtual(run())


def test_the_watchdog_stops_the_pump_of_a_silent_controller_and_reports_it_until_a_person_clears_it() -> (  # noqa: E501
    None
):
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        for _ in range(10):
            await devices.bench.write(BenchCommand(0.5, 0.0))
            await asyncio.sleep(0.9 * WATCHDOG_S)
        assert devices.pump.value == 0.5
        await asyncio.sleep(0.5 * WATCHDOG_S)
        assert devices.pump.value == 0.0
        await devices.bench.write(BenchCommand(0.5, 0.0))
        reading = await devices.bench.read()
        assert (devices.pump.value, reading.watchdog_tripped, reading.latched_faults) == (
            0.0,
            True,
            1,
        )
        await devices.bench.clear_faults(ALL_FAULTS)
        await devices.bench.write(BenchCommand(0.5, 0.0))
        reading = await devices.bench.read()
        assert (reading.pump_fraction, reading.watchdog_tripped) == (0.5, False)
        await devices.bench.close()

    virtual(run())


def test_the_watchdog_keeps_trying_while_the_pump_cannot_be_reached() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 0.0))
        devices.pump.error = LinkError("noise")
        await asyncio.sleep(4 * WATCHDOG_S)
        assert devices.pump.value == 0.5
        devices.pump.error = None
        await asyncio.sleep(WATCHDOG_S / 2)
        assert devices.pump.value == 0.0
        await devices.bench.close()

    virtual(run())


def test_a_write_that_failed_still_counts_as_commanded() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        devices.vent.error = LinkError("noise")
        with pytest.raises(LinkError):
            await devices.bench.write(BenchCommand(0.5, 0.0))
        assert devices.pump.value == 0.5
        await asyncio.sleep(1.5 * WATCHDOG_S)
        assert devices.pump.value == 0.0
        await devices.bench.close()

    virtual(run())


@pytest.mark.parametrize(
    "error", [LinkError("noise"), OSError("gone"), ValueError("bad"), TimeoutError()]
)
def test_the_watchdog_survives_whatever_a_driver_raises(error: Exception) -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.7, 0.0))
        devices.pump.error = error
        await asyncio.sleep(4 * WATCHDOG_S)
        assert devices.pump.value == 0.7
        devices.pump.error = None
        await asyncio.sleep(WATCHDOG_S / 2)
        assert devices.pump.value == 0.0
        assert (await devices.bench.read()).watchdog_tripped
        await devices.bench.close()

    virtual(run())


def dead_watchdog(devices: Devices) -> None:
    """End it as a program defect would."""
    assert devices.bench._watchdog is not None
    devices.bench._watchdog.cancel()


@pytest.mark.parametrize("call", ["read", "write"])
def test_a_watchdog_that_ended_stops_the_pump_and_is_a_lost_bench_at_the_next_call(
    call: str,
) -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.7, 0.0))
        dead_watchdog(devices)
        await asyncio.sleep(0.01)
        with pytest.raises(
            LinkDownError, match="the software watchdog was cancelled; the pump was set to 0"
        ):
            await (
                devices.bench.read()
                if call == "read"
                else devices.bench.write(BenchCommand(0.7, 0.0))
            )
        assert devices.pump.value == 0.0
        await devices.bench.open()
        reading = await devices.bench.read()
        assert reading.watchdog_tripped  # cleared only by a person or the resume rule
        await devices.bench.write(BenchCommand(0.7, 0.0))
        assert devices.pump.value == 0.0
        await devices.bench.clear_faults(0xFFFF)
        await devices.bench.write(BenchCommand(0.7, 0.0))
        await asyncio.sleep(2 * WATCHDOG_S)
        assert devices.pump.value == 0.0  # the new watchdog works
        await devices.bench.close()

    virtual(run())


def test_opening_again_does_not_forget_a_trip() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 0.0))
        await asyncio.sleep(2 * WATCHDOG_S)
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 0.0))
        assert ((await devices.bench.read()).watchdog_tripped, devices.pump.value) == (True, 0.0)
        await devices.bench.close()

    virtual(run())


def test_the_watchdog_acts_while_the_bench_is_opened_again() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 0.0))
        devices.laser.took_s = 4 * WATCHDOG_S  # the first that is opened hangs
        opening = asyncio.create_task(devices.bench.open())
        await asyncio.sleep(2 * WATCHDOG_S)
        assert devices.pump.value == 0.0
        await opening
        await devices.bench.close()

    virtual(run())


@pytest.mark.parametrize("name", ["laser", "gauge", "barometer", "air", "pump", "vent"])
def test_an_error_that_no_driver_should_raise_is_one_of_that_device(name: str) -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        getattr(devices, name).error = ZeroDivisionError("division by zero")
        if name in ("pump", "vent"):
            with pytest.raises(LinkError, match=f"{name}: ZeroDivisionError: division by zero"):
                await devices.bench.read()
            with pytest.raises(LinkError, match=f"{name}: ZeroDivisionError"):
                await devices.bench.write(BenchCommand(0.5, 0.0))
        else:
            await devices.bench.read()
            await devices.bench.write(BenchCommand(0.5, 0.0))
            assert devices.pump.value == 0.5
        devices.pump.error = None
        await devices.bench.close()

    virtual(run())


def test_a_pump_that_comes_back_without_the_laser_is_stopped() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 0.0))
        devices.pump.error = devices.laser.error = LinkDownError("unplugged")
        for _ in range(3):
            with pytest.raises(LinkDownError):
                await devices.bench.open()
        assert devices.pump.value == 0.5
        devices.pump.error = None
        with pytest.raises(LinkDownError, match="displacement"):
            await devices.bench.open()
        assert devices.pump.value == 0.0

    virtual(run())


def test_reading_does_not_feed_the_watchdog() -> None:
    async def run() -> None:
        devices = Devices()
        await devices.bench.open()
        await devices.bench.write(BenchCommand(0.5, 0.0))
        for _ in range(8):
            await asyncio.sleep(WATCHDOG_S / 4)
            await devices.bench.read()
        assert devices.pump.value == 0.0
        assert (await devices.bench.read()).watchdog_tripped
        await devices.bench.close()

    virtual(run())
