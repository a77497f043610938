"""Fewer rows for the viewer while nothing happens: every tick is in the other files (docs/recording.md)."""

from __future__ import annotations

import math

import numpy as np

from membrane_ctrl.recording.rows import COLUMN, Rows, column

# What a person wants every tick of: around a change of these, and while the error is outside the band.
_CODES = ("state", "shape_state", "rung", "fault")
_AFTER_S = 60.0
_BEFORE_S = 10.0


class QuietFilter:
    """Every tick for a minute after a change and ten seconds before it; otherwise `quiet_hz`.

    Parameters
    ----------
    rate_hz, quiet_hz : float
        Ticks, and rows of a quiet second.
    band_um : float
        An error beyond it is no quiet.
    """

    def __init__(self, rate_hz: float, quiet_hz: float, band_um: float) -> None:
        self._every = max(1, round(rate_hz / quiet_hz))
        self._band_um = band_um
        self._codes = np.full(len(_CODES), math.nan)
        self._lively_until_s = math.inf
        self._held: list[Rows] = []

    def take(self, rows: Rows) -> Rows:
        """The rows to send now, in time; those held back come along when something happens."""
        if self._every == 1 or not len(rows):
            return rows
        codes = rows[:, [COLUMN[name] for name in _CODES]]
        before = np.vstack((self._codes, codes[:-1]))
        lively = (codes != before).any(axis=1) | (np.abs(column(rows, "error_um")) > self._band_um)
        self._codes = codes[-1]
        if lively.any():
            self._lively_until_s = float(column(rows, "mono_s")[lively][-1]) + _AFTER_S
            held, self._held = self._held, []
            return np.concatenate((*held, rows))
        now_s = float(rows[-1, COLUMN["mono_s"]])
        if now_s < self._lively_until_s:
            return rows
        kept = column(rows, "tick") % self._every == 0
        self._held.append(rows[~kept])
        self._held = [part for part in self._held if len(part) and part[-1, COLUMN["mono_s"]] > now_s - _BEFORE_S]
        quiet: Rows = rows[kept]
        return quiet
