"""JSON for every reader, and safe reading of foreign JSON.

NaN and infinity are written as null. Text deeper or longer than any of ours is refused before it
exhausts memory or the stack.
"""

import hashlib
import json
import math
import re
import zlib
from collections.abc import Mapping
from typing import Any

# Limit on the values in a file: a value of two characters takes 64 bytes of memory, this many at
# most 200 MB.
ELEMENTS_MAX = 6_000_000
_DEPTH_MAX = 32
_DIGITS_MAX = 19  # enough for a 64-bit counter; longer numbers are floats


def dumps(value: Any, indent: int | None = None) -> str:
    """JSON text; NaN and infinity become null, unsupported types become their `str`."""
    return json.dumps(
        _finite(value), ensure_ascii=False, default=str, allow_nan=False, indent=indent
    )


def loads(text: str) -> Any:
    """The value of a JSON text. Raises ValueError, also for excessive depth."""
    try:
        value = json.loads(text, parse_int=_number)
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


def elements(text: str) -> int:
    """Upper bound on the number of values in a JSON text."""
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


# Checksums of a run's small files. A JSON object gets a last member `crc32` over its values, not
# their spelling: other programs may rewrite it. The configuration gets a comment as its first line,
# with the checksum of its text. Files without a checksum (annotations, files edited by a person)
# are
# accepted.

KEY = "crc32"
_COMMENT = "# as run; CRC-32 of the text below: "
_LINE = re.compile(re.escape(_COMMENT) + r"([0-9a-f]{8})\n")


def dumps_checked(table: dict[str, Any], indent: int | None = None) -> str:
    """JSON text of an object, with its checksum."""
    plain = json.loads(dumps(table))
    return dumps({**plain, KEY: _crc(plain)}, indent)


def take_checksum(table: dict[str, Any]) -> bool:
    """Remove an object's checksum after reading; True if correct or missing."""
    said = table.pop(KEY, None)
    return said is None or said == _crc(table)


def with_comment(text: str) -> str:
    """The text, preceded by its checksum."""
    return f"{_COMMENT}{zlib.crc32(text.encode()):08x}\n{text}"


def comment_is_right(text: str) -> bool:
    """Whether the checksum in the first line is correct; True without one."""
    line = _LINE.match(text)
    if line is None:
        return not text.startswith(_COMMENT)
    return int(line[1], 16) == zlib.crc32(text[line.end() :].encode())


def _crc(table: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(table, sort_keys=True, separators=(',', ':')).encode()):08x}"


SCHEMA = "membrane-geometry/1"
_HASHED = ("geometry", "covariance", "parameters", "camera", "pattern")


def content_hash(tables: Mapping[str, Any]) -> str:
    """Sixteen digits that identify a geometry in results and runs, whatever the order or layout of
    its tables.
    """
    content = {key: tables[key] for key in _HASHED if key in tables}
    text = json.dumps(content, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
