"""What a stranger, a bad disk or a careless person may do to a good folder; every change from a
seed.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
import struct
import tomllib
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w

from membrane_ctrl.model.file_checksums import KEY, add_checksum_comment, dumps_checked
from membrane_ctrl.run_files.table_store.journal import MAGIC

CANARY = "canary.txt"  # beside the folder: what nobody may read, change or remove
_TEXT = "\x1b]0;owned\x07\x1b[2J\x9b31m\r\b\u202emirror\u2066[bold]\U000e0041"
_NUMBERS = (
    -1,
    0,
    1,
    2,
    1e308,
    -1e308,
    1e-308,
    5e-324,
    2**31,
    2**53,
    2**63 - 1,
    10**25,
    -(10**25),
    1e12,
    0.1,
    float("inf"),
    float("-inf"),
    float("nan"),
)
_OTHERS = (
    "",
    "nan",
    "x" * 5000,
    _TEXT,
    True,
    [],
    {},
    [[]],
    {"a": {"b": 1}},
    [1, "a", None],
    "../../etc/passwd",
    "/dev/zero",
)
_TIMES = (
    "2026-11-21",
    "9999-12-31T23:59:59+00:00",
    "0001-01-01T00:00:00-12:00",
    "2026-11-21T01:02:03",
    "now",
)
_HEAD_BYTES = 32  # of a journal's frame

Mutation = Callable[[Path, random.Random], None]


def spoil(folder: Path, rng: random.Random) -> None:
    """One to four changes somewhere below a folder."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        files = sorted(
            path for path in folder.rglob("*") if not path.is_symlink() and _is_small_file(path)
        )
        if not files:
            return
        path = rng.choice(files)
        mutations = [*_ANY, *_OF.get(path.suffix, ()), *_OF.get(path.suffix, ())]
        # an earlier change may stand in the way: what is no JSON any more has no value to change
        with contextlib.suppress(
            OSError, ValueError, LookupError, AttributeError, TypeError, RecursionError, zlib.error
        ):
            rng.choice(mutations)(path, rng)


def _is_small_file(path: Path) -> bool:
    return path.is_file() and path.stat().st_size < 2**24


def _value(rng: random.Random) -> Any:
    return rng.choice((*_NUMBERS, *_OTHERS, *_TIMES, None))


def _place(data: bytes, rng: random.Random) -> int:
    # heads are where lengths and counts are
    return rng.randrange(min(len(data), 256) if rng.random() < 0.4 else len(data))


def flip(path: Path, rng: random.Random) -> None:
    """Some bytes are others."""
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 1, 3, 20)) if data else 0):
        data[_place(data, rng)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    path.write_bytes(data)


def cut(path: Path, rng: random.Random) -> None:
    """The end, or the beginning, is missing."""
    data = path.read_bytes()
    at = rng.randrange(len(data) + 1)
    path.write_bytes(data[at:] if rng.random() < 0.2 else data[:at])


def numbers(path: Path, rng: random.Random) -> None:
    """A word of 4 or 8 bytes is a large number: a length, a count, an offset."""
    data = bytearray(path.read_bytes())
    kind, value = rng.choice(
        (
            ("<I", 2**32 - 1),
            ("<I", 2**31),
            ("<Q", 2**63 - 1),
            ("<Q", 2**40),
            ("<q", -1),
            (">I", 20000),
        )
    )
    if len(data) > 16:
        at = _place(data[:-8], rng)
        struct.pack_into(kind, data, at, value)
    path.write_bytes(data)


def splice(path: Path, rng: random.Random) -> None:
    """A stretch comes twice, is zeros, or is noise."""
    data = path.read_bytes()
    a, b = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    b = min(b, a + 4096)
    middle = rng.choice((data[a:b] * 2, bytes(b - a), rng.randbytes(b - a)))
    path.write_bytes(data[:a] + middle + data[b:])


def gone(path: Path, rng: random.Random) -> None:
    """The file is missing, empty, or a folder."""
    path.unlink()
    what = rng.randrange(3)
    if what == 1:
        path.touch()
    elif what == 2:
        path.mkdir()


def link(path: Path, rng: random.Random) -> None:
    """The file is a link: out of the folder, to itself, to a device, to nothing."""
    outside = next(parent / CANARY for parent in path.parents if (parent / CANARY).exists())
    path.unlink()
    path.symlink_to(
        rng.choice((outside, path, Path("/dev/zero"), Path("/nowhere/at/all"), Path("/etc/passwd")))
    )


def pipe(path: Path, rng: random.Random) -> None:
    """A pipe that nobody writes to."""
    path.unlink()
    os.mkfifo(path)


def sparse(path: Path, rng: random.Random) -> None:
    """The file seems to be of gigabytes."""
    with path.open("r+b") as file:
        file.truncate(rng.choice((2**28, 2**33, 2**40)))


def swap(path: Path, rng: random.Random) -> None:
    """Two files have each other's names, or one is there under another name as well."""
    others = [
        other
        for other in path.parent.iterdir()
        if not other.is_symlink() and _is_small_file(other) and other != path
    ]
    if not others:
        return
    other = rng.choice(others)
    if rng.random() < 0.5:
        ours, theirs = path.read_bytes(), other.read_bytes()
        path.write_bytes(theirs)
        other.write_bytes(ours)
        return
    name = rng.choice(
        (f"ticks-{rng.randrange(9999):04d}.parquet", "x\x1b[31m.rrd", "night-007.rrd")
    )
    shutil.copy(path, path.parent / name)


def planted(path: Path, rng: random.Random) -> None:
    """A link waits where a program may write."""
    outside = next(parent / CANARY for parent in path.parents if (parent / CANARY).exists())
    names = (
        ".probe",
        ".night-000.rrd.part",
        ".summary.json.part",
        "summary.json",
        "repaired",
        "report",
        "export",
        "report/report.html",
        "result/result.json",
        ".recorder-state",
        "annotations.jsonl",
        "stability",
        "ticks",
        "result/.result.json.part",
        "export/ticks.csv",
        "repaired/night-000.rrd",
        "events.jsonl.torn",
        "result",
        "geometry.toml",
    )
    place = path.parent / rng.choice(names)
    place.parent.mkdir(exist_ok=True)
    if not place.exists():
        place.symlink_to(outside if rng.random() < 0.7 else outside.parent)


def table(path: Path, rng: random.Random) -> None:
    """A value of a JSON object is another; often with the checksum that goes with it."""
    lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    at = rng.randrange(len(lines))
    value = json.loads(lines[at])
    value.pop(KEY, None)
    _change(value, rng)
    text = dumps_checked(value) if rng.random() < 0.7 else json.dumps(value)
    if rng.random() < 0.1:
        text = text.replace(
            "0", rng.choice(("1" * 5000, "1e999", "-" * 3, "[" * 3000, "\\ud800")), 1
        )
    lines[at] = text
    path.write_text("\n".join(lines) + "\n", errors="surrogatepass")


def toml(path: Path, rng: random.Random) -> None:
    """A value of a TOML file is another; a key of 30 000 parts is left as it is, since tomllib
    takes 2 GB for it.
    """
    before = path.read_text()
    if ".a" * 30000 in before:
        return
    value = tomllib.loads(before)
    _change(value, rng)
    text = tomli_w.dumps(_without_none(value))
    if rng.random() < 0.15:
        extra = (
            "a" + ".a" * 30000 + " = 1",
            "x = " + "[" * 3000,
            "x = " + "9" * 9000,
            "x = 1_",
            "y = 2026-13-45",
            "a = 1\na = 2",
        )
        text += rng.choice(extra) + "\n"
    if rng.random() < 0.2:
        text = "".join(rng.sample(lines := text.splitlines(keepends=True), len(lines)))
    path.write_text(add_checksum_comment(text) if path.name == "config.toml" else text)


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _without_none(item) for key, item in value.items() if item is not None}
    return (
        [_without_none(item) for item in value if item is not None]
        if isinstance(value, list)
        else value
    )


def _change(value: Any, rng: random.Random) -> None:
    """Go down some way and put something else there, take it out, or put it in."""
    places: list[tuple[Any, Any]] = []
    todo = [value]
    while todo:
        inside = todo.pop()
        for key, item in inside.items() if isinstance(inside, dict) else enumerate(inside):
            places.append((inside, key))
            if isinstance(item, (dict, list)):
                todo.append(item)
    if not places:
        return
    inside, key = rng.choice(places)
    if rng.random() < 0.15:
        del inside[key]
    elif rng.random() < 0.1 and isinstance(inside, dict):
        inside[_TEXT if rng.random() < 0.5 else "other"] = _value(rng)
    else:
        inside[key] = _value(rng)


def resealed(path: Path, rng: random.Random) -> None:
    """Bytes of a journal are others, and its checksums are right again:
    what a forger would write.
    """
    rng.choice((flip, numbers))(path, rng)
    path.write_bytes(sealed_again(path.read_bytes()))


def sealed_again(content: bytes) -> bytes:
    """A journal whose frames were changed, with checksums that fit."""
    data = bytearray(content)
    for start in [found.start() for found in re.finditer(re.escape(MAGIC), content)]:
        if start + _HEAD_BYTES > len(data):
            break
        (packed_bytes,) = struct.unpack_from("<I", data, start + 20)
        crc = zlib.crc32(
            data[start + _HEAD_BYTES : start + _HEAD_BYTES + packed_bytes],
            zlib.crc32(data[start : start + 28]),
        )
        struct.pack_into("<I", data, start + 28, crc)
    return bytes(data)


def unlisted(path: Path, rng: random.Random) -> None:
    """Bytes of a part are others, and there is no manifest that says so."""
    (path.parent / "manifest.jsonl").unlink(missing_ok=True)
    rng.choice((flip, numbers))(path, rng)


def rewritten(path: Path, rng: random.Random) -> None:
    """A part is written again, with other rows in a column, and no manifest."""
    (path.parent / "manifest.jsonl").unlink(missing_ok=True)
    table = pq.read_table(path)
    place = rng.randrange(table.num_columns)
    field = table.schema.field(place)
    other = rng.choice((pa.nulls(table.num_rows, field.type), pa.array([_TEXT] * table.num_rows)))
    table = rng.choice(
        (table.set_column(place, field.name, other), table.append_column(field.name, other))
    )
    pq.write_table(
        table, path, compression=rng.choice(("zstd", "snappy", "none")), data_page_version="2.0"
    )


def picture(path: Path, rng: random.Random) -> None:
    """A PNG says another size in its head, and its checksum is right."""
    data = bytearray(path.read_bytes())
    if len(data) < 33:
        return
    struct.pack_into(
        ">II", data, 16, *(rng.choice((0, 1, 152, 20000, 2**31 - 1)) for _ in range(2))
    )
    data[24] = rng.choice((1, 2, 4, 8, 16))
    data[25] = rng.choice((0, 2, 3, 4, 6))
    struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    path.write_bytes(data)


_ANY: tuple[Mutation, ...] = (flip, cut, numbers, splice, gone, link, pipe, sparse, swap, planted)
_OF: dict[str, tuple[Mutation, ...]] = {
    ".json": (table,) * 6,
    ".jsonl": (table,) * 6,
    ".toml": (toml,) * 6,
    ".journal": (resealed,) * 6,
    ".parquet": (unlisted, unlisted, unlisted, rewritten),
    ".png": (picture,) * 3,
    ".rrd": (numbers, flip),
}
