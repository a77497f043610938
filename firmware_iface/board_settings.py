"""The record of settings that a pump board keeps in its flash, made from a TOML file.

`python -m firmware_iface.board_settings board.toml settings.bin` writes the record, which
`board/core/settings.h` describes. A board with a damaged record runs no pump.
"""

import argparse
import struct
import sys
import tomllib
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from firmware_iface.register_map import load_default_map

CHANNELS = (
    "displacement_um",
    "gauge_pressure_pa",
    "ambient_pressure_pa",
    "air_temperature_c",
    "gas_temperature_c",
)
_MAGIC = 0x4D425331
_PARITIES = ("N", "E", "O")
_I32_MAX = 2**31 - 1
_KEYS = {
    "unit_id",
    "baud",
    "parity",
    "silence_us",
    "pressure_limit_pa",
    "pump_limit_fraction",
    "channel",
    "gauge_fitted",
    "gauge_timeout_s",
    "gauge_frozen_s",
    "interlocks_fitted",
}
_CHANNEL_KEYS = {"points", "plausible_raw"}
_INTERLOCK_INPUTS = 16
# as settings.h has them for records that do not state them
GAUGE_TIMEOUT_S, GAUGE_FROZEN_S = 15.0, 60.0
_FAST_BAUD, _FAST_SILENCE_US, _SILENCE_BITS = 19_200, 1750, 38.5  # 3.5 characters of 11 bits


class BoardSettingsError(ValueError):
    """The file is unusable; the message names the key and the remedy."""


def make_record(table: Mapping[str, Any]) -> bytes:
    """The record of a board's settings.

    Parameters
    ----------
    table : mapping
        As read from TOML. It has `unit_id`, `baud`, `parity` ("N", "E", "O"), `silence_us` (by
        default the standard's), `pressure_limit_pa`, `pump_limit_fraction`, and
        `channel.<register>` with `points` ([[raw, value], [raw, value]], in the register's unit)
        and `plausible_raw` ([lowest, highest]; anything else is "no value"). An omitted channel
        arrives in counts of its register.

        `gauge_fitted` (true) with `gauge_timeout_s` (15) and `gauge_frozen_s` (60; 0: not judged)
        state how the board guards its pump against a lost gauge; `interlocks_fitted` lists the
        interlock inputs in use, from 0 (none).

    Returns
    -------
    bytes
        Words of 32 bits, big end first: magic, length, settings, CRC-32 of all before it.

    Raises
    ------
    BoardSettingsError
        An unknown or missing key, or a value outside what the board takes.
    """
    _check_keys("", table, _KEYS)
    baud = _read_whole(table, "baud", 1200, 1_000_000, 115_200)
    silence_us = _standard_silence_us(baud)
    parity = table.get("parity", "E")
    if parity not in _PARITIES:
        raise BoardSettingsError(f'parity is {parity!r}, expected "N", "E" or "O"')
    channels = table.get("channel", {})
    _check_keys("channel.", channels, set(CHANNELS))
    # The common settings, each channel's scale, and the guards of the pump, in words of 32 bits.
    body = struct.pack(
        ">6I",
        _read_whole(table, "unit_id", 1, 247, 1),
        baud,
        _PARITIES.index(parity),
        _read_whole(table, "silence_us", silence_us, 1_000_000, silence_us),
        round(1000 * _read_number(table, "pressure_limit_pa", 0.001, 100_000.0)),
        round(50_000 * _read_number(table, "pump_limit_fraction", 0.00002, 1.0)),
    )
    body += b"".join(_read_scale(name, channels.get(name, {})) for name in CHANNELS)
    body += _pack_protection(table)
    head = struct.pack(">2I", _MAGIC, 8 + len(body) + 4)
    return head + body + struct.pack(">I", zlib.crc32(head + body))


def _standard_silence_us(baud: int) -> int:
    if baud > _FAST_BAUD:
        return _FAST_SILENCE_US
    return -int(-_SILENCE_BITS * 1e6 // baud)


def _pack_protection(table: Mapping[str, Any]) -> bytes:
    """Pack which protections are fitted, and the times of the gauge's guard in ms."""
    fitted = table.get("gauge_fitted", True)
    if not isinstance(fitted, bool):
        raise BoardSettingsError(f"gauge_fitted is {fitted!r}, expected true or false")
    timeout_ms = round(1000 * _read_number(table, "gauge_timeout_s", 0.1, 60.0, GAUGE_TIMEOUT_S))
    frozen_s = _read_number(table, "gauge_frozen_s", 0.0, 600.0, GAUGE_FROZEN_S)
    if 0.0 < frozen_s < 1.0:
        raise BoardSettingsError(
            f"gauge_frozen_s is {frozen_s:g}, expected 0 or a number within 1..600"
        )
    return struct.pack(">4I", fitted, timeout_ms, round(1000 * frozen_s), _interlock_mask(table))


def _interlock_mask(table: Mapping[str, Any]) -> int:
    """Return the mask of the fitted interlock inputs, which the file lists by number."""
    inputs = table.get("interlocks_fitted", [])
    known = range(_INTERLOCK_INPUTS)
    numbers = isinstance(inputs, list) and all(
        type(number) is int and number in known for number in inputs
    )
    if not numbers or len(set(inputs)) < len(inputs):
        raise BoardSettingsError(
            f"interlocks_fitted is {inputs!r}, expected a list of different inputs, "
            f"0..{_INTERLOCK_INPUTS - 1}"
        )
    return sum(1 << number for number in inputs)


def _read_scale(name: str, table: Mapping[str, Any]) -> bytes:
    _check_keys(f"channel.{name}.", table, _CHANNEL_KEYS)
    # The board works with integers: a line through the first point, its slope as two whole numbers
    # (counts of the register over raw counts).
    counts_per_unit = load_default_map().register(name).counts_per_unit
    points = table.get("points", [[0, 0.0], [1, 1 / counts_per_unit]])
    low, high = table.get("plausible_raw", [-_I32_MAX, _I32_MAX])
    try:
        (zero, at_zero), (other, at_other) = sorted(points)
        offset = round(at_zero * counts_per_unit)
        words = (low, high, zero, round(at_other * counts_per_unit) - offset, other - zero, offset)
        if other <= zero or low >= high:
            raise ValueError("the two raw values are the same")
        return struct.pack(">6i", *words)
    except (TypeError, ValueError, struct.error) as error:
        raise BoardSettingsError(
            f"channel.{name}: {error}; expected points = [[raw, value], [raw, value]] with "
            "whole raw values"
        ) from error


def _check_keys(where: str, table: Mapping[str, Any], known: set[str]) -> None:
    if unknown := sorted(set(table) - known):
        raise BoardSettingsError(
            f"{where}{unknown[0]} is unknown; known are {', '.join(sorted(known))}"
        )


def _read_whole(table: Mapping[str, Any], key: str, least: int, most: int, default: int) -> int:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise BoardSettingsError(
            f"{key} is {value!r}, expected a whole number within {least}..{most}"
        )
    return value


def _read_number(
    table: Mapping[str, Any], key: str, least: float, most: float, default: float | None = None
) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise BoardSettingsError(
            f"{key} is {value!r}, expected a number within {least:g}..{most:g}"
        )
    return float(value)


def main(arguments: list[str] | None = None) -> int:
    """Write the record; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m firmware_iface.board_settings", description=__doc__
    )
    parser.add_argument("source", type=Path, help="the board's settings, TOML")
    parser.add_argument("target", type=Path, help="the record to write into the board's flash")
    options = parser.parse_args(arguments)
    try:
        options.target.write_bytes(
            make_record(tomllib.loads(options.source.read_text(encoding="utf-8")))
        )
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, BoardSettingsError) as error:
        print(f"{options.source}: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
