"""Checksums of a run's small files.

A JSON object gets a last member `crc32` over its values, not their spelling: other programs may
rewrite it. The configuration gets a comment as its first line, with the checksum of its text. Files
without a checksum (annotations, files edited by a person) are accepted.
"""

import json
import re
import zlib
from typing import Any

from membrane_ctrl.model.plain_json import dumps

KEY = "crc32"
_COMMENT = "# as run; CRC-32 of the text below: "
_LINE = re.compile(re.escape(_COMMENT) + r"([0-9a-f]{8})\n")


def dumps_checked(table: dict[str, Any], indent: int | None = None) -> str:
    """Return the JSON text of an object, with its checksum as the last member `crc32`.

    Parameters
    ----------
    table : dict
        Plain data, as `plain_json.dumps` accepts it.
    indent : int or None
        Spaces for each level; None: one line.
    """
    plain = json.loads(dumps(table))
    return dumps({**plain, KEY: _table_crc(plain)}, indent)


def pop_checksum(table: dict[str, Any]) -> bool:
    """Remove an object's checksum after reading; True if correct or missing."""
    stored = table.pop(KEY, None)
    return stored is None or stored == _table_crc(table)


def add_checksum_comment(text: str) -> str:
    """The text, preceded by its checksum."""
    return f"{_COMMENT}{zlib.crc32(text.encode()):08x}\n{text}"


def is_comment_checksum_correct(text: str) -> bool:
    """Whether the checksum in the first line is correct; True without one."""
    line = _LINE.match(text)
    if line is None:
        return not text.startswith(_COMMENT)
    return int(line[1], 16) == zlib.crc32(text[line.end() :].encode())


def _table_crc(table: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(table, sort_keys=True, separators=(',', ':')).encode()):08x}"
