"""The syntax of a hold's message, before anybody reads its fields: bounded, plain JSON.

A client talks to whatever listens at an address, which may be another program, a damaged hold or a
hostile one. So sizes, numbers and texts are checked whatever their meaning.
"""

from __future__ import annotations

import math
from typing import Any

from membrane_ctrl.model import plain_json, terminal

Message = dict[str, Any]
# A status has some 150 values, four levels deep, and its texts are sentences.
_VALUES_MAX = 2000
_DEPTH_MAX = 8
_TEXT_MAX = 2000
_KEY_MAX = 64
_NUMBER_MAX = 1e16  # beyond any quantity, counter or time of a hold, and short enough to print
QUOTED_MAX = 120  # characters of a foreign text that an error quotes


class AnswerError(ValueError):
    """A message that no hold sends; the text names the field and the problem."""


def decode(line: bytes) -> Message:
    """Decode a message. Raises AnswerError unless it is a bounded, plain JSON object."""
    try:
        message = plain_json.loads(line.decode("utf-8"))
    except (ValueError, OverflowError):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise AnswerError("not JSON") from None
    if not isinstance(message, dict):
        raise AnswerError("not a JSON object")
    budget = [_VALUES_MAX]
    cleaned = _clean_value(message, "", 0, budget)
    assert isinstance(cleaned, dict)
    return cleaned


def _clean_value(value: object, field: str, depth: int, budget: list[int]) -> object:
    """Check a value of any meaning; texts lose what a terminal would execute."""
    # One budget for the whole message: many small objects cost as much as a large one
    budget[0] -= 1
    if budget[0] < 0:
        raise AnswerError(f"more than {_VALUES_MAX} values")
    if depth > _DEPTH_MAX:
        raise AnswerError(f"{field}: nested too deep")
    if isinstance(value, dict):
        return {
            _clean_key(key, field): _clean_value(
                item, _join_field_name(field, key), depth + 1, budget
            )
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [
            _clean_value(item, _join_field_name(field, str(place)), depth + 1, budget)
            for place, item in enumerate(value)
        ]
    if isinstance(value, str):
        return _clean_text(value, field)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return _checked_number(value, field)
    return value


def _clean_key(key: str, field: str) -> str:
    if len(key) > _KEY_MAX or not key.isprintable():
        raise AnswerError(f"{field or 'message'}: a key that is not a name")
    return key


def _clean_text(text: str, field: str) -> str:
    if len(text) > _TEXT_MAX:
        raise AnswerError(f"{field}: a text of more than {_TEXT_MAX} characters")
    return terminal.one_line(text)


def _checked_number(value: int | float, field: str) -> int | float:
    if not math.isfinite(value):
        raise AnswerError(f"{field}: not a finite number")
    if abs(value) > _NUMBER_MAX:
        raise AnswerError(f"{field}: too large a number")
    return value


def _join_field_name(field: str, key: str) -> str:
    """The name of an inner field; a peer's own keys may appear in it, so it is kept short and
    plain.
    """
    name = f"{field}.{key}" if field else key
    return terminal.one_line(name[:QUOTED_MAX])
