"""JSON for every reader, and safe reading of foreign JSON.

NaN and infinity are written as null. Text that is deeper or longer than any of ours is refused before it takes memory
or the stack.
"""

import hashlib
import json
import math
import re
import zlib
from collections.abc import Mapping
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


# Checksums of the small files of a run. A JSON object gets a last member `crc32`, of its values and not of its
# spelling: another program may rewrite it. The configuration gets a first line, a comment, with that of its text.
# What has no checksum (of an earlier version, a later note) is accepted.

KEY = "crc32"
_COMMENT = "# as run; CRC-32 of the text below: "
_LINE = re.compile(re.escape(_COMMENT) + r"([0-9a-f]{8})\n")


def dumps_checked(table: dict[str, Any], indent: int | None = None) -> str:
    """JSON text of an object with its checksum."""
    plain = json.loads(dumps(table))
    return dumps({**plain, KEY: _crc(plain)}, indent)


def take_checksum(table: dict[str, Any]) -> bool:
    """Remove the checksum of an object that was read; True if it was right or missing."""
    said = table.pop(KEY, None)
    return said is None or said == _crc(table)


def with_comment(text: str) -> str:
    """The text, with its checksum in front."""
    return f"{_COMMENT}{zlib.crc32(text.encode()):08x}\n{text}"


def comment_is_right(text: str) -> bool:
    """Whether the checksum in the first line is right; True without one."""
    line = _LINE.match(text)
    if line is None:
        return not text.startswith(_COMMENT)
    return int(line[1], 16) == zlib.crc32(text[line.end() :].encode())


def _crc(table: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(table, sort_keys=True, separators=(',', ':')).encode()):08x}"


SCHEMA = "membrane-geometry/1"
_HASHED = ("geometry", "covariance", "parameters", "camera", "pattern")


def content_hash(tables: Mapping[str, Any]) -> str:
    """Sixteen digits that name a geometry in results and runs, whatever the order or layout of its tables."""
    content = {key: tables[key] for key in _HASHED if key in tables}
    text = json.dumps(content, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
