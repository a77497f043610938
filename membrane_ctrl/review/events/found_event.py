"""What a detected event is, and the stretches of flags that make one."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from membrane_ctrl.model.arrays import BoolArray, FloatArray

Level = dict[str, FloatArray]


@dataclass(frozen=True, slots=True)
class FoundEvent:
    """A detected event."""

    # "pressure step", "flow step", "laser glitch", "laser lost", "optics lost", "barometer lost",
    # "thermometer lost", "lateness burst", "noise change", "shape jump" or "excursion"
    kind: str
    time_s: float  # time of the event
    start_s: float  # time range of the run that shows it
    end_s: float
    size: float  # in `unit`
    unit: str
    confidence: (
        float  # 1 minus the probability that noise alone looks like this somewhere in the run
    )


def event_around(
    kind: str, table: Level, row: int, half_s: float, size: float, unit: str, confidence: float
) -> FoundEvent:
    """An event with a time range of several detection windows around it.

    Parameters
    ----------
    kind : str
        What happened.
    table : Level
        Windows of the run.
    row : int
        The window in which it was found.
    half_s : float
        Length of the detection windows before and after it.
    size : float
        How large it is, in `unit`.
    unit : str
        Unit of the size.
    confidence : float
        From 0 to 1.
    """
    time_s = float(table["time_s"][row])
    return FoundEvent(
        kind, time_s, time_s - 30 * half_s**0.5, time_s + 30 * half_s**0.5, size, unit, confidence
    )


def widen_flags(flags: BoolArray, rows: int) -> BoolArray:
    """Widen the stretches of true flags.

    Parameters
    ----------
    flags : (n,) bool array
        The flags.
    rows : int
        By how many on each side.

    Returns
    -------
    (n,) bool array
    """
    return np.asarray(
        ndimage.maximum_filter1d(flags, 2 * rows + 1, mode="constant", cval=0), dtype=bool
    )


def find_stretches(flags: BoolArray, join: int) -> list[tuple[int, int]]:
    """Find the stretches of true rows.

    Parameters
    ----------
    flags : (n,) bool array
        The flags.
    join : int
        Stretches at most this many rows apart are one.

    Returns
    -------
    list of (int, int)
        First and last row of each.
    """
    rows = np.flatnonzero(flags)
    if not rows.size:
        return []
    parts = np.split(rows, np.flatnonzero(np.diff(rows) > join) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]
