"""A register as a role's value: the line between them, its types and word orders, its limits."""

from __future__ import annotations

import math
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_iface.drivers.modbus_map import ModbusValue, ValueMap, make_map
from firmware_iface.emulators.rtu_bus import compute_bitwise_crc
from firmware_iface.links.modbus_rtu import RtuBus
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkError
from membrane_ctrl.sim.lab import MapDevice, respond_to_input
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import MemoryWire, RtuBusEmulator

LINE = SerialSettings(9600)
PUMP, _ = make_map({"address": 0, "value": [0.0, 1.0]}, "waveshare_ao8")


def made(device: MapDevice, value_map: ValueMap, rest: float | None = None) -> ModbusValue:
    wire = MemoryWire(
        RtuBusEmulator(LINE, {1: partial(respond_to_input, table=device)}, echo_test=False)
    )
    return ModbusValue(RtuBus(wire).device(1, 0.2), value_map, rest)


@pytest.mark.parametrize("kind", ["u16", "i16", "u32", "i32", "f32"])
@pytest.mark.parametrize("order", ["big", "little"])
@given(value=st.floats(-5.0, 15.0))
def test_what_is_encoded_is_decoded(kind: str, order: str, value: float) -> None:
    found = ValueMap(0, (0.0, 10.0), (10_000, 20_000), (-5.0, 15.0), type=kind, word_order=order)
    assert found.decode(found.encode(value)) == pytest.approx(value, abs=6e-4)


def test_word_order_is_of_words_not_of_bytes() -> None:
    big = ValueMap(0, (0.0, 1.0), (0.0, 1.0), (0.0, 1e9), type="u32")
    little = ValueMap(0, (0.0, 1.0), (0.0, 1.0), (0.0, 1e9), type="u32", word_order="little")
    assert big.decode([0x0001, 0x0203]) == 0x10203
    assert little.decode([0x0203, 0x0001]) == 0x10203


@pytest.mark.parametrize("value", [-0.001, 1.001, math.nan, math.inf])
def test_a_value_outside_the_limits_is_never_encoded(value: float) -> None:
    with pytest.raises(ValueError, match="is not within"):
        PUMP.encode(value)


def test_the_frame_of_the_vendor() -> None:
    frame = bytes.fromhex("01060000 03E8")
    assert frame + compute_bitwise_crc(frame).to_bytes(2, "little") == bytes.fromhex(
        "0106000003E88974"
    )


def test_an_output_is_set_read_back_and_left_at_rest() -> None:
    reports: list[float] = []
    device = MapDevice({}, {PUMP: reports.append}, {0x8000: 100}, (0, 20_000))

    async def run() -> None:
        pump = made(device, PUMP, rest=0.0)
        identity = await pump.open()
        assert identity.firmware == "1.00"
        assert device.read(0, 1) == [4000]
        await pump.set_pump(0.25)
        assert (device.read(0, 1), reports[-1]) == ([8000], 0.25)
        assert await pump.pump_fraction() == 0.25
        await pump.close()
        assert (device.read(0, 1), reports[-1]) == ([4000], 0.0)

    run_virtual(run())


def test_an_output_that_lost_its_power_reads_back_as_an_error_not_as_off() -> None:
    device = MapDevice({}, {PUMP: lambda fraction: None}, {0x8000: 100}, (0, 20_000))

    async def run() -> None:
        pump = made(device, PUMP, rest=0.0)
        await pump.open()
        await pump.set_pump(0.25)
        device.restart()  # 0 mA: below what the map knows
        with pytest.raises(LinkError, match=r"reads -0.25, not 0 \.\. 1"):
            await pump.pump_fraction()
        await pump.close()

    run_virtual(run())


def test_a_sensor_is_read_from_input_registers_and_an_impossible_value_is_none() -> None:
    values = [600.0]
    gauge, _ = make_map(
        {
            "address": 4,
            "value": (0.0, 1000.0),
            "raw": (6400, 32_000),
            "function": "input",
            "limits": (-20.0, 900.0),
        }
    )
    device = MapDevice(
        {ValueMap(4, (0.0, 1000.0), (6400, 32_000), (-100.0, 2000.0)): lambda: values[0]}, {}
    )

    async def run() -> None:
        sensor = made(device, gauge)
        await sensor.open()
        assert await sensor.gauge_pressure_pa() == pytest.approx(600.0, abs=0.05)
        values[0] = 950.0
        with pytest.raises(LinkError, match="950"):
            await sensor.gauge_pressure_pa()
        await sensor.close()

    run_virtual(run())


def test_the_identity_register_decides() -> None:
    laser = ValueMap(0, (0.0, 1.0), (0, 1000), (0.0, 65.0), identity=(9, 77))

    async def run() -> None:
        for word, right in ((77, True), (78, False)):
            sensor = made(MapDevice({laser: lambda: 12.0}, {}, {9: word}), laser)
            if right:
                await sensor.open()
                first, second = await sensor.displacement(), await sensor.displacement()
                assert (first.displacement_um, first.quality) == (12.0, 0)
                assert second.sample_counter == first.sample_counter + 1
            else:
                with pytest.raises(DeviceRefusedError, match="register 9 holds 78, expected 77"):
                    await sensor.open()
            await sensor.close()

    run_virtual(run())
