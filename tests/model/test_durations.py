"""Durations as people write them."""

from __future__ import annotations

import pytest

from membrane_ctrl.model.durations import parse_duration_s
from membrane_ctrl.model.errors import InputError


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90", 90),
        ("40s", 40),
        ("3m", 180),
        ("2h30m", 9000),
        ("1d", 86400),
        (" 1.5 m ", 90),
        ("0.5", 0.5),
    ],
)
def test_durations_are_parsed(text: str, seconds: float) -> None:
    assert parse_duration_s(text) == seconds


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0",
        "-3m",
        "3 weeks",
        "m3",
        "nan",
        "inf",
        "3m!",
        "1_0",
        "\u0663",
        "1_0s",
        "\u0663m",
        "1,5",
        "1e400",
        "9" * 70,
    ],
)
def test_refused(text: str) -> None:
    with pytest.raises(InputError, match="duration"):
        parse_duration_s(text)
