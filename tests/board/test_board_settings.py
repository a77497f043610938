"""The tool that makes the record of settings: what it accepts, and the one line for what it does
not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from firmware_iface import board_settings

_GOOD: dict[str, Any] = {"pressure_limit_pa": 800.0, "pump_limit_fraction": 0.5}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"unit_id": 0}, "unit_id is 0, expected a whole number within 1..247"),
        ({"unit_id": True}, "unit_id is True"),
        ({"baud": 1199}, "baud is 1199"),
        (
            {"baud": 9600, "silence_us": 1750},
            "silence_us is 1750, expected a whole number within 4011..1000000",
        ),
        ({"parity": "X"}, 'parity is \'X\', expected "N", "E" or "O"'),
        ({"pressure_limit_pa": 0}, "pressure_limit_pa is 0"),
        ({"pressure_limit_pa": float("nan")}, "pressure_limit_pa is nan"),
        ({"pump_limit_fraction": 1.01}, "pump_limit_fraction is 1.01"),
        ({"pump_limit_fraction": 0}, "pump_limit_fraction is 0"),
        ({"colour": 1}, "colour is unknown; known are baud, channel"),
        ({"gauge_fitted": 1}, "gauge_fitted is 1, expected true or false"),
        ({"gauge_timeout_s": 0.09}, "gauge_timeout_s is 0.09, expected a number within 0.1..60"),
        ({"gauge_timeout_s": float("nan")}, "gauge_timeout_s is nan"),
        ({"gauge_frozen_s": 0.5}, "gauge_frozen_s is 0.5, expected 0 or a number within 1..600"),
        ({"gauge_frozen_s": 601}, "gauge_frozen_s is 601, expected a number within 0..600"),
        ({"gauge_frozen_s": False}, "gauge_frozen_s is False"),
        (
            {"interlocks_fitted": 3},
            "interlocks_fitted is 3, expected a list of different inputs, 0..15",
        ),
        ({"interlocks_fitted": [0, 16]}, "interlocks_fitted is [0, 16]"),
        ({"interlocks_fitted": [1, 1]}, "interlocks_fitted is [1, 1]"),
        ({"interlocks_fitted": [True]}, "interlocks_fitted is [True]"),
        ({"channel": {"humidity": {}}}, "channel.humidity is unknown"),
        (
            {"channel": {"air_temperature_c": {"offset": 1}}},
            "channel.air_temperature_c.offset is unknown",
        ),
        (
            {"channel": {"air_temperature_c": {"points": [[1, 2.0], [1, 3.0]]}}},
            "channel.air_temperature_c: the two",
        ),
        (
            {"channel": {"air_temperature_c": {"points": [[1, 2.0]]}}},
            "channel.air_temperature_c: not enough",
        ),
        (
            {"channel": {"air_temperature_c": {"points": [[0, 0.0], [1, 1e9]]}}},
            "channel.air_temperature_c: ",
        ),
        (
            {"channel": {"air_temperature_c": {"points": [[0.5, 0.0], [1, 1.0]]}}},
            "channel.air_temperature_c: ",
        ),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change: dict[str, Any], message: str) -> None:
    with pytest.raises(board_settings.BoardSettingsError) as found:
        board_settings.make_record({**_GOOD, **change})
    assert str(found.value).startswith(message)


def test_the_command_writes_a_record_or_prints_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = tmp_path / "board.toml", tmp_path / "settings.bin"
    source.write_text("pressure_limit_pa = 800.0\npump_limit_fraction = 1.0\n")
    assert board_settings.main([str(source), str(target)]) == 0
    assert target.read_bytes() == board_settings.make_record(
        {"pressure_limit_pa": 800.0, "pump_limit_fraction": 1.0}
    )
    for text in ("unit_id = 1\n", "unit_id = \n", "\0"):
        source.write_text(text)
        assert board_settings.main([str(source), str(target)]) == 2
    assert board_settings.main([str(tmp_path / "none.toml"), str(target)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4
    assert (
        lines[0] == f"{source}: pressure_limit_pa is None, expected a number within 0.001..100000"
    )
