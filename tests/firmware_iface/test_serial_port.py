"""Serial ports on pseudo-terminals: what the kernel reports of a port, and names that survive a
replug.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from firmware_iface.emulators.serial_device import PtyWire
from firmware_iface.links.modbus_rtu import RtuBus
from firmware_iface.links.port_names import check_port_name, list_serial_ports, resolve_port_path
from firmware_iface.links.serial_port import SerialPort, SerialSettings
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError
from tests.worlds.faulty_devices import RtuBusEmulator, SerialDevice

LINE = SerialSettings(115_200)
GUARD_S = 5.0


class Echo(SerialDevice):
    """Echoes its input."""

    def received(self, data: bytes) -> None:
        self.send_answer(data)


class Ear:
    """Keeps its input."""

    def __init__(self) -> None:
        self.data = b""
        self.error: LinkDownError | None = None
        self.stir = asyncio.Event()

    def received(self, data: bytes) -> None:
        self.data += data
        self.stir.set()

    def lost(self, error: LinkDownError) -> None:
        self.error = error
        self.stir.set()

    async def hears(self, count: int) -> bytes:
        async with asyncio.timeout(GUARD_S):
            while len(self.data) < count and self.error is None:
                self.stir.clear()
                await self.stir.wait()
        return self.data


@pytest.fixture
async def wire(tmp_path: Path) -> AsyncIterator[PtyWire]:
    made = PtyWire(Echo(LINE), tmp_path / "tty")
    made.plug()
    yield made
    made.unplug()


async def test_bytes_go_out_and_come_back(wire: PtyWire) -> None:
    port, ear = SerialPort(str(wire.path), LINE), Ear()
    port.open(ear)
    everything = bytes(range(256))  # none of them means anything to the terminal
    port.write(everything)
    assert await ear.hears(256) == everything
    port.close()
    assert not port.is_open


async def test_a_pulled_plug_is_noticed_by_itself(wire: PtyWire) -> None:
    port, ear = SerialPort(str(wire.path), LINE), Ear()
    port.open(ear)
    port.succeeded()
    wire.unplug()
    await ear.hears(1)
    assert ear.error is not None
    assert "unplugged" in str(ear.error)
    assert not port.is_open
    with pytest.raises(LinkDownError, match="not open"):
        port.write(b"a")
    with pytest.raises(LinkDownError, match="no such port"):
        port.open(ear)


async def test_a_write_notices_it_too(wire: PtyWire) -> None:
    port, ear = SerialPort(str(wire.path), LINE), Ear()
    port.open(ear)
    wire.unplug()
    with pytest.raises(LinkDownError, match="the port is gone"):
        port.write(b"a")
    assert ear.error is not None


async def test_a_port_that_is_back_is_opened_at_once(tmp_path: Path) -> None:
    now_s = 0.0
    wire = PtyWire(Echo(LINE), tmp_path / "tty")
    port = SerialPort(str(wire.path), LINE, clock=lambda: now_s)
    for _ in range(600):  # a minute of trying
        with pytest.raises(LinkDownError):
            port.open(Ear())
        now_s += 0.1
    wire.plug()
    assert port.retry_in_s <= 0.1
    now_s += 0.1
    port.open(Ear())
    port.close()
    wire.unplug()


async def test_a_port_that_opens_but_never_answers_is_left_alone(wire: PtyWire) -> None:
    now_s = 0.0
    port, opened = SerialPort(str(wire.path), LINE, clock=lambda: now_s), 0
    for _ in range(100):  # ten seconds
        try:
            port.open(Ear())
            opened += 1
        except LinkDownError:
            pass
        now_s += 0.1
    assert 6 <= opened <= 8  # at 0, 0.1, 0.3, 0.7, 1.5, 3.1, 6.3 s
    port.succeeded()
    assert port.retry_in_s == 0
    port.close()


async def test_a_port_in_use_is_reported_as_such(wire: PtyWire) -> None:
    first, second = SerialPort(str(wire.path), LINE), SerialPort(str(wire.path), LINE)
    first.open(Ear())
    with pytest.raises(LinkDownError, match="in use by another program"):
        second.open(Ear())
    first.close()


async def test_a_file_that_is_no_port_is_reported_as_such(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("")
    with pytest.raises(DeviceRefusedError, match="not a serial port"):
        SerialPort(str(file), LINE).open(Ear())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"baud": 12_345}, "baud = 12345"),
        ({"baud": 9600, "parity": "X"}, "parity N, E or O"),
        ({"baud": 9600, "data_bits": 9}, "7 or 8 data bits"),
    ],
)
def test_settings_that_lines_do_not_have(settings: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SerialSettings(**settings)  # type: ignore[arg-type]


def test_the_time_of_a_character() -> None:
    assert SerialSettings(9600).char_s == pytest.approx(10 / 9600)
    assert SerialSettings(4800, data_bits=7, parity="E").char_s == pytest.approx(10 / 4800)
    assert SerialSettings(9600, parity="E", stop_bits=2).char_s == pytest.approx(12 / 9600)


@dataclass
class Found:
    device: str
    vid: int | None = 0x0403
    pid: int | None = 0x6001
    serial_number: str | None = None
    description: str = "USB serial"


PORTS = [
    Found("/dev/ttyUSB1", serial_number="B2"),
    Found("/dev/ttyUSB0", serial_number="A1"),
    Found("/dev/ttyS0", None),
]


def test_a_usb_name_finds_its_adapter() -> None:
    assert resolve_port_path("usb:0403:6001:B2", lambda: PORTS) == "/dev/ttyUSB1"
    assert resolve_port_path("usb:0403:6001", lambda: PORTS[:1]) == "/dev/ttyUSB1"
    assert resolve_port_path("/dev/anything", lambda: PORTS) == "/dev/anything"
    with pytest.raises(LinkDownError, match="no such USB adapter"):
        resolve_port_path("usb:0403:6015", lambda: PORTS)
    with pytest.raises(
        DeviceRefusedError, match=r"2 adapters match.*usb:0403:6001:A1, usb:0403:6001:B2"
    ):
        resolve_port_path("usb:0403:6001", lambda: PORTS)


def test_ports_are_listed_with_the_name_to_use() -> None:
    listed = list_serial_ports(lambda: PORTS)
    assert [(port.path, port.usb_name) for port in listed] == [
        ("/dev/ttyS0", ""),
        ("/dev/ttyUSB0", "usb:0403:6001:A1"),
        ("/dev/ttyUSB1", "usb:0403:6001:B2"),
    ]


@pytest.mark.parametrize("name", ["ttyUSB0", "usb:403:6001", "usb:0403", "COM1", ""])
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(ValueError, match="usb:VID:PID"):
        check_port_name(name)


async def test_modbus_through_the_kernel_and_a_replug(tmp_path: Path) -> None:
    slaves = {1: lambda pdu: bytes([3, 2, 0, 42])}
    wire = PtyWire(RtuBusEmulator(LINE, slaves), tmp_path / "tty")
    wire.plug()
    device = RtuBus(SerialPort(str(wire.path), LINE), quiet_s=0.02).device(1, timeout_s=0.2)
    await device.connect()
    assert await device.read_holding(0, 1) == [42]
    wire.unplug()
    with pytest.raises(LinkDownError):
        await device.read_holding(0, 1)
    wire.plug()
    await device.connect()
    assert await device.read_holding(0, 1) == [42]
    await device.close()
    wire.unplug()


async def test_a_wrong_baud_rate_is_named_as_a_possible_cause(tmp_path: Path) -> None:
    wire = PtyWire(Echo(SerialSettings(9600)), tmp_path / "tty")
    wire.plug()
    device = RtuBus(SerialPort(str(wire.path), LINE), quiet_s=0.02).device(1, timeout_s=0.1)
    await device.connect()
    with pytest.raises(LinkError, match=r"answer from unit|wrong baud|function code"):
        await device.read_holding(0, 1)
    await device.close()
    wire.unplug()
