"""Statistics of a run of figures in memory that does not grow with it.

The fitted height is linear in the parameters: their running mean and covariance hold the standard
deviation at every point of the mirror (see `uncertainty.HeightMap.sigma`).
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.uncertainty.monte_carlo import trial_covariance
from membrane_ctrl.model.arrays import FloatArray

# Where the film is watched, as (radius in analysis radii, azimuth in degrees): a third of a turn
# apart and inside, halfway and near the rim, so that a tilt, a bend and a wave of the rim look
# different in the
# three.
_WATCHED = {"A": (0.45, 90.0), "B": (0.70, 210.0), "C": (0.95, 330.0)}


def default_points_mm(analysis_radius_mm: float) -> dict[str, tuple[float, float]]:
    """A, B and C: name to (x, y) in mm."""
    turns = {
        name: (analysis_radius_mm * r, math.radians(azimuth))
        for name, (r, azimuth) in _WATCHED.items()
    }
    return {
        name: (r_mm * math.cos(turn), r_mm * math.sin(turn)) for name, (r_mm, turn) in turns.items()
    }


class RunningCovariance:
    """Running mean and covariance of vectors, by Welford's update.

    Attributes
    ----------
    count : int
        Vectors seen.
    mean : (k,) array
        Of them.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean: FloatArray = np.zeros(size)
        self._squares: FloatArray = np.zeros((size, size))

    def add(self, vector: FloatArray) -> None:
        """Count one more."""
        self.count += 1
        before = vector - self.mean
        self.mean = self.mean + before / self.count
        self._squares += np.outer(before, vector - self.mean)

    @property
    def covariance(self) -> FloatArray:
        """(k, k), unbiased; zeros before the second vector."""
        return self._squares / max(self.count - 1, 1)


@dataclass
class Tally:
    """Running count, mean and range of a number; NaN before the first."""

    count: int = 0
    mean: float = math.nan
    low: float = math.nan
    high: float = math.nan

    def add(self, value: float) -> None:
        """Count one more."""
        self.count += 1
        self.mean = value if self.count == 1 else self.mean + (value - self.mean) / self.count
        self.low, self.high = float(np.fmin(self.low, value)), float(np.fmax(self.high, value))


# Changes of the figure over fixed times, with their uncertainty, for every set of a run.
#
# Both sets of a pair were disturbed with the same geometries (see `monte_carlo`), so that the
# effect of a wrong geometry on both cancels, trial by trial. Only the sets within the longest lag
# are kept.

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
