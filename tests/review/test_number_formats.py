"""Numbers as the review prints them."""

from __future__ import annotations

import pytest

from membrane_ctrl.review.formatting import format_number, format_signed


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("inf"), "–"),
        (0.012345, "0.0123"),
        (-12.345, "-12.3"),
        (999.4, "999"),
        (999.6, "1000"),
        (-999.5, "-1000"),
        (123456.7, "123457"),
    ],
)
def test_a_number_has_three_digits_and_no_exponent(value: float | None, text: str) -> None:
    assert format_number(value) == text
    if value is not None and text != "–":
        assert format_signed(value) == (text if value < 0 else f"+{text}")
