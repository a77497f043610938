"""Checksums of the small files of a run, which stay what they were: JSON objects, and a TOML file with a comment.

A JSON object gets a last member `crc32`, of its values and not of its spelling: written anew by another program it is
still right. The configuration gets a first line, a comment, of the text behind it. What has no checksum (an earlier
version, a note made later) is taken as it is.
"""

from __future__ import annotations

import json
import re
import zlib
from typing import Any

from membrane_ctrl.recording import plain_json

KEY = "crc32"
_COMMENT = "# as run; CRC-32 of the text below: "
_LINE = re.compile(re.escape(_COMMENT) + r"([0-9a-f]{8})\n")


def dumps_checked(table: dict[str, Any], indent: int | None = None) -> str:
    """JSON text of an object with its checksum."""
    plain = json.loads(plain_json.dumps(table))
    return plain_json.dumps({**plain, KEY: _crc(plain)}, indent)


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
