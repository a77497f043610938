"""Compares replayed rows with recorded ones by their numbers, where the last bits may differ.

On another processor, or with other libraries, the last bits of a sum or of a sine may differ. Codes
(states, faults) must then be the same, and numbers within `NUMBERS_WITHIN` of their size. The table
of ticks holds computed columns in single precision; their later digits are compared in the
snapshots.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.arrays import BoolArray, Column, FloatArray
from membrane_ctrl.model.columns import COLUMNS, Kind
from membrane_ctrl.run_files import table_fields

NUMBERS_WITHIN = 1e-9  # of a number's size, at least of 1 unit
_SINGLE = 2.0**-24  # share of a number by which single precision may miss it
_CODES = np.array([column.kind is not Kind.QUANTITY for column in COLUMNS.values()])
_EXACT = np.array([table_fields.is_exact(name) for name in COLUMNS])


class RecordedRows:
    """The recorded rows of a run, in order of their ticks.

    Parameters
    ----------
    blocks : iterator of dict
        Columns of consecutive ticks, among them `tick`; a column that the run lacks is not
        compared.
    """

    def __init__(self, blocks: Iterator[Mapping[str, Column]]) -> None:
        self._blocks = blocks
        self._ticks: Column = np.empty(0)
        self._rows: FloatArray = np.empty((0, len(telemetry.FIELDS)))
        self._known: BoolArray = np.ones(len(telemetry.FIELDS), dtype=bool)

    def find_differing(self, row: telemetry.TelemetryRow) -> tuple[str, ...] | None:
        """Columns in which a row differs from the recorded one by more than rounding; None without
        a recorded one.

        Rows are asked for in order of their ticks.
        """
        recorded = self._find_row(row.tick)
        if recorded is None:
            return None
        today = np.frombuffer(row.pack())
        with np.errstate(invalid="ignore"):
            near = np.isfinite(today) & (np.abs(today - recorded) <= _compute_tolerances(today))
        same = near | (today == recorded) | (np.isnan(today) & np.isnan(recorded)) | ~self._known
        return tuple(
            name for name, is_same in zip(telemetry.FIELDS, same, strict=True) if not is_same
        )

    def _find_row(self, tick: float) -> FloatArray | None:
        while not self._ticks.size or self._ticks[-1] < tick:
            block = next(self._blocks, None)
            if block is None:
                return None
            missing = np.full(block["tick"].size, np.nan)
            self._ticks = block["tick"]
            self._rows = np.column_stack([block.get(name, missing) for name in telemetry.FIELDS])
            self._known = np.array([name in block for name in telemetry.FIELDS])
        place = int(np.searchsorted(self._ticks, tick))
        if self._ticks[place] != tick:
            return None
        row: FloatArray = self._rows[place]
        return row


def _compute_tolerances(values: FloatArray) -> FloatArray:
    """How far each column of a recorded row may be from a computed one with these values."""
    size = np.abs(values)
    recorded = np.where(_EXACT, 0.0, _SINGLE * size)
    found: FloatArray = np.where(_CODES, 0.0, recorded + NUMBERS_WITHIN * np.maximum(size, 1.0))
    return found
