"""Pairs of figures of a run that lie a given time apart, and their changes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from membrane_ctrl.metrology.uncertainty.monte_carlo import trial_covariance
from membrane_ctrl.model.arrays import FloatArray

LAGS_S = (60.0, 600.0)  # the paper's
# Largest difference from the requested lag, over the lag: next to a bad set a run has another one
# within it.
_TOLERANCE = 0.1


@dataclass(frozen=True)
class Moment:
    """A set at its time.

    Attributes
    ----------
    name : str
        Name of the set.
    time_s : float
        Its middle on the run's clock.
    parameters : (parameters,) array
        Parameters of its surface, mm.
    trials : (trials, parameters) array
        The same with the geometries and the noise of the trials.
    """

    name: str
    time_s: float
    parameters: FloatArray
    trials: FloatArray


@dataclass(frozen=True)
class FigurePair:
    """A change of the figure from one set to a later one.

    Attributes
    ----------
    lag_s : float
        The requested lag.
    earlier, later : Moment
        The two sets.
    """

    lag_s: float
    earlier: Moment
    later: Moment

    @property
    def change_mm(self) -> FloatArray:
        """Change (parameters,), mm, from the earlier set to the later."""
        return self.later.parameters - self.earlier.parameters

    @property
    def covariance(self) -> FloatArray:
        """Covariance (parameters, parameters), mm^2, of the change, trial by trial."""
        return trial_covariance(self.later.trials - self.earlier.trials)


class PairFinder:
    """Finds for each set of a run the earlier ones at some lags before it."""

    def __init__(self, lags_s: Sequence[float] = LAGS_S) -> None:
        self._lags_s = tuple(lags_s)
        self._kept: deque[Moment] = deque()

    def add(self, moment: Moment) -> list[FigurePair]:
        """Add the next set.

        Returns
        -------
        list of FigurePair
            The pairs that end with it: at most one for each lag, none for a set without a time.
        """
        if not math.isfinite(moment.time_s):
            return []
        if self._kept and moment.time_s < self._kept[-1].time_s:
            self._kept.clear()  # another clock
        longest_s = (1 + _TOLERANCE) * max(self._lags_s)
        while self._kept and moment.time_s - self._kept[0].time_s > longest_s:
            self._kept.popleft()
        pairs = []
        for lag_s in self._lags_s:
            earlier = self._find_nearest(moment.time_s - lag_s, lag_s)
            if earlier:
                pairs.append(FigurePair(lag_s, earlier, moment))
        self._kept.append(moment)
        return pairs

    def _find_nearest(self, time_s: float, lag_s: float) -> Moment | None:
        """The set nearest to a time; None if it is too far from there."""
        nearest = min(self._kept, key=lambda kept: abs(kept.time_s - time_s), default=None)
        if nearest is None or abs(nearest.time_s - time_s) > _TOLERANCE * lag_s:
            return None
        return nearest
