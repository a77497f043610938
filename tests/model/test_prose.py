"""Templates of sentences."""

from __future__ import annotations

import pytest

from membrane_ctrl.model.prose import fields_of, fill_template, for_people


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"a": "x", "b": "y", "c": 1.5}, "X (y) 1.5"),
        ({"a": "x"}, "X"),
        ({"a": "x", "b": "", "c": None}, "X"),
        ({"a": "x", "c": 0}, "X 0"),
        ({"b": "y"}, None),
        ({"a": "[b] {c}"}, "[b] {c}"),
    ],
)
def test_parts_without_a_value_are_left_out(
    values: dict[str, object], sentence: str | None
) -> None:
    assert fill_template("{a}[ ({b})][ {c:g}]", values) == sentence


def test_the_fields_of_a_template() -> None:
    assert fields_of("{a}[ ({b})][ {c:.3f}]") == {"a", "b", "c"}


def test_a_text_for_people_is_one_line() -> None:
    assert for_people("drum +-3 µm,\n  1 µrad") == "drum ±3 µm, 1 µrad"
