"""Instruments that follow their manuals in other ways than our emulators: line ends, echo, junk at
power-up.
"""

from __future__ import annotations

import asyncio

import pytest

from firmware_iface.drivers.keyence_dl_rs1a import KeyenceDlRs1a
from firmware_iface.drivers.optoncdt1420 import Optoncdt1420
from firmware_iface.drivers.ventus import Ventus
from firmware_iface.settings import KeyenceDlRs1aConfig, Optoncdt1420Config, VentusConfig
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import (
    KeyenceDlRs1aEmulator,
    MemoryWire,
    Optoncdt1420Emulator,
    VentusEmulator,
)

BANNER = b"\r\nboot 1.2 \x00\xff ready\r\n"


class WordyOptoncdt(Optoncdt1420Emulator):
    """Echoes commands, writes units and zeros, ends its prompt with a line,
    and was left streaming.
    """

    rate = "4.00"

    def __init__(self) -> None:
        super().__init__(lambda: 12.0, name="optoNCDT 1420-50")
        self._register["OUTPUT"] = "RS422"

    def line(self, text: str) -> None:
        self._echo = text
        super().line(text)

    def send_answer(self, answer: bytes) -> None:
        if answer.endswith(b"->"):
            answer = answer.replace(b"MEASRATE 4\r", b"MEASRATE " + self.rate.encode() + b"\r")
            answer = self._echo.encode() + b"\r\n" + answer + b"\r\n"
        super().send_answer(answer)


@pytest.mark.parametrize("rate", ["4.00", "4 kHz", "4.kHz"])
def test_a_wordy_optoncdt(rate: str) -> None:
    async def test() -> None:
        emulator = WordyOptoncdt()
        emulator.rate = rate
        driver = Optoncdt1420(Optoncdt1420Config(port="memory"), MemoryWire(emulator))
        assert (await driver.open()).kind == "optoNCDT 1420-50"
        await asyncio.sleep(0.02)
        assert (await driver.displacement()).displacement_um == pytest.approx(12.0, abs=1.0)
        await driver.close()

    run_virtual(test())


class TerseKeyence(KeyenceDlRs1aEmulator):
    """Ends lines in CR alone, or sends the LF by itself; its amplifiers tell no state; it greets
    when plugged in.
    """

    def __init__(self, end: tuple[bytes, ...]) -> None:
        super().__init__(lambda: -123.0, baud=38_400, parity="E")
        self._end = end

    def line(self, text: str) -> None:
        if text:
            super().line("SR,00,999" if text == "SR,00,033" else text)

    def send_answer(self, answer: bytes) -> None:
        super().send_answer(answer.rstrip(b"\r\n") + self._end[0])
        for more in self._end[1:]:
            super().send_answer(more)


@pytest.mark.parametrize(
    "end", [(b"\r",), (b"\r", b"\n"), (b"\r\n",)], ids=["CR", "CR, then LF", "CRLF"]
)
def test_a_terse_keyence(end: tuple[bytes, ...]) -> None:
    async def test() -> None:
        emulator = TerseKeyence(end)
        wire = MemoryWire(emulator)
        driver = KeyenceDlRs1a(KeyenceDlRs1aConfig(port="memory", baud=38_400, parity="E"), wire)
        opening = asyncio.ensure_future(driver.open())
        await asyncio.sleep(0)
        emulator._transmit_bytes(BANNER)
        await opening
        begin_s = asyncio.get_running_loop().time()
        for _ in range(10):
            assert (await driver.displacement()).displacement_um == -123.0
        assert (
            asyncio.get_running_loop().time() - begin_s < 10 * 0.02
        )  # a line end by itself is no noise to wait for
        await driver.close()

    run_virtual(test())


class OtherVentus(VentusEmulator):
    """Ends lines in CR LF, writes every number with six decimals, and was left streaming."""

    def __init__(self, driven: list[float]) -> None:
        super().__init__(driven.append, streaming=True)

    def _read(self, number: int) -> None:
        if number in self.registers:
            self.send_answer(f"#R{number},{self.registers[number]:.6f}\r\n".encode())


def test_another_ventus() -> None:
    async def test() -> None:
        driven: list[float] = []
        driver = Ventus(VentusConfig(port="memory"), MemoryWire(OtherVentus(driven)))
        await driver.open()
        await driver.set_pump(0.25)
        assert driven[-1] == await driver.pump_fraction() == 0.25
        await driver.close()
        assert driven[-1] == 0.0

    run_virtual(test())
