"""Changes of the figure over fixed times, with their uncertainty, for every set of a run.

Both sets of a pair were disturbed with the same geometries (see `monte_carlo`), so that what a wrong geometry does
to both alike cancels, trial by trial. Only the sets within the longest lag are kept.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.uncertainty import trial_covariance

FloatArray = NDArray[np.float64]

LAGS_S = (60.0, 600.0)  # the paper's
# A set this far from the wanted moment still stands for it: a run with a bad set in it has a neighbour there.
_TOLERANCE = 0.1


@dataclass(frozen=True)
class Moment:
    """A set at its time.

    Attributes
    ----------
    name : str
        Of the set.
    time_s : float
        Its middle on the run's clock.
    parameters : (36,) array
        Of its surface, in mm.
    trials : (trials, 36) array
        The same under the trials' geometries and noise.
    """

    name: str
    time_s: float
    parameters: FloatArray
    trials: FloatArray


@dataclass(frozen=True)
class Pair:
    """A change of the figure.

    Attributes
    ----------
    lag_s : float
        The lag that was asked for.
    earlier, later : Moment
        The two sets.
    """

    lag_s: float
    earlier: Moment
    later: Moment

    @property
    def change(self) -> FloatArray:
        """(36,) later minus earlier, in mm."""
        return self.later.parameters - self.earlier.parameters

    @property
    def covariance(self) -> FloatArray:
        """(36, 36) in mm^2, of the change trial by trial."""
        return trial_covariance(self.later.trials - self.earlier.trials)


class PairFinder:
    """Finds for each set the ones some lags before it."""

    def __init__(self, lags_s: Sequence[float] = LAGS_S) -> None:
        self._lags_s = tuple(lags_s)
        self._kept: deque[Moment] = deque()

    def add(self, moment: Moment) -> list[Pair]:
        """The pairs that end with this set: at most one a lag, none for a set without a time."""
        if not math.isfinite(moment.time_s):
            return []
        if self._kept and moment.time_s < self._kept[-1].time_s:
            self._kept.clear()  # another clock
        while self._kept and moment.time_s - self._kept[0].time_s > (1 + _TOLERANCE) * max(self._lags_s):
            self._kept.popleft()
        pairs = [
            Pair(lag, earlier, moment) for lag in self._lags_s if (earlier := self._at(moment.time_s - lag, lag))
        ]
        self._kept.append(moment)
        return pairs

    def _at(self, time_s: float, lag_s: float) -> Moment | None:
        nearest = min(self._kept, key=lambda kept: abs(kept.time_s - time_s), default=None)
        if nearest is None or abs(nearest.time_s - time_s) > _TOLERANCE * lag_s:
            return None
        return nearest
