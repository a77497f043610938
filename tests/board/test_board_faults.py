"""The C firmware when memory, main loop, interrupts, settings or the line fail: outputs are safe in
time.
"""

from __future__ import annotations

import ctypes
import random
import struct
import zlib
from pathlib import Path

import pytest

from firmware_iface.board_settings import make_record
from firmware_iface.register_map import load_default_map
from tests.board.virtual_board import NO_VALUE, SETTINGS, VirtualBoard, rtu_frame

_KEY = 0x1234_5678
_MAP = load_default_map()
_TICK_US = 1000
_STALLED_MS = 20  # BOARD_STALLED_TICKS
_HARDWARE_MS = 100  # HAL_WATCHDOG_MAX_MS
_QUIET = [1000, 0, 101_325_000, 210_000, 220_000, 0]


def write(name: str, values: dict[str, float]) -> bytes:
    """The request that writes a block."""
    block = _MAP.block(name)
    words = block.encode(values)
    return struct.pack(f">BHHB{len(words)}H", 16, block.address, len(words), 2 * len(words), *words)


def settings(period_s: float = 1.0, arm: int = 1) -> bytes:
    """Claim the board."""
    return write(
        "settings",
        {"watchdog_period_s": period_s, "watchdog_arm": arm, "claim_id": 7, "claim_key": _KEY},
    )


def command(heartbeat: int, pump: float = 0.5, vent: float = 0.25, key: int = _KEY) -> bytes:
    """Drive pump and vent."""
    return write(
        "command",
        {
            "pump_command_fraction": pump,
            "vent_command_fraction": vent,
            "heartbeat": heartbeat,
            "command_key": key,
        },
    )


def run_pump(board: VirtualBoard, period_s: float = 1.0) -> None:
    """Claimed, armed, pump at 0.5."""
    board.set_inputs(_QUIET)
    assert board.ask(settings(period_s))[0] == 16
    assert board.ask(command(1))[0] == 16
    assert board.outputs == (25_000, 12_500)


def sensors(board: VirtualBoard) -> dict[str, float]:
    block = _MAP.block("sensors")
    return block.decode(board.read(block.address, block.count))


@pytest.mark.parametrize("period_ms", [50, 300, 1000])
def test_the_pump_is_off_in_the_first_millisecond_after_the_period(
    virtual_board: VirtualBoard, period_ms: int
) -> None:
    run_pump(virtual_board, period_ms / 1000)
    fed_us = virtual_board.answered_us
    virtual_board.pass_us(fed_us + 1000 * period_ms - virtual_board.now_us)
    assert virtual_board.outputs == (25_000, 12_500)
    virtual_board.pass_us(_TICK_US)
    assert virtual_board.outputs == (0, 12_500)
    assert sensors(virtual_board)["latched_faults"] == _MAP.make_fault_mask("watchdog")


def test_the_period_counts_from_the_write_not_from_the_tick_before_it(
    virtual_board: VirtualBoard,
) -> None:
    run_pump(virtual_board, 0.05)
    virtual_board.pass_us(400)
    virtual_board.hear(rtu_frame(1, command(2)))
    virtual_board.pass_us(100)  # heard here, halfway between two ticks
    virtual_board.pass_us(1750)  # executed here, 250 us after a tick
    virtual_board.chip.virtual_skip(100)  # the next tick is late
    virtual_board.pass_us(750)
    virtual_board.pass_us(49_000)
    assert virtual_board.outputs == (25_000, 12_500), "49.85 ms after the write"
    virtual_board.pass_us(_TICK_US)
    assert virtual_board.outputs == (0, 12_500)


def test_clearing_another_fault_does_not_feed(virtual_board: VirtualBoard) -> None:
    run_pump(virtual_board, 0.05)
    virtual_board.pass_us(20_000)
    virtual_board.ask(write("stop", {"stop": 1}))
    virtual_board.pass_us(10_000)
    virtual_board.ask(write("reset", {"clear_faults": 0xFFFF, "clear_key": _KEY}))
    virtual_board.pass_us(20_000)
    assert sensors(virtual_board)["latched_faults"] == _MAP.make_fault_mask("watchdog")


def test_a_watchdog_trip_does_not_expire(virtual_board: VirtualBoard) -> None:
    """A counter of microseconds wraps after 71 minutes."""
    run_pump(virtual_board)
    for _ in range(100):
        virtual_board.chip.virtual_skip(60_000_000)
        virtual_board.pass_us(10 * _TICK_US)
        assert virtual_board.outputs == (0, 12_500)
        assert virtual_board.ask(command(2, key=1)) == b"\x90\x03", "the claim is held again"
    assert virtual_board.resets == 0
    assert sensors(virtual_board)["device_time_s"] == 100 * 60 + 1


def test_over_pressure_stops_the_pump_and_opens_the_vent_within_a_sample(
    virtual_board: VirtualBoard,
) -> None:
    run_pump(virtual_board, 10.0)
    virtual_board.set_inputs([1000, 800_000])
    virtual_board.pass_us(10_000)
    assert virtual_board.outputs == (25_000, 12_500)
    virtual_board.set_inputs([1000, 800_001])
    virtual_board.pass_us(5000)
    assert virtual_board.outputs == (0, 50_000)
    virtual_board.set_inputs([1000, 0])
    virtual_board.pass_us(1_000_000)
    assert virtual_board.outputs == (0, 50_000)


def test_a_frozen_main_loop_stops_the_pump_and_resets_the_board(
    virtual_board: VirtualBoard,
) -> None:
    run_pump(virtual_board, 10.0)
    virtual_board.pass_us(1000 * (_STALLED_MS - 1), main_loop=False)
    assert virtual_board.outputs == (25_000, 12_500)
    virtual_board.pass_us(2 * _TICK_US, main_loop=False)
    assert virtual_board.outputs == (0, 12_500)
    virtual_board.pass_us(1000 * _HARDWARE_MS, main_loop=False)
    assert (virtual_board.outputs, virtual_board.resets) == ((0, 0), 1)
    assert sensors(virtual_board)["watchdog_armed"] == 0


def test_frozen_interrupts_reset_the_board_although_the_main_loop_turns(
    virtual_board: VirtualBoard,
) -> None:
    run_pump(virtual_board, 10.0)
    virtual_board.pass_us(1000 * (_HARDWARE_MS + 1), interrupts=False)
    assert (virtual_board.outputs, virtual_board.resets) == ((0, 0), 1)


def test_a_stopped_processor_is_reset(virtual_board: VirtualBoard) -> None:
    run_pump(virtual_board, 10.0)
    virtual_board.pass_us(1000 * (_HARDWARE_MS + 1), interrupts=False, main_loop=False)
    assert (virtual_board.outputs, virtual_board.resets) == ((0, 0), 1)


def test_a_stopped_clock_resets_the_board(virtual_board: VirtualBoard) -> None:
    run_pump(virtual_board, 10.0)
    virtual_board.chip.board_tick()  # an interrupt, and no microsecond has passed
    assert virtual_board.outputs == (0, 0)
    virtual_board.pass_us(_TICK_US)
    assert virtual_board.resets == 1


def test_every_damaged_bit_of_what_the_board_decides_by_resets_it_in_a_millisecond(
    virtual_board: VirtualBoard,
) -> None:
    """Of the registers and of their inverse copy."""
    memory = virtual_board.memory()
    chance = random.Random(1)
    spans = [memory["now"], memory["inverse"]]
    assert [length > 200 for _, length in spans] == [True, True]
    for start, length in spans:
        for offset in range(0, length, 4):
            virtual_board.power_on(make_record(SETTINGS))
            run_pump(virtual_board, 10.0)
            word = ctypes.c_uint32.from_address(start + offset)
            word.value ^= 1 << chance.randrange(32)
            refused = virtual_board.chip.board_write(72, 1, (ctypes.c_uint16 * 1)(1))
            assert refused == 4, "a write seals the damage"
            virtual_board.pass_us(_TICK_US)
            assert (virtual_board.outputs, virtual_board.resets) == ((0, 0), 1), (
                f"word {offset // 4}"
            )


def test_damage_anywhere_in_the_firmware_s_memory_never_drives_the_pump_unfed(
    virtual_board: VirtualBoard,
) -> None:
    """Random bits of all its variables flip while requests come: at worst it resets or does not
    answer.
    """
    memory = virtual_board.memory()
    chance = random.Random(2)
    spans = [memory[name] for name in ("now", "inverse", "frame", "stalled_ticks", "clients")]
    for _ in range(300):
        virtual_board.power_on(make_record(SETTINGS))
        run_pump(virtual_board, 0.05)
        start, length = chance.choice(spans)
        byte = ctypes.c_uint8.from_address(start + chance.randrange(length))
        byte.value ^= 1 << chance.randrange(8)
        virtual_board.hear(rtu_frame(1, command(1)))  # the same heartbeat: does not feed
        virtual_board.pass_us(60_000)
        assert virtual_board.outputs[0] == 0
        virtual_board.read_sent()


@pytest.mark.parametrize("damage", ["absent", "blank", "flipped", "short", "baud", "divisor"])
def test_a_board_without_valid_settings_has_no_values_and_no_pump(
    virtual_board: VirtualBoard, damage: str
) -> None:
    records = (
        make_record({**SETTINGS, "unit_id": 9, "silence_us": 2000 + tried}) for tried in range(5000)
    )
    good = next(
        found for found in records if found[-1] == 0
    )  # the byte that a short one lacks is 0 in memory
    bad = {
        "absent": b"",
        "blank": b"\xff" * len(good),
        "short": good[:-1],
        "flipped": good[:30] + bytes([good[30] ^ 1]) + good[31:],
        "baud": _sealed(good, 12, 100),
        "divisor": _sealed(good, 48, 0),
    }[damage]
    virtual_board.power_on(bad)
    virtual_board.set_inputs(_QUIET)
    virtual_board.pass_us(10_000)
    virtual_board.ask(settings())
    virtual_board.ask(command(1))
    found = sensors(virtual_board)
    assert found["displacement_um"] != found["displacement_um"]
    assert found["pump_readback_fraction"] == 0
    assert virtual_board.outputs == (0, 12_500)
    assert virtual_board.read(6, 1) == [0]


def _sealed(good: bytes, at: int, value: int) -> bytes:
    """A record with one word changed and a CRC that is right."""
    body = good[:at] + struct.pack(">I", value) + good[at + 4 : -4]
    return body + struct.pack(">I", zlib.crc32(body))


def test_scales_turn_raw_values_into_counts(firmware_library: Path) -> None:
    gauge = {
        "points": [[13_107, 0.0], [65_535, 1000.0]],
        "plausible_raw": [11_796, 65_534],
    }  # 4..20 mA
    board = VirtualBoard(firmware_library, {**SETTINGS, "channel": {"gauge_pressure_pa": gauge}})
    for raw, pa in ((13_107, 0.0), (39_321, 500.0), (11_796, -25.0), (26_214, 250.0)):
        board.set_inputs([0, raw])
        board.pass_us(10_000)
        assert sensors(board)["gauge_pressure_pa"] == pytest.approx(pa, abs=0.01)
    for raw in (11_795, 65_535, NO_VALUE):
        board.set_inputs([0, raw])
        board.pass_us(10_000)
        assert sensors(board)["gauge_pressure_pa"] != sensors(board)["gauge_pressure_pa"]


def test_a_silent_laser_has_no_good_quality(virtual_board: VirtualBoard) -> None:
    assert sensors(virtual_board)["displacement_quality"] == 0xFFFF


def test_a_request_cut_at_any_byte_does_nothing_and_the_next_one_is_answered(
    virtual_board: VirtualBoard,
) -> None:
    run_pump(virtual_board, 10.0)
    frame = rtu_frame(1, command(2, pump=0.75))
    for kept in range(len(frame)):
        virtual_board.hear(frame[:kept])
        virtual_board.pass_us(4000)
        assert virtual_board.read_sent() == b""
        assert virtual_board.outputs == (25_000, 12_500)
    assert virtual_board.ask_frame(frame)
    assert virtual_board.outputs == (37_500, 12_500)


def test_a_line_cut_within_a_request_stops_the_pump_after_the_period(
    virtual_board: VirtualBoard,
) -> None:
    frame = rtu_frame(1, command(2))
    for kept in range(len(frame)):
        virtual_board.power_on(make_record(SETTINGS))
        run_pump(virtual_board, 0.05)
        virtual_board.hear(frame[:kept])
        virtual_board.pass_us(51_000)
        assert virtual_board.outputs == (0, 12_500)


def test_a_frame_is_one_only_between_silences(virtual_board: VirtualBoard) -> None:
    ask = rtu_frame(1, struct.pack(">BHH", 3, 0, 2))
    answer = rtu_frame(1, bytes.fromhex("03044d420003"))
    assert virtual_board.ask_frame(ask) == answer
    assert virtual_board.ask_frame(b"\0" + ask) == b""  # noise right before it
    assert virtual_board.ask_frame(ask + ask) == b""
    assert virtual_board.ask_frame(ask[:-1] + bytes([ask[-1] ^ 1])) == b""
    virtual_board.hear(ask[:4])
    virtual_board.chip.virtual_hear_damage()
    assert virtual_board.ask_frame(ask[4:]) == b""
    query = rtu_frame(1, bytes.fromhex("08000012fe"))
    virtual_board.hear(query[:5])
    virtual_board.chip.virtual_hear_damage()  # instead of 0xfe, which is -2 as the layer's error is
    assert virtual_board.ask_frame(query[6:]) == b""
    assert virtual_board.ask_frame(bytes(300) + ask) == b""
    assert virtual_board.ask_frame(ask[:3]) == b""
    assert virtual_board.ask_frame(ask) == answer
    virtual_board.hear(ask)
    virtual_board.pass_us(2000)  # heard after 1 ms, silent for 1 ms: too early to answer
    assert virtual_board.read_sent() == b""
    virtual_board.pass_us(1000)
    assert virtual_board.read_sent() == answer


def test_a_line_that_splits_frames_may_have_a_longer_silence(firmware_library: Path) -> None:
    board = VirtualBoard(firmware_library, {**SETTINGS, "silence_us": 20_000})
    ask = rtu_frame(1, struct.pack(">BHH", 3, 0, 2))
    board.hear(ask[:3])
    board.pass_us(15_000)
    assert board.ask_frame(ask[3:]) == rtu_frame(1, bytes.fromhex("03044d420003"))


def test_other_units_are_left_alone_and_a_broadcast_is_obeyed_without_an_answer(
    virtual_board: VirtualBoard,
) -> None:
    run_pump(virtual_board, 10.0)
    stop = write("stop", {"stop": 1})
    assert virtual_board.ask(stop, unit=2) == b""
    assert virtual_board.outputs == (25_000, 12_500)
    assert virtual_board.ask(stop, unit=0) == b""
    assert virtual_board.outputs == (0, 12_500)


def test_query_data_comes_back_and_other_diagnostics_do_not(virtual_board: VirtualBoard) -> None:
    assert virtual_board.ask(bytes.fromhex("0800001234")) == bytes.fromhex("0800001234")
    assert virtual_board.ask(bytes.fromhex("0800011234")) == b"\x88\x01"
    assert virtual_board.ask(b"\x08") == b"\x88\x01"
