"""Times that a file's rows cannot have: a flipped byte makes a second of the year 30 000 000 and a run as long."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A file of a table holds six hours, a segment at most a day (the limit of `recording.segment_s`).
_FILE_MAX_S = 86_400.0


def possible_times(time_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of a file's (n,) times are finite and within a day of most others."""
    finite = np.isfinite(time_s)
    if not finite.any():
        return finite
    return np.asarray(finite & (np.abs(time_s - np.median(time_s[finite])) <= _FILE_MAX_S))
