"""JSON that every reader accepts, and reading of JSON that anybody may have written.

Written: numbers that JSON has no word for (NaN, infinity) are null. Read: what is deeper or longer than anything of
ours is refused before it takes memory or the stack.
"""

from __future__ import annotations

import json
import math
from typing import Any

# What a file of many values may hold in all: a value of two letters takes 64 bytes of memory, so many 200 MB at most.
ELEMENTS_MAX = 6_000_000
_DEPTH_MAX = 32
_DIGITS_MAX = 19  # of a 64-bit counter; beyond, a number is a float


def dumps(value: Any, indent: int | None = None) -> str:
    """JSON text; NaN and infinity become null, what JSON does not know becomes its `str`."""
    return json.dumps(_finite(value), ensure_ascii=False, default=str, allow_nan=False, indent=indent)


def loads(text: str) -> Any:
    """The value of a JSON text. Raises ValueError, also for one that is too deep."""
    try:
        value = json.loads(text, parse_int=_number)
    except RecursionError:
        raise ValueError("nested too deep") from None
    inside = [value] if isinstance(value, (dict, list)) else []
    for _ in range(_DEPTH_MAX):
        if not inside:
            return value
        items = (item for outer in inside for item in (outer.values() if isinstance(outer, dict) else outer))
        inside = [item for item in items if isinstance(item, (dict, list))]
    raise ValueError("nested too deep")


def elements(text: str) -> int:
    """At most so many values are in a JSON text."""
    return text.count(",") + text.count("[") + text.count("{")


def _number(text: str) -> int | float:
    return int(text) if len(text) <= _DIGITS_MAX else float(text)


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value
