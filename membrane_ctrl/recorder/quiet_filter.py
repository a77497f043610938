"""Fewer rows for the viewer while nothing happens.

The tables and inputs of the run have every tick (docs/reference/recording.md).
"""

import math

import numpy as np

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.columns import COLUMNS, Kind

# Every tick is recorded around a change of these, and while the error is outside the band.
_CODES = tuple(each.name for each in COLUMNS.values() if each.kind is Kind.CODE)
_AFTER_S = 60.0
_BEFORE_S = 10.0


class QuietFilter:
    """Every tick for a minute after a change and ten seconds before it; otherwise `quiet_hz`.

    An error beyond `band_um` is not quiet.
    """

    def __init__(self, rate_hz: float, quiet_hz: float, band_um: float) -> None:
        self._every = max(1, round(rate_hz / quiet_hz))
        self._band_um = band_um
        self._codes = np.full(len(_CODES), math.nan)
        self._lively_until_s = math.inf
        self._held: list[telemetry.Rows] = []

    def select_rows(self, rows: telemetry.Rows) -> telemetry.Rows:
        """The rows to send now, in order of time; rows held back follow when something happens."""
        if self._every == 1 or not len(rows):
            return rows
        # Something happens: a code changes, or the mirror leaves the band
        codes = rows[:, [telemetry.COLUMN[name] for name in _CODES]]
        codes_before = np.vstack((self._codes, codes[:-1]))
        code_changes = (codes != codes_before).any(axis=1)
        is_outside = np.abs(telemetry.get_column(rows, "error_um")) > self._band_um
        lively = code_changes | is_outside
        self._codes = codes[-1]
        time_s = telemetry.get_column(rows, "mono_s")
        if lively.any():
            # All rows, after those that were held back, and all rows for some seconds from now
            self._lively_until_s = float(time_s[lively][-1]) + _AFTER_S
            held = self._held
            self._held = []
            return np.concatenate((*held, rows))
        now_s = float(time_s[-1])
        if now_s < self._lively_until_s:
            return rows
        # Quiet: every n-th row is sent; the others are held back for some seconds
        kept = telemetry.get_column(rows, "tick") % self._every == 0
        self._held.append(rows[~kept])
        since_s = now_s - _BEFORE_S
        self._held = [
            part
            for part in self._held
            if len(part) and part[-1, telemetry.COLUMN["mono_s"]] > since_s
        ]
        quiet: telemetry.Rows = rows[kept]
        return quiet
