"""A serial device that sends without end fills no memory: its question fails, and the next one may
succeed.
"""

from __future__ import annotations

import asyncio
import re

import pytest

from firmware_iface.emulators.rtu_bus import RtuBusEmulator
from firmware_iface.emulators.serial_device import LineDevice
from firmware_iface.links.exchange import SerialExchange, WireQuestion
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import LinkError


class FakePort:
    """A port whose bytes come from the test."""

    name = "port"
    settings = SerialSettings(9600)
    is_open = True

    def __init__(self) -> None:
        self.on_write = lambda: None

    def open(self, receiver: SerialExchange) -> None:
        """Nothing to open."""

    def write(self, data: bytes) -> None:
        """The test answers."""
        self.on_write()

    def succeeded(self) -> None:
        """An answer was good."""

    def close(self) -> None:
        """Nothing to close."""


@pytest.mark.parametrize("junk", [b"\r\n" * 5000, b"x" * 10_000])
async def test_an_answer_without_end_ends_the_question(junk: bytes) -> None:
    port = FakePort()
    exchange = SerialExchange(port, gap_s=0.0, quiet_s=0.01)  # type: ignore[arg-type]
    exchange.connect()
    question = WireQuestion(
        b"?", lambda heard: heard if re.fullmatch(b"ok\n", heard) else None, 3, "question"
    )
    received: list[int] = []

    def flood() -> None:
        for _ in range(100):
            exchange.received(junk)
            received.append(len(exchange._buffer))

    port.on_write = lambda: asyncio.get_running_loop().call_soon(flood)  # type: ignore[assignment,return-value]
    with pytest.raises(LinkError, match="bytes without an answer"):
        await exchange.ask(question, 5.0, None)
    assert max(received) <= len(junk) + 4096
    port.on_write = lambda: asyncio.get_running_loop().call_soon(exchange.received, b"ok\n")  # type: ignore[assignment,return-value]
    assert await exchange.ask(question, 1.0, None) == b"ok\n"


async def test_emulated_devices_keep_no_endless_line() -> None:
    class Quiet(LineDevice):
        """Ignores its lines."""

        def line(self, text: str) -> None:
            """Nothing to say."""

    device = Quiet(9600)
    bus = RtuBusEmulator(SerialSettings(9600), {})
    for _ in range(100):
        device.received(b"x" * 4096)
        bus.received(b"x" * 4096)
    assert len(device._buffer) <= 1024
    assert len(bus._buffer) <= 4096
