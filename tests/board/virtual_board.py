"""The C firmware in this process, its hardware in memory: time passes when the test says so."""

from __future__ import annotations

import ctypes
import struct
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from firmware_iface.board_settings import make_record
from firmware_iface.emulators.rtu_bus import compute_bitwise_crc
from firmware_iface.links.modbus_link import exception_error

NO_VALUE = -(2**31)
AT_REST = (0, 0, 101_325_000, 210_000, 220_000, 0)  # raw values of all channels with a flat film
SETTINGS = {"baud": 115_200, "parity": "N", "pressure_limit_pa": 800.0, "pump_limit_fraction": 1.0}
# heard at the next turn of the main loop, answered at the first one after a silence of 1750 us
_ANSWERED_US = 3000
_ASKED_US = 4000


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """A frame with its CRC, which is not the link's."""
    body = bytes([unit]) + pdu
    return body + struct.pack("<H", compute_bitwise_crc(body))


class VirtualBoard:
    """One board; the library's state is global, so that only one lives at a time."""

    def __init__(self, library: Path, settings: Mapping[str, Any] = SETTINGS) -> None:
        self._path = library
        self.chip = ctypes.CDLL(str(library))
        self.now_us = self.answered_us = 0
        self.power_on(make_record(settings))

    def power_on(self, settings: bytes) -> None:
        """Supply off and on, with this record in the flash."""
        self.now_us = 0
        self.chip.virtual_power_on(settings, len(settings))

    def pass_us(self, time_us: int, *, interrupts: bool = True, main_loop: bool = True) -> None:
        """Let time pass."""
        self.now_us += time_us
        self.chip.virtual_pass(time_us, interrupts, main_loop)

    def set_inputs(self, raws: Sequence[int]) -> None:
        """The raw values of all channels: displacement, gauge, ambient, air, gas, quality."""
        for channel, raw in enumerate(raws):
            self.chip.virtual_set_input(channel, raw)

    def set_interlocks(self, closed: int) -> None:
        """Close these interlock inputs, and open the others."""
        self.chip.virtual_set_interlocks(closed)

    @property
    def outputs(self) -> tuple[int, int]:
        """Counts that pump and vent get."""
        return self.chip.virtual_pump(), self.chip.virtual_vent()

    @property
    def resets(self) -> int:
        """Of the processor since power-on."""
        return int(self.chip.virtual_resets())

    def hear(self, data: bytes) -> None:
        """Bytes arrive on the line, all at once."""
        self.chip.virtual_hear(data, len(data))

    def read_sent(self) -> bytes:
        """What the board sent since the last call."""
        room = ctypes.create_string_buffer(1024)
        count = self.chip.virtual_said(room, len(room))
        return room.raw[:count]

    def ask_frame(self, frame: bytes) -> bytes:
        """The bytes with which the board answers a frame, 3 ms after it; the whole takes 4 ms."""
        self.hear(frame)
        self.pass_us(_ANSWERED_US)
        self.answered_us = self.now_us
        self.pass_us(_ASKED_US - _ANSWERED_US)
        return self.read_sent()

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        """The answer to a request over RTU; empty for none."""
        answer = self.ask_frame(rtu_frame(unit, pdu))
        assert not answer or answer == rtu_frame(unit, answer[1:-2])
        return answer[1:-2]

    def read(self, address: int, count: int) -> list[int]:
        """Words; the board must have them."""
        answer = self.ask(struct.pack(">BHH", 3, address, count))
        assert answer[0] == 3, answer
        return list(struct.unpack(f">{count}H", answer[2:]))

    def memory(self) -> dict[str, tuple[int, int]]:
        """Address and length of the variables of the firmware, by name."""
        listing = subprocess.run(
            ["nm", "--print-size", str(self._path)], check=True, capture_output=True, text=True
        ).stdout
        rows = [line.split() for line in listing.splitlines()]
        found = {
            row[3]: (int(row[0], 16), int(row[1], 16))
            for row in rows
            if len(row) == 4 and row[2] in "bBdDtT"
        }
        anchor = ctypes.cast(self.chip.board_tick, ctypes.c_void_p).value
        assert anchor is not None
        base = anchor - found["board_tick"][0]
        return {name: (base + at, length) for name, (at, length) in found.items()}


class VirtualLink:
    """A Modbus link to a virtual board, for the conformance test and the driver."""

    name = "virtual"
    connected = True

    def __init__(self, board: VirtualBoard) -> None:
        self._board = board

    async def sleep(self, time_s: float) -> None:
        """Virtual time instead of asyncio.sleep."""
        self._board.pass_us(round(time_s * 1e6))

    async def connect(self) -> None:
        """A wire in memory is always up."""

    async def close(self) -> None:
        """It stays so."""

    def _ask(self, pdu: bytes) -> bytes:
        answer = self._board.ask(pdu)
        if answer[0] & 0x80:
            raise exception_error("virtual", answer[1])
        return answer

    async def read_holding(self, address: int, count: int) -> list[int]:
        """Function code 3."""
        return list(
            struct.unpack(f">{count}H", self._ask(struct.pack(">BHH", 3, address, count))[2:])
        )

    async def read_input(self, address: int, count: int) -> list[int]:
        """Function code 4, which the board does not have."""
        raise NotImplementedError

    async def write_register(self, address: int, word: int) -> None:
        """Function code 6."""
        self._ask(struct.pack(">BHH", 6, address, word))

    async def write_registers(self, address: int, words: Sequence[int]) -> None:
        """Function code 16."""
        self._ask(
            struct.pack(f">BHHB{len(words)}H", 16, address, len(words), 2 * len(words), *words)
        )
