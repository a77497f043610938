"""Where nothing was measured, no line is drawn."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Column = NDArray[np.float64]

# A cycle or a second that is left out now and then is no gap.
_STEPS = 3.0
_LEAST_S = 5.0


def broken_at_gaps(columns: Mapping[str, Column], time_name: str = "time_s") -> dict[str, Column]:
    """Columns with a row of NaN in every gap, so that a plot does not bridge it with a straight line.

    Parameters
    ----------
    columns : mapping of str to (n,) or (n, m) array
    time_name : str
        The column of times, s, ascending. A gap is longer than 5 s and three of its usual steps.
    """
    time_s = columns[time_name]
    steps_s = np.diff(time_s)
    longest_s = max(_LEAST_S, _STEPS * float(np.median(steps_s))) if steps_s.size else np.inf
    before = np.flatnonzero(steps_s > longest_s)
    broken = {name: np.insert(np.asarray(values, np.float64), before + 1, np.nan, axis=0)
              for name, values in columns.items()}  # fmt: skip
    broken[time_name] = np.insert(time_s, before + 1, time_s[before] + steps_s[before] / 2)
    return broken
