"""Pairs of figures of a run that lie a given time apart, and their changes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from membrane_ctrl.metrology.uncertainty.monte_carlo import trial_covariance
from membrane_ctrl.model.arrays import FloatArray

LAGS_S = (60.0, 600.0)  # the paper's
# A set this far from the requested moment still serves: next to a bad set a run has a neighbour
# there.
_TOLERANCE = 0.1


@dataclass(frozen=True)
class Moment:
    """A set at its time."""

    name: str  # of the set
    time_s: float  # its middle on the run's clock
    parameters: FloatArray  # (parameters,): of its surface, in mm
    trials: FloatArray  # (trials, parameters): the same under the trials' geometries and noise


@dataclass(frozen=True)
class FigurePair:
    """A change of the figure."""

    lag_s: float  # the requested lag
    earlier: Moment
    later: Moment

    @property
    def change(self) -> FloatArray:
        """(parameters,) later minus earlier, in mm."""
        return self.later.parameters - self.earlier.parameters

    @property
    def covariance(self) -> FloatArray:
        """(parameters, parameters) in mm^2, of the change trial by trial."""
        return trial_covariance(self.later.trials - self.earlier.trials)


class PairFinder:
    """Finds for each set the ones some lags before it."""

    def __init__(self, lags_s: Sequence[float] = LAGS_S) -> None:
        self._lags_s = tuple(lags_s)
        self._kept: deque[Moment] = deque()

    def add(self, moment: Moment) -> list[FigurePair]:
        """The pairs that end with this set: at most one a lag, none for a set without a time."""
        if not math.isfinite(moment.time_s):
            return []
        if self._kept and moment.time_s < self._kept[-1].time_s:
            self._kept.clear()  # another clock
        while self._kept and moment.time_s - self._kept[0].time_s > (1 + _TOLERANCE) * max(
            self._lags_s
        ):
            self._kept.popleft()
        pairs = [
            FigurePair(lag, earlier, moment)
            for lag in self._lags_s
            if (earlier := self._at(moment.time_s - lag, lag))
        ]
        self._kept.append(moment)
        return pairs

    def _at(self, time_s: float, lag_s: float) -> Moment | None:
        nearest = min(self._kept, key=lambda kept: abs(kept.time_s - time_s), default=None)
        if nearest is None or abs(nearest.time_s - time_s) > _TOLERANCE * lag_s:
            return None
        return nearest
