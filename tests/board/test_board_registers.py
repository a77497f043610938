"""The C firmware and the Python emulator, which share no code, agree on every register after random
transactions.
"""

from __future__ import annotations

import math
import os
import random
import struct

import pytest

from firmware_iface.board_settings import make_record
from firmware_iface.emulators import pump_board
from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.register_map import Block, load_default_map
from tests.board.virtual_board import NO_VALUE, SETTINGS, VirtualBoard

# after a request until the outputs are compared: a sample lies in it, so that both boards know the
# same
_SETTLED_MS = 7
_KEYS = (0x12345678, 0x12340000, 0x00005678, 0xFFFFFFFF, 0)
_MAP = load_default_map()
_WRITABLE = [block for block in _MAP.blocks if block.access == "rw"]
# odd, and what happens comes at even distances: no feed is exactly a period old, where one clock
# rounds up
_PERIODS_MS = (51, 75, 101, 333, 1001, 9999)
_SAMPLE_MS = 5
# short, so that they expire often; a microsecond more, because a sum of floats ends beside the
# firmware's integers
_TIMEOUT_S, _FROZEN_S, _FITTED = 0.401, 1.501, 0b101
_STORED = pump_board.StoredSettings(True, _TIMEOUT_S + 1e-6, _FROZEN_S + 1e-6, _FITTED)
_PROTECTION = {
    "gauge_timeout_s": _TIMEOUT_S,
    "gauge_frozen_s": _FROZEN_S,
    "interlocks_fitted": [0, 2],
}


class Twins:
    """A C board and a Python board with the same sensors, time and requests."""

    def __init__(self, board: VirtualBoard, chance: random.Random) -> None:
        self.c = board
        self.chance = chance
        self.raws = [0, 0, 101_325_000, 210_000, 220_000, 0]
        self.interlocks = 0xFFFF
        board.power_on(make_record({**SETTINGS, **_PROTECTION}))
        self._wire()
        self.python_ms = 0
        self._sampled = self._sample()
        self.python = pump_board.BoardState(_MAP, self._sampled, _STORED)
        self.c.pass_us(10_000)
        self._follow(self.c.now_us)

    def _wire(self) -> None:
        self.c.set_inputs(self.raws)
        self.c.set_interlocks(self.interlocks)

    def _follow(self, to_us: int) -> None:
        """Let the Python board run through the firmware's ticks; it samples at the first one, then
        at every fifth.
        """
        while self.python_ms < to_us // 1000:
            self.python_ms += 1
            if (self.python_ms - 1) % _SAMPLE_MS == 0:
                self._sampled = self._sample()
            self.python.advance(self.python_ms / 1e3, self._sampled)

    def change_sensors(self, good: bool = False) -> None:
        self._follow(self.c.now_us)  # with the former values
        wide = [self.chance.randint(-(2**31) + 1, 2**31 - 1) for _ in range(5)]
        self.raws = [NO_VALUE if self.chance.random() < 0.2 else raw for raw in wide]
        self.raws[1] = self.chance.choice(
            [NO_VALUE, 0, -5_000, 799_999, 800_000, 800_001, 2_000_000, 100, 200]
        )
        self.raws.append(self.chance.choice([0, 0, 1, 65_535, 262]))
        self.interlocks = self.chance.choice([0xFFFF] * 8 + [0b101, 0b001, 0b100])
        if good:
            self.raws[1], self.interlocks = self.chance.randrange(100, 1000), 0xFFFF
        self._wire()
        self.c.pass_us(10_000)

    def _sample(self) -> pump_board.BoardSample:
        count = (max(1, self.python_ms) - 1) // _SAMPLE_MS + 1
        values = [math.nan if raw == NO_VALUE else raw for raw in self.raws[:5]]
        displacement, gauge, ambient, air, gas = values
        return pump_board.BoardSample(
            displacement / 1000,
            self.raws[5],
            gauge / 1000,
            ambient / 1000,
            air / 10_000,
            gas / 10_000,
            count,
            (1 + _SAMPLE_MS * (count - 1)) / 1000 + 1e-6,
            self.interlocks,
        )

    def ask(self, pdu: bytes) -> None:
        answer = self.c.ask(pdu)
        self._follow(self.c.answered_us)
        assert answer == answer_request(pdu, self.python), (
            f"request {pdu.hex()} at {self.c.answered_us} us"
        )
        self.c.pass_us(1000 * _SETTLED_MS)
        self._follow(self.c.now_us)
        assert self.c.outputs == tuple(
            round(50_000 * fraction)
            for fraction in (self.python.pump_fraction, self.python.vent_fraction)
        )
        self.c.pass_us(1000)

    def run_pump(self) -> None:
        """Claim, clear and command with good sensors, so that the pump runs unless a stranger holds
        the board.
        """
        self.change_sensors(good=True)
        key = int(self.python._claim_key) or 9
        claim = {"claim_id": 7, "claim_key": key, "command_key": key, "clear_key": key}
        for name, values in (
            ("settings", {"watchdog_period_s": 9.999, "watchdog_arm": 1}),
            ("reset", {"clear_faults": 0xFFFF}),
            (
                "command",
                {
                    "pump_command_fraction": 0.5,
                    "vent_command_fraction": 0.25,
                    "heartbeat": self._beat(),
                },
            ),
        ):
            block = _MAP.block(name)
            words = block.encode(claim | values)
            self.ask(
                struct.pack(
                    f">BHHB{len(words)}H", 16, block.address, len(words), 2 * len(words), *words
                )
            )

    def _beat(self) -> int:
        return self.chance.randrange(2**16)

    def compare(self) -> None:
        for block in _MAP.blocks:
            self.ask(struct.pack(">BHH", 3, block.address, block.count))


def _word(chance: random.Random) -> int:
    return chance.choice(
        [0, 1, 2, 50, 51, 10_000, 10_001, 49_999, 50_000, 50_001, 0xFFFF, chance.randrange(2**16)]
    )


def _good_words(block: Block, chance: random.Random) -> list[int]:
    key = chance.choice(_KEYS[:3])
    values = {
        "watchdog_period_s": chance.choice(_PERIODS_MS) / 1000,
        "watchdog_arm": chance.randrange(4) > 0,
        "claim_id": chance.choice([7, 2**31, 2**32 - 1]),
        "claim_key": key,
        "pump_command_fraction": chance.choice([0.0, 0.05, 1.0]),
        "vent_command_fraction": chance.choice([0.0, 1.0]),
        "heartbeat": chance.randrange(4),
        "command_key": key,
        "clear_faults": chance.choice([0, 1, 2, 4, 7, 8, 16, 0xFFFF]),
        "clear_key": key,
        "stop": 1,
    }
    words = block.encode(values)
    if chance.random() < 0.15:
        at = chance.randrange(len(words))
        if block.address + at != 48:  # the periods stay odd
            words[at] = _word(chance)
    return words


def _pdu(chance: random.Random) -> bytes:
    kind = chance.random()
    if kind < 0.45:
        block = chance.choices(_WRITABLE, weights=(4, 6, 2, 1))[0]
        words = _good_words(block, chance)
        if chance.random() < 0.2:
            head = struct.pack(
                ">BHH", 23, *chance.choice([(16, 26), (0, 11), (48, 6), (41, 1), (16, 126), (0, 0)])
            )
        else:
            head = bytes([16])
        return head + struct.pack(
            f">HHB{len(words)}H", block.address, len(words), 2 * len(words), *words
        )
    if kind < 0.65:
        return struct.pack(
            ">BHH",
            3,
            chance.choice([*range(76), 0xFFFF]),
            chance.choice([*range(30), 125, 126, 0xFFFF]),
        )
    if kind < 0.8:
        return struct.pack(">BHH", 6, chance.choice([*range(76), 0xFFFF]), _word(chance))
    if kind < 0.9:
        count = chance.randrange(1, 8)
        data = [_word(chance) for _ in range(count)]
        address = chance.choice([49, 50, 52, 56, 57, 64, 71, 72, 16, 60])
        return struct.pack(f">BHHB{count}H", 16, address, count, 2 * count, *data)
    return bytes([chance.choice([3, 6, 16, 23, 23, 1, 4, 43, 0x83])]) + chance.randbytes(
        chance.randrange(0, 20)
    )


def _transactions(board: VirtualBoard, seed: int, count: int) -> None:
    chance = random.Random(seed)
    twins = Twins(board, chance)
    for _ in range(count):
        twins.ask(_pdu(chance))
        if chance.random() < 0.05:
            twins.run_pump()
        if chance.random() < 0.1:
            twins.change_sensors()
        if chance.random() < 0.02:
            twins.c.pass_us(2000 * chance.randrange(1, 600))
        if chance.random() < 0.2:
            twins.compare()


def test_every_register_agrees_after_random_transactions(virtual_board: VirtualBoard) -> None:
    _transactions(virtual_board, seed=1, count=1500)


@pytest.mark.campaign
def test_every_register_agrees_after_many_random_transactions(virtual_board: VirtualBoard) -> None:
    _transactions(
        virtual_board, int(os.environ.get("SEED", "2")), int(os.environ.get("COUNT", "100000"))
    )
