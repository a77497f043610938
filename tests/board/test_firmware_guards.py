"""The C firmware's guard of its gauge, and its interlock inputs: the pump stops in time and stays
off.
"""

from __future__ import annotations

import ctypes
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest

from firmware_iface.board_settings import make_record
from firmware_iface.register_map import load_default_map
from tests.board.test_board_faults import command, run_pump, sensors, write
from tests.board.virtual_board import NO_VALUE, SETTINGS, VirtualBoard

_KEY = 0x1234_5678
_MAP = load_default_map()
_GAUGE_LOST, _INTERLOCK = (_MAP.make_fault_mask(name) for name in ("gauge_lost", "interlock"))
_TICK_US, _SAMPLE_US = 1000, 5000
_RUNNING, _STOPPED = (25_000, 12_500), (0, 12_500)
_CLEAR = write("reset", {"clear_faults": 0xFFFF, "clear_key": _KEY})
_PROTECTION_AT = 38  # word of the record
_WORDS = 43


def made(library: Path, **changes: Any) -> VirtualBoard:
    """A board with these settings, its pump running, its watchdog's period at its longest."""
    board = VirtualBoard(library, {**SETTINGS, **changes})
    board.set_interlocks(0xFFFF)
    run_pump(board, 10.0)
    return board


def set_gauge(board: VirtualBoard, raw: int) -> None:
    board.chip.virtual_set_input(1, raw)


def next_beat(board: VirtualBoard) -> int:
    return int(sensors(board)["heartbeat_echo"]) % 1000 + 1


def pump_on(board: VirtualBoard) -> None:
    """One more command, with the pump at 0.5."""
    assert board.ask(command(next_beat(board)))[0] == 16


def test_the_pump_is_off_in_the_first_millisecond_after_the_time_out(
    firmware_library: Path,
) -> None:
    board = made(firmware_library, gauge_timeout_s=2.0)
    board.pass_us(board.now_us % _SAMPLE_US and _SAMPLE_US - board.now_us % _SAMPLE_US)
    set_gauge(board, NO_VALUE)
    board.pass_us(_TICK_US)  # sampled here, for the first time without a value
    board.pass_us(2_000_000 - _TICK_US)
    assert board.outputs == _RUNNING
    board.pass_us(_TICK_US)
    assert board.outputs == _STOPPED
    assert sensors(board)["latched_faults"] == _GAUGE_LOST


def test_a_gauge_out_of_its_plausible_range_is_lost(firmware_library: Path) -> None:
    gauge = {
        "points": [[13_107, 0.0], [65_535, 1000.0]],
        "plausible_raw": [11_796, 65_534],
    }  # 4..20 mA
    for raw in (11_795, 65_535, 0):
        board = VirtualBoard(
            firmware_library,
            {**SETTINGS, "gauge_timeout_s": 1.0, "channel": {"gauge_pressure_pa": gauge}},
        )
        board.set_inputs([0, 13_107, 0, 0, 0, 0])
        board.ask(
            write(
                "settings",
                {"watchdog_period_s": 10.0, "watchdog_arm": 1, "claim_id": 7, "claim_key": _KEY},
            )
        )
        board.ask(command(1))
        assert board.outputs == _RUNNING
        set_gauge(board, raw)
        board.pass_us(1_010_000)
        assert (board.outputs, sensors(board)["latched_faults"]) == (_STOPPED, _GAUGE_LOST)


def test_without_the_setting_the_time_out_is_fifteen_seconds(firmware_library: Path) -> None:
    board = made(firmware_library)
    set_gauge(board, NO_VALUE)
    for _ in range(2):
        board.pass_us(7_000_000)
        pump_on(board)
    assert board.outputs == _RUNNING
    board.pass_us(1_010_000)
    assert (board.outputs, sensors(board)["latched_faults"]) == (_STOPPED, _GAUGE_LOST)


def test_a_gauge_that_comes_back_in_time_starts_the_time_out_again(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_timeout_s=1.0)
    for raw in range(8):
        set_gauge(board, NO_VALUE)
        board.pass_us(900_000)
        set_gauge(board, raw)
        board.pass_us(_SAMPLE_US)
    assert board.outputs == _RUNNING


def test_clearing_without_a_gauge_does_not_run_the_pump(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_timeout_s=1.0)
    set_gauge(board, NO_VALUE)
    board.pass_us(1_010_000)
    for _ in range(20):
        assert board.ask(_CLEAR)[0] == 16
        pump_on(board)
        assert board.outputs == _STOPPED
        assert sensors(board)["latched_faults"] == _GAUGE_LOST
        board.pass_us(200_000)
    set_gauge(board, 5)
    board.pass_us(_SAMPLE_US)
    assert board.outputs == _STOPPED  # latched, although the gauge is back
    board.ask(_CLEAR)
    assert board.outputs == _STOPPED
    pump_on(board)
    assert board.outputs == _RUNNING


def test_a_command_without_a_gauge_does_not_drive_the_pump_for_a_single_tick(
    virtual_board: VirtualBoard,
) -> None:
    virtual_board.ask(
        write(
            "settings",
            {"watchdog_period_s": 10.0, "watchdog_arm": 1, "claim_id": 7, "claim_key": _KEY},
        )
    )
    words = _MAP.block("command").encode(
        {
            "pump_command_fraction": 1,
            "vent_command_fraction": 0,
            "heartbeat": 5,
            "command_key": _KEY,
        }
    )
    assert virtual_board.chip.board_write(56, 5, _words(words)) == 0
    assert virtual_board.read(32, 1) == [0]
    for _ in range(10):
        virtual_board.pass_us(_TICK_US)
        assert virtual_board.outputs == (0, 0)
    assert sensors(virtual_board)["latched_faults"] == _GAUGE_LOST


def _words(words: list[int]) -> Any:
    return (ctypes.c_uint16 * len(words))(*words)


def test_a_pump_at_rest_needs_no_gauge(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_timeout_s=1.0)
    board.ask(command(2, pump=0.0))
    set_gauge(board, NO_VALUE)
    board.pass_us(5_000_000)
    assert sensors(board)["latched_faults"] == 0


def test_a_lost_gauge_does_not_expire(firmware_library: Path) -> None:
    """A counter of microseconds wraps after 71 minutes."""
    board = made(firmware_library)
    board.ask(command(2, pump=0.0))
    set_gauge(board, NO_VALUE)
    for _ in range(100):
        board.chip.virtual_skip(60_000_000)
        board.pass_us(10 * _TICK_US)
        board.ask(_CLEAR)
        pump_on(board)
        assert board.outputs == _STOPPED


def test_a_gauge_that_repeats_its_value_stops_the_pump(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_frozen_s=2.0)
    for raw in range(1, 10):
        set_gauge(board, raw)
        board.pass_us(1_900_000)
        pump_on(board)
    board.pass_us(300_000)
    assert (board.outputs, sensors(board)["latched_faults"]) == (_STOPPED, _GAUGE_LOST)
    board.ask(_CLEAR)
    pump_on(board)
    board.pass_us(1_900_000)
    assert board.outputs == _RUNNING  # a gauge at rest shows only now whether it works
    board.pass_us(200_000)
    assert board.outputs == _STOPPED


def test_a_gauge_at_rest_may_repeat_its_value(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_frozen_s=2.0)
    for _ in range(5):
        board.ask(command(next_beat(board), pump=0.0))
        board.pass_us(9_000_000)
    pump_on(board)
    board.pass_us(1_900_000)
    assert board.outputs == _RUNNING


def test_the_judgement_of_a_frozen_gauge_can_be_switched_off(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_frozen_s=0)
    for _ in range(80):
        board.pass_us(9_000_000)
        pump_on(board)
    assert board.outputs == _RUNNING


def test_a_board_without_a_fitted_gauge_pumps_without_one(firmware_library: Path) -> None:
    board = made(firmware_library, gauge_fitted=False)
    set_gauge(board, NO_VALUE)
    for _ in range(10):
        board.pass_us(9_000_000)
        pump_on(board)
    assert board.outputs == _RUNNING


def test_an_open_input_stops_the_pump_within_a_sample(firmware_library: Path) -> None:
    board = made(firmware_library, interlocks_fitted=[1, 15])
    board.set_interlocks(0x8002)
    board.pass_us(1_000_000)
    assert board.outputs == _RUNNING
    for closed in (0x8000, 0x0002, 0x7FFD):
        board = made(firmware_library, interlocks_fitted=[1, 15])
        board.set_interlocks(closed)
        board.pass_us(_SAMPLE_US)
        assert board.outputs == _STOPPED
        found = sensors(board)
        assert (found["latched_faults"], found["interlock_inputs"]) == (_INTERLOCK, closed)


def test_an_input_that_closes_again_needs_a_person(firmware_library: Path) -> None:
    board = made(firmware_library, interlocks_fitted=[0])
    board.ask(command(2, pump=0.0))
    board.set_interlocks(0xFFFE)
    board.pass_us(_SAMPLE_US)
    board.ask(_CLEAR)
    pump_on(board)
    assert (board.outputs, sensors(board)["latched_faults"]) == (_STOPPED, _INTERLOCK)
    board.set_interlocks(0xFFFF)
    board.pass_us(_SAMPLE_US)
    pump_on(board)
    assert board.outputs == _STOPPED
    board.ask(_CLEAR)
    assert board.outputs == _STOPPED
    pump_on(board)
    assert board.outputs == _RUNNING


def test_inputs_that_are_not_fitted_do_nothing(firmware_library: Path) -> None:
    board = made(firmware_library)
    board.set_interlocks(0)
    board.pass_us(100_000)
    assert board.outputs == _RUNNING


def _sealed(words: list[int]) -> bytes:
    body = struct.pack(f">{len(words)}I", *words)
    return body + struct.pack(">I", zlib.crc32(body))


def _record_words() -> list[int]:
    return list(struct.unpack(f">{_WORDS}I", make_record(SETTINGS)))[:-1]


def test_a_record_of_an_earlier_board_means_that_the_gauge_is_fitted(
    virtual_board: VirtualBoard,
) -> None:
    earlier = _record_words()[:_PROTECTION_AT]
    earlier[1] = 4 * (_PROTECTION_AT + 1)
    for rest in (b"", b"\xff" * 40):  # what lies in the flash behind it
        virtual_board.power_on(_sealed(earlier) + rest)
        virtual_board.pass_us(10_000)
        block = _MAP.block("identity")
        found = block.decode(virtual_board.read(block.address, block.count))
        assert (found["gauge_fitted"], found["gauge_timeout_s"], found["gauge_frozen_s"]) == (
            1,
            15.0,
            60.0,
        )
        assert (found["interlocks_fitted"], found["pump_limit_fraction"]) == (0, 1.0)
        run_pump(virtual_board, 10.0)
        set_gauge(virtual_board, NO_VALUE)
        for _ in range(2):
            virtual_board.pass_us(7_600_000)
            pump_on(virtual_board)
        assert sensors(virtual_board)["latched_faults"] == _GAUGE_LOST


def test_the_stored_protections_are_in_the_identity(firmware_library: Path) -> None:
    board = VirtualBoard(
        firmware_library,
        {
            **SETTINGS,
            "gauge_fitted": False,
            "gauge_timeout_s": 2.5,
            "gauge_frozen_s": 600,
            "interlocks_fitted": [0, 4],
        },
    )
    block = _MAP.block("identity")
    found = block.decode(board.read(block.address, block.count))
    assert (found["gauge_fitted"], found["gauge_timeout_s"], found["gauge_frozen_s"]) == (
        0,
        2.5,
        600.0,
    )
    assert (found["interlocks_fitted"], found["map_version"]) == (0b10001, 3)


@pytest.mark.parametrize(
    ("place", "value"),
    [(0, 2), (1, 99), (1, 60_001), (2, 999), (2, 600_001), (3, 0x10000), (0, 0xFFFFFFFF)],
)
def test_impossible_protections_make_the_record_invalid(
    virtual_board: VirtualBoard, place: int, value: int
) -> None:
    words = _record_words()
    words[_PROTECTION_AT + place] = value
    virtual_board.power_on(_sealed(words))
    assert virtual_board.read(6, 1) == [0]  # no pump without valid settings


@pytest.mark.parametrize("length", [0, 4, 155, 160, 168, 176, 0xFFFFFFFF])
def test_a_record_of_another_length_is_invalid(virtual_board: VirtualBoard, length: int) -> None:
    words = _record_words()
    words[1] = length
    virtual_board.power_on(_sealed(words) + bytes(100))
    assert virtual_board.read(6, 1) == [0]
