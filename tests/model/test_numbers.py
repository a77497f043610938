"""Numbers in plain decimal notation; other notations that Python's `float` accepts are refused."""

from __future__ import annotations

import random

import pytest

from membrane_ctrl.model.numbers import TEXT_LENGTH_MAX, parse_number

NOT_NUMBERS = (
    "",
    " ",
    "+",
    "-",
    ".",
    "e5",
    "1e",
    "1e+",
    "--1",
    "+-1",
    "1.2.3",
    "1,000",
    "1,5",
    "1.000,5",
    "1'000",
    "1_0",
    "1 000",
    "1\u00a0000",
    "1\u202f000",
    " 1",
    "1 ",
    "1\n",
    "\t1",
    "1\0",
    "1\u200b",
    "\ufeff1",
    "\u0663",
    "\u0967",
    "\uff11",
    "\u00b2",
    "\u00bd",
    "\u22121",
    "1e\u0663",
    "1\u066b5",
    "nan",
    "NaN",
    "inf",
    "-inf",
    "infinity",
    "1e400",
    "-1e400",
    "9" * 400,
    "0x10",
    "0b1",
    "0o7",
    "1f",
    "1um",
    "1j",
    "None",
    "true",
    "1/2",
    "1e5.0",
    "0" * (TEXT_LENGTH_MAX + 1),
    "1" + "0" * 10_000_000,
)


@pytest.mark.parametrize("text", NOT_NUMBERS, ids=lambda text: ascii(text[:20]))
def test_a_text_that_is_not_plain_decimal_notation_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"number|comma|large") as refusal:
        parse_number(text)
    reason = str(refusal.value)
    assert len(reason) < 200
    assert reason.isprintable()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0", 0.0),
        ("-0", -0.0),
        ("7", 7.0),
        ("+7", 7.0),
        ("-1.5", -1.5),
        ("1.", 1.0),
        (".5", 0.5),
        ("-.5", -0.5),
        ("2e-3", 0.002),
        ("2E+3", 2000.0),
        ("007", 7.0),
        ("1e308", 1e308),
        ("1e-400", 0.0),
    ],
)
def test_plain_decimal_notation_is_read(text: str, value: float) -> None:
    assert repr(parse_number(text)) == repr(value)


def test_each_double_that_python_prints_is_read_back_exactly() -> None:
    rng = random.Random(1)
    for _ in range(2000):
        value = rng.uniform(-1.0, 1.0) * 10.0 ** rng.randint(-300, 300)
        assert parse_number(repr(value)) == value
