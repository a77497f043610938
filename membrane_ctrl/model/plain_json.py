"""JSON for every reader, and safe reading of foreign JSON.

NaN and infinity are written as null. Text deeper or longer than any of ours is refused before it
exhausts memory or the stack.
"""

import json
import math
from typing import Any

# Limit on the values in a file: a value of two characters takes 64 bytes of memory, this many at
# most 200 MB.
ELEMENTS_MAX = 6_000_000
_DEPTH_MAX = 32
_DIGITS_MAX = 19  # enough for a 64-bit counter; longer numbers are floats


def dumps(value: Any, indent: int | None = None) -> str:
    """Return JSON text; NaN and infinity become null, unsupported types become their `str`.

    Parameters
    ----------
    value : Any
        Of any type.
    indent : int or None
        As of `json.dumps`.
    """
    return json.dumps(
        _replace_non_finite(value), ensure_ascii=False, default=str, allow_nan=False, indent=indent
    )


def loads(text: str) -> Any:
    """The value of a JSON text. Raises ValueError, also for excessive depth."""
    try:
        value = json.loads(text, parse_int=_parse_number)
    except RecursionError:
        raise ValueError("nested too deep") from None
    inside = [value] if isinstance(value, (dict, list)) else []
    for _ in range(_DEPTH_MAX):
        if not inside:
            return value
        items = (
            item
            for outer in inside
            for item in (outer.values() if isinstance(outer, dict) else outer)
        )
        inside = [item for item in items if isinstance(item, (dict, list))]
    raise ValueError("nested too deep")


def count_elements(text: str) -> int:
    """Upper bound on the number of values in a JSON text."""
    return text.count(",") + text.count("[") + text.count("{")


def _parse_number(text: str) -> int | float:
    if len(text) <= _DIGITS_MAX:
        return int(text)
    return float(text)


def _replace_non_finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _replace_non_finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_replace_non_finite(item) for item in value]
    return value
