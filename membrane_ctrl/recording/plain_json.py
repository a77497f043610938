"""JSON that every reader accepts: numbers that JSON has no word for (NaN, infinity) are null."""

from __future__ import annotations

import json
import math
from typing import Any


def dumps(value: Any, indent: int | None = None) -> str:
    """JSON text; NaN and infinity become null, what JSON does not know becomes its `str`."""
    return json.dumps(_finite(value), ensure_ascii=False, default=str, allow_nan=False, indent=indent)


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value
