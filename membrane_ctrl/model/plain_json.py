"""JSON that every reader accepts, and reading of JSON that anybody may have written.

Written: numbers that JSON has no word for (NaN, infinity) are null. Read: what is deeper or longer than anything of
ours is refused before it takes memory or the stack.
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


# Checksums of the small files of a run, which stay what they were: JSON objects, and a TOML file with a comment.
#
# A JSON object gets a last member `crc32`, of its values and not of its spelling: written anew by another program it
# is still right. The configuration gets a first line, a comment, of the text behind it. What has no checksum (an
# earlier version, a note made later) is taken as it is.


KEY = "crc32"
_COMMENT = "# as run; CRC-32 of the text below: "
_LINE = re.compile(re.escape(_COMMENT) + r"([0-9a-f]{8})\n")


def dumps_checked(table: dict[str, Any], indent: int | None = None) -> str:
    """JSON text of an object with its checksum."""
    plain = json.loads(dumps(table))
    return dumps({**plain, KEY: _crc(plain)}, indent)


def take_checksum(table: dict[str, Any]) -> bool:
    """Take the checksum out of an object that was read; whether it was right, or there was none."""
    said = table.pop(KEY, None)
    return said is None or said == _crc(table)


def with_comment(text: str) -> str:
    """A text behind its checksum."""
    return f"{_COMMENT}{zlib.crc32(text.encode()):08x}\n{text}"


def comment_is_right(text: str) -> bool:
    """Whether a text is what its first line says; True without such a line."""
    line = _LINE.match(text)
    if line is None:
        return not text.startswith(_COMMENT)
    return int(line[1], 16) == zlib.crc32(text[line.end() :].encode())


def _crc(table: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(table, sort_keys=True, separators=(',', ':')).encode()):08x}"


# The hash by which results and runs name the geometry that they were made with.


SCHEMA = "membrane-geometry/1"
_HASHED = ("geometry", "covariance", "parameters", "camera", "pattern")


def content_hash(tables: Mapping[str, Any]) -> str:
    """Sixteen digits that stand for the numbers in a geometry's tables, whatever their order or layout."""
    content = {key: tables[key] for key in _HASHED if key in tables}
    text = json.dumps(content, sort_keys=True, default=list)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
