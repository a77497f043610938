"""The manifest of a table: what each finished part holds, so that damage is found where Parquet has
no checksum.

One JSON object a line, appended and synced after the part has its name. Page checksums of Parquet
cover the content of pages only. A line has the SHA-256 of the file, a CRC-32 of each column of each
row group with its page headers, and a copy of the footer.
"""

from __future__ import annotations

import base64
import contextlib
import zlib
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from membrane_ctrl.model import file_checksums, plain_json
from membrane_ctrl.model.files import read_bytes, read_text
from membrane_ctrl.run_files.table_store.disk import Disk
from membrane_ctrl.run_files.table_store.spec import MANIFEST

# A month of hours, each with a footer of 20 kB.
MANIFEST_BYTES_MAX = 100_000_000
FOOTER_BYTES_MAX = 8_000_000
_Count = Annotated[int, Field(ge=0, lt=1 << 53)]
_Crc = Annotated[int, Field(ge=0, lt=1 << 32)]


class GroupEntry(BaseModel):
    """A row group: times of its first and last row, and the CRC-32 of each of its columns."""

    model_config = ConfigDict(frozen=True)
    first_s: float
    last_s: float
    crc32: tuple[_Crc, ...]


class PartEntry(BaseModel):
    """A line of the manifest."""

    model_config = ConfigDict(frozen=True)
    number: _Count
    first_row: _Count
    rows: _Count
    size_bytes: _Count
    sha256: str
    footer: str  # zlib, base64
    groups: tuple[GroupEntry, ...]
    damage: tuple[str, ...] = ()  # of the journal from which the part was made

    @property
    def first_s(self) -> float:
        """Time of the first row."""
        return self.groups[0].first_s

    @property
    def last_s(self) -> float:
        """Time of the last row."""
        return self.groups[-1].last_s


def pack_footer(footer: bytes) -> str:
    """A footer as text."""
    return base64.b64encode(zlib.compress(footer, 9)).decode()


def unpack_footer(text: str) -> bytes | None:
    """The footer of `pack_footer`; None if it is damaged or too large."""
    inflating = zlib.decompressobj()
    try:
        footer = inflating.decompress(base64.b64decode(text, validate=True), FOOTER_BYTES_MAX)
    except (ValueError, zlib.error):
        return None
    return footer if inflating.eof else None


def append_entry(disk: Disk, folder: Path, entry: PartEntry) -> None:
    """Append a part's line to the manifest and sync it, in place of a torn last line.

    Parameters
    ----------
    disk : Disk
        The system calls.
    folder : Path
        Of the table.
    entry : PartEntry
        What the part holds.

    Raises
    ------
    OSError
        The disk did not take it; a torn line is then cut off.
    """
    path = folder / MANIFEST
    line = file_checksums.dumps_checked(entry.model_dump()) + "\n"
    size_bytes, whole_bytes = _measure_sizes(path)
    descriptor = disk.open_to_append(path)
    try:
        if whole_bytes < size_bytes:
            disk.truncate(descriptor, whole_bytes)
        disk.write(descriptor, line.encode())
        disk.sync(descriptor)
    except OSError:
        with contextlib.suppress(OSError):  # the next call does it as well
            disk.truncate(descriptor, whole_bytes)
        raise
    finally:
        disk.close(descriptor)


def _measure_sizes(path: Path) -> tuple[int, int]:
    """Bytes of the manifest, and of its whole lines."""
    try:
        data = read_bytes(path, MANIFEST_BYTES_MAX)
    except FileNotFoundError:
        return 0, 0
    return len(data), data.rfind(b"\n") + 1


def read_manifest(folder: Path, notes: list[str]) -> dict[int, PartEntry]:
    """The manifest's lines by the part's number.

    Parameters
    ----------
    folder : Path
        Folder of the table.
    notes : list of str
        Gets a line for damage. A torn last line, from a crash while it was written, counts as
        damage.

    Returns
    -------
    dict of PartEntry
        Of two lines on one part the later counts: it was sealed again.
    """
    name = f"{folder.name}/{MANIFEST}"
    try:
        text = read_text(folder / MANIFEST, MANIFEST_BYTES_MAX, errors="replace")
    except FileNotFoundError:
        return {}
    except OSError as error:
        notes.append(f"{name}: cannot be read ({error.strerror})")
        return {}
    lines = [line for line in text.split("\n") if line.strip()]
    entries = [_entry_of(line) for line in lines]
    damaged = entries.count(None)
    if damaged:
        notes.append(f"{name}: {damaged} damaged lines are left out")
    return {entry.number: entry for entry in entries if entry is not None}


def _entry_of(line: str) -> PartEntry | None:
    try:
        value = plain_json.loads(line)
        if not isinstance(value, dict) or not file_checksums.pop_checksum(value):
            return None
        entry = PartEntry.model_validate(value)
    except (ValueError, ValidationError):
        return None
    return entry if entry.groups else None
