"""Statistics of a run of figures in memory that does not grow with it.

The fitted height is linear in the parameters: their running mean and covariance hold the standard
deviation at every point of the mirror (see `height_map.HeightMap.sigma`).
"""

import math
from dataclasses import dataclass

import numpy as np

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
