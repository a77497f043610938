"""Bronkhorst: the bytes of the manual, both protocols against the emulator, the vendor's own
library against it.
"""

from __future__ import annotations

import asyncio
import math
import random
import struct
import threading
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.drivers.bronkhorst import (
    CONTROL_MODE,
    FMEASURE,
    FSETPOINT,
    SETPOINT,
    TEMPERATURE,
    BronkhorstFlow,
    BronkhorstPressure,
    ParameterPort,
)
from firmware_iface.drivers.bronkhorst_modbus import ModbusParameters, register_of
from firmware_iface.drivers.bronkhorst_propar import (
    ProparMessage,
    ProparParameters,
    ascii_frame,
    binary_frame,
    parse_ascii,
    parse_values,
    split_binary,
)
from firmware_iface.emulators.modbus_pdu import ILLEGAL_VALUE, WRITE_MULTIPLE, answer_request
from firmware_iface.emulators.pumps import ANALOG_INPUT, BronkhorstRegisters, Instrument
from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.modbus_rtu import RtuBus
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import (
    MemoryWire,
    ProparDevice,
    RtuBusEmulator,
    SerialDevice,
    SerialFaults,
)

LINE = SerialSettings(38_400)
Made = tuple[SerialDevice, Callable[[], ParameterPort], MemoryWire]


def flow(flows: list[float]) -> Instrument:
    return Instrument("DMFC", "M1234567A", 360.0, "mln/min", actuate=flows.append)


def pressure(value_mbar: float = 6.0, unit: str = "mbar(g)") -> Instrument:
    return Instrument("DEPC", "M7654321B", 10.0, unit, lambda: value_mbar)


def propar(instrument: Instrument) -> Made:
    device = ProparDevice(instrument, LINE)
    wire = MemoryWire(device)
    return device, lambda: ProparParameters(wire), wire


def modbus(instrument: Instrument) -> Made:
    device = RtuBusEmulator(
        LINE, {3: partial(answer_request, table=BronkhorstRegisters(instrument))}
    )
    wire = MemoryWire(device)
    return device, lambda: ModbusParameters(RtuBus(wire).device(3, 0.2)), wire


both = pytest.mark.parametrize("protocol", [propar, modbus])


def virtual(run: Coroutine[Any, Any, None]) -> None:
    run_virtual(run)


def test_the_frames_of_the_manual() -> None:
    instrument = Instrument("DMFC", "M1", 200.0, "mln/min", lambda: 123.456)
    device = ProparDevice(instrument, LINE)
    answers_sent: list[bytes] = []
    device.send_answer = answers_sent.append  # type: ignore[method-assign]
    device.received(b":06030421402140\r\n")
    assert answers_sent == [b":080302214042F6E979\r\n"]
    answer = parse_ascii(answers_sent[0])
    assert answer is not None
    assert parse_values(answer.data) == [(0x21, 0, bytes.fromhex("42F6E979"))]


def test_the_registers_of_the_manual() -> None:
    assert register_of(SETPOINT) == (0x0021, 1)
    assert register_of(CONTROL_MODE) == (0x0024, 1)
    assert register_of(FMEASURE) == (0xA100, 2)
    assert register_of(TEMPERATURE) == (0xA138, 2)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0])
def test_a_flow_that_is_no_number_is_refused_as_an_illegal_value(value: float) -> None:
    table = BronkhorstRegisters(flow([]))
    address, count = register_of(FSETPOINT)
    request = struct.pack(">BHHBf", WRITE_MULTIPLE, address, count, 2 * count, value)
    assert answer_request(request, table) == bytes([WRITE_MULTIPLE | 0x80, ILLEGAL_VALUE])


def test_binary_frames_survive_any_data_and_any_cut() -> None:
    rng = random.Random(1)
    messages = [
        ProparMessage(rng.randrange(256), rng.choice([3, 16, 128]), rng.randbytes(1 + n % 40))
        for n in range(300)
    ]
    messages.append(ProparMessage(16, 16, bytes([16] * 16)))
    stream = b"".join(binary_frame(message) for message in messages)
    found, rest = [], b""
    while stream:
        cut = rng.randrange(1, 20)
        whole, rest = split_binary(rest + stream[:cut])
        found += whole
        stream = stream[cut:]
    assert (found, rest) == (messages, b"")


def test_an_ascii_frame_is_read_back_and_a_broken_one_is_none() -> None:
    message = ProparMessage(0, 3, b"\x04\x21\x40\x21\x40")
    assert parse_ascii(ascii_frame(message)) == message
    for broken in (b"", b":", b":0603", b":07030421402140", b"06030421402140", b":0603042140214G"):
        assert parse_ascii(broken) is None


@both
def test_the_flow_controller_follows_the_command(protocol: Callable[[Instrument], Made]) -> None:
    flows: list[float] = []
    instrument = flow(flows)
    _, port, _ = protocol(instrument)

    async def run() -> None:
        device = BronkhorstFlow(port())
        found = await device.open()
        assert (found.kind, found.serial, found.detail) == (
            "Bronkhorst DMFC",
            "M1234567A",
            "0 .. 360 mln/min",
        )
        for fraction in (0.0, 0.25, 1.0, 1 / 3):
            await device.set_pump(fraction)
            assert await device.pump_fraction() == pytest.approx(fraction, abs=2e-5)
            assert flows[-1] == pytest.approx(fraction, abs=2e-5)
        await device.close()
        assert flows[-1] == 0.0

    virtual(run())


@both
def test_after_a_power_cycle_nothing_flows_until_it_is_opened_again(
    protocol: Callable[[Instrument], Made],
) -> None:
    flows: list[float] = []
    instrument = flow(flows)
    line, port, _ = protocol(instrument)

    async def run() -> None:
        device = BronkhorstFlow(port())
        await device.open()
        await device.set_pump(0.5)
        line.power_cycle()
        instrument.restart()
        assert flows[-1] == 0.0
        assert instrument.raw(CONTROL_MODE) == bytes([ANALOG_INPUT])
        assert await device.pump_fraction() == 0.0  # the read-back shows it
        await device.open()
        await device.set_pump(0.5)
        assert flows[-1] == 0.5
        await device.close()

    virtual(run())


@both
def test_the_pressure_meter_reads_pascals(protocol: Callable[[Instrument], Made]) -> None:
    _, port, _ = protocol(pressure(6.0))

    async def run() -> None:
        device = BronkhorstPressure(port())
        await device.open()
        assert await device.gauge_pressure_pa() == pytest.approx(600.0)
        await device.close()
        with pytest.raises(LinkDownError):
            await device.gauge_pressure_pa()

    virtual(run())


@both
@pytest.mark.parametrize(
    ("instrument", "serial", "words"),
    [
        (pressure(), "", "a DEPC answers, expected DMFC"),
        (flow([]), "M999", "serial number M1234567A answers, but the configuration names M999"),
    ],
)
def test_another_instrument_is_refused(
    protocol: Callable[[Instrument], Made], instrument: Instrument, serial: str, words: str
) -> None:
    _, port, _ = protocol(instrument)

    async def run() -> None:
        device = BronkhorstFlow(port(), serial)
        with pytest.raises(DeviceRefusedError, match=words):
            await device.open()
        await device.close()

    virtual(run())


@both
def test_a_pressure_against_vacuum_is_refused(protocol: Callable[[Instrument], Made]) -> None:
    _, port, _ = protocol(pressure(unit="bar(a)"))

    async def run() -> None:
        device = BronkhorstPressure(port())
        with pytest.raises(DeviceRefusedError, match=r"set it to a gauge pressure"):
            await device.open()
        await device.close()

    virtual(run())


@both
def test_a_pulled_plug_is_noticed_at_once_and_found_again(
    protocol: Callable[[Instrument], Made],
) -> None:
    _, port, wire = protocol(flow([]))

    async def run() -> None:
        loop = asyncio.get_running_loop()
        device = BronkhorstFlow(port())
        await device.open()
        begin_s = loop.time()
        reading = asyncio.create_task(device.pump_fraction())
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        wire.unplug()
        with pytest.raises(LinkDownError):
            await reading
        assert loop.time() - begin_s < 0.05  # not the time-out of 0.2 s
        with pytest.raises(LinkDownError):
            await device.open()
        wire.plugged = True
        await device.open()
        assert await device.pump_fraction() == 0.0
        await device.close()

    virtual(run())


def random_faults(rng: random.Random) -> SerialFaults:
    match rng.randrange(12):
        case 0:
            return SerialFaults(silent=True)
        case 1:
            return SerialFaults(delay_s=rng.uniform(0.1, 0.6))
        case 2:
            return SerialFaults(garbage_bytes=rng.randrange(1, 30))
        case 3 | 4:
            return SerialFaults(bit_errors=1)
        case 5:
            return SerialFaults(cut_bytes=rng.randrange(1, 8))
        case _:
            return SerialFaults()


@both
def test_no_wrong_value_is_accepted_under_random_faults(
    protocol: Callable[[Instrument], Made],
) -> None:
    """Every setpoint differs, so that any late, spoilt or shifted answer would show."""
    rng = random.Random(5)
    instrument = flow([])
    line, port, _ = protocol(instrument)
    accepted, refused = [0], [0]

    async def run() -> None:
        parameters = port()
        await parameters.connect()
        line.draw_faults = lambda: random_faults(rng)
        for _ in range(1500):
            instrument.write(SETPOINT, rng.randrange(32_001).to_bytes(2, "big"))
            true = int.from_bytes(instrument.raw(SETPOINT), "big")
            try:
                assert await parameters.number(SETPOINT) == true
                accepted[0] += 1
            except LinkDownError:  # too many failures in a row: the link's owner reopens it
                await parameters.connect()
            except LinkError:
                refused[0] += 1
        await parameters.close()

    virtual(run())
    assert accepted[0] > 400
    assert refused[0] > 200


def test_the_vendors_own_master_reads_and_writes_the_emulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import propar

    flows: list[float] = []
    path = tmp_path / "tty"

    def vendor() -> list[Any]:
        monkeypatch.setattr(propar, "_PROPAR_MASTERS", {})
        instrument = propar.instrument(str(path))
        instrument.master.propar.auto_reopen = False
        instrument.master.response_timeout = 20.0
        answers = [instrument.readParameter(number) for number in (90, 92, 129, 12)]
        answers.append(instrument.writeParameter(12, 0))
        answers.append(instrument.writeParameter(9, 8000))
        answers += [instrument.readParameter(number) for number in (9, 8, 205, 206)]
        answers.append(instrument.writeParameter(9, 40_000))  # above 100 %: refused
        answers.append(instrument.writeParameter(206, 180.0))
        chained = instrument.read_parameters(instrument.db.get_parameters([8, 9, 205, 129, 90]))
        answers.append([parameter["data"] for parameter in chained])
        instrument.master.propar.mode = propar.PP_MODE_ASCII
        answers += [instrument.readParameter(205), instrument.readParameter(92)]
        instrument.master.propar.run = False
        instrument.master.propar.serial_read_thread.join()
        # the handler's thread never ends and polls every millisecond: from now on it waits
        instrument.master.propar.read_propar_message = threading.Event().wait
        instrument.master.propar.serial.close()
        return answers

    async def run() -> list[Any]:
        wire = PtyWire(ProparDevice(flow(flows), LINE), path)
        wire.plug()
        try:
            return await asyncio.to_thread(vendor)
        finally:
            wire.unplug()

    assert asyncio.run(run()) == [
        *("DMFC", "M1234567A", "mln/min", ANALOG_INPUT),
        *(True, True, 8000, 8000, 90.0, 90.0),
        *(False, True),
        [16_000, 16_000, 180.0, "mln/min", "DMFC"],
        *(180.0, "M1234567A"),
    ]
    assert flows[-1] == 0.5
