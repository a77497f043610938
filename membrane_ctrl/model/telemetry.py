"""One row of telemetry per tick, and the names of its codes.

`columns` has the table of a row's columns. A row crosses to the other processes as plain doubles,
so that writing it costs the tick a few microseconds. Codes (state, shape state, fault, safe level)
are small integers; the order of the names gives them.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from operator import attrgetter

import numpy as np

from membrane_ctrl.model.arrays import Column, FloatArray
from membrane_ctrl.model.columns import COLUMNS, ColumnValues

FIELDS: tuple[str, ...] = tuple(COLUMNS)
_STRUCT = struct.Struct(f"<{len(FIELDS)}d")
ROW_BYTES = _STRUCT.size
# A mirror counts as settled this long after hold began and after each setpoint ramp: three
# closed-loop time constants of 1.45 s (docs/explanation/physics.md, inner loop) leave 5 % of a
# step, of which the `settle` state has
# already taken most.
SETTLED_AFTER_S = 5.0
COLUMN: dict[str, int] = {name: place for place, name in enumerate(FIELDS)}
_values = attrgetter(*FIELDS)  # astuple would copy deeply: 15 us per tick
Rows = FloatArray


class State(IntEnum):
    """States of the controller (docs/explanation/architecture.md)."""

    STANDBY = 0
    CHECK = 1
    INFLATE = 2
    SETTLE = 3
    HOLD = 4
    MANUAL = 5
    TUNE = 6
    LOWER = 7
    FAULT = 8


class ShapeState(IntEnum):
    """States of the shape loop inside `hold`."""

    OFF = 0
    WAITING = 1
    TRACKING = 2
    SUSPENDED = 3


class SafeLevel(IntEnum):
    """The safe levels, by their names in telemetry; each times out into the next."""

    NONE = 0
    HOLD_FLOW = 1
    RAMP_DOWN = 2
    PUMP_OFF = 3
    VENT = 4


@dataclass(frozen=True, slots=True)
class TelemetryRow(ColumnValues):
    """What one tick read, decided and wrote: its columns, and its bytes."""

    def format_quantity(self, name: str, sign: bool = False, width: int = 0) -> str:
        """Return the value of a column for people, with its unit: `+0.25 µm`.

        Parameters
        ----------
        name : str
            Column.
        sign : bool
            Whether a positive number has its sign.
        width : int
            Least width of the number.

        Returns
        -------
        str
        """
        column = COLUMNS[name]
        return f"{column.format_value(getattr(self, name), sign):>{width}} {column.unit}".rstrip()

    def format_labelled(self, name: str, sign: bool = False, width: int = 0) -> str:
        """Return a value with label and unit: `error +0.25 µm`.

        Parameters
        ----------
        name, sign, width
            As for `format_quantity`.
        """
        return f"{COLUMNS[name].short_label} {self.format_quantity(name, sign, width)}"

    def pack(self) -> bytes:
        """The row as doubles in field order."""
        return _STRUCT.pack(*_values(self))

    @classmethod
    def unpack(cls, message: bytes) -> "TelemetryRow":
        """Decode the row of `pack`. Raises struct.error."""
        return cls(*_STRUCT.unpack(message))


def name_codes(codes: type[IntEnum]) -> dict[int, str]:
    """Return the name of each code, in lower case."""
    return {int(code): code.name.lower() for code in codes}


def unpack_rows(messages: Sequence[bytes]) -> Rows:
    """Packed `TelemetryRow`s as a table (n, len(FIELDS))."""
    return np.frombuffer(b"".join(messages), dtype="<f8").reshape(-1, len(FIELDS))


def get_column(rows: Rows, name: str) -> FloatArray:
    """Return one column of all rows.

    Parameters
    ----------
    rows : (n, fields) array
        As `unpack_rows` returns them.
    name : str
        Field of `TelemetryRow`.

    Returns
    -------
    (n,) array
        A view, in the column's unit; NaN where the value is missing.
    """
    return rows[:, COLUMN[name]]


def get_columns(rows: Rows) -> dict[str, Column]:
    """All fields of rows by name, (n,) each."""
    return dict(zip(FIELDS, rows.T, strict=True))


def true_error_um(ticks: Mapping[str, Column]) -> Column:
    """Target minus true centre, with the sign of `error_um` (setpoint minus value); NaN on a real
    bench.

    Where another scalar than the centre is held, its offset belongs to the target.
    """
    target_um = ticks["target_um"]
    if "held_offset_um" in ticks:
        target_um = target_um + np.nan_to_num(ticks["held_offset_um"])
    return target_um - ticks["truth_displacement_um"]


def find_changes(codes: FloatArray, before: float) -> list[tuple[int, int]]:
    """Find where a code changes.

    Parameters
    ----------
    codes : (n,) array
        The code of each row; NaN where it is unknown.
    before : float
        The code before the first row; NaN for none.

    Returns
    -------
    list of (int, int)
        Row and new code of each change.
    """
    previous = np.concatenate(([before], codes[:-1]))
    return [
        (int(row), int(codes[row]))
        for row in np.flatnonzero((codes != previous) & np.isfinite(codes))
    ]
