"""One event found by machine, and what its finders share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Level = dict[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Found:
    """An event that nobody reported.

    Attributes
    ----------
    kind : str
        "pressure step", "leak step", "laser glitch", "laser lost", "barometer lost", "thermometer lost",
        "lateness burst", "noise change", "shape jump" or "excursion".
    start_s, end_s : float
        Time range of the run that shows it.
    time_s : float
        When it happened.
    size : float
        In `unit`.
    unit : str
    confidence : float
        1 minus the chance that noise alone looks like this somewhere in the run.
    """

    kind: str
    time_s: float
    start_s: float
    end_s: float
    size: float
    unit: str
    confidence: float


def event_around(kind: str, table: Level, row: int, half_s: float, size: float, unit: str, sure: float) -> Found:
    """An event with a range about it of some times what it was found in."""
    time_s = float(table["time_s"][row])
    return Found(kind, time_s, time_s - 30 * half_s**0.5, time_s + 30 * half_s**0.5, size, unit, sure)


def widened(flags: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """True rows and so many on each side of them."""
    return np.asarray(ndimage.maximum_filter1d(flags, 2 * rows + 1, mode="constant", cval=0), dtype=bool)


def runs(flags: NDArray[np.bool_], join: int) -> list[tuple[int, int]]:
    """First and last row of each stretch of true rows; those `join` or fewer apart are one."""
    rows = np.flatnonzero(flags)
    if not rows.size:
        return []
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > join) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]
