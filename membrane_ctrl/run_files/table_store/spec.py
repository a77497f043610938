"""What a table is: its name, its columns, and the limits of its files."""

from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

# A part holds at most this much of a run, so that a damaged file costs at most an hour.
PART_S = 3600.0
# Of a table that can be made from a finer one, and that is read for years: a part has a footer of
# 10 kB, and hourly parts of minutes would be mostly footers.
LONG_PART_S = 86_400.0
# 10 minutes of ticks at 50 Hz.
GROUP_ROWS = 30_000
PART_SUFFIX = ".parquet"
JOURNAL_SUFFIX = ".journal"
MANIFEST = "manifest.jsonl"
_DIGITS = 4  # ten thousand hours


@dataclass(frozen=True, slots=True)
class TableSpec:
    """A table of a run.

    Attributes
    ----------
    name : str
        Of the table and its folder.
    schema : pyarrow.Schema
        Its columns; units and descriptions are metadata of the fields.
    time_name : str
        A column of rising seconds of the run.
    group_rows : int
        Rows of a row group, the smallest unit that is read or lost.
    layout : tuple of (str, str)
        Names and values of the program's numbers on which the meaning of the columns depends. The
        schema's metadata state them as well. A file that states others is not read.
    part_s : float
        The longest part of a run that one file holds.
    """

    name: str
    schema: pa.Schema
    time_name: str
    group_rows: int = GROUP_ROWS
    layout: tuple[tuple[str, str], ...] = ()
    part_s: float = PART_S


def part_path(folder: Path, number: int) -> Path:
    """The finished part of a number.

    Parameters
    ----------
    folder : Path
        Folder of the table, which has the table's name.
    number : int
        From 0 on, without gaps in a whole table.
    """
    return folder / f"{folder.name}-{number:0{_DIGITS}d}{PART_SUFFIX}"


def journal_path(folder: Path, number: int) -> Path:
    """The journal that becomes the part of the same number.

    Parameters
    ----------
    folder : Path
        Folder of the table, which has the table's name.
    number : int
        As for `part_path`.
    """
    return folder / f"{folder.name}-{number:0{_DIGITS}d}{JOURNAL_SUFFIX}"


def file_number(path: Path) -> int | None:
    """Number of a part or a journal; None for any other file."""
    stem, _, digits = path.stem.rpartition("-")
    if stem != path.parent.name or not (
        digits.isascii() and digits.isdigit() and len(digits) >= _DIGITS
    ):
        return None
    if len(digits) <= 2 * _DIGITS:
        return int(digits)
    return None
