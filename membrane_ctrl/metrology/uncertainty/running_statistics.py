"""Statistics of a run of figures in memory that does not grow with it.

The fitted height is linear in the parameters: their running mean and covariance hold the standard
deviation at every point of the mirror (see `height_map.HeightMap.sigma`).
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

# Points of the film whose height is followed, as (radius in analysis radii, azimuth in degrees). A
# tilt, a bend and a wave of the rim look different in the three.
_POINTS = {"A": (0.45, 90.0), "B": (0.70, 210.0), "C": (0.95, 330.0)}


def default_points_mm(analysis_radius_mm: float) -> dict[str, tuple[float, float]]:
    """Places (x, y) of the points A, B and C by name, mm."""
    places_mm = {}
    for name, (radius, azimuth_deg) in _POINTS.items():
        radius_mm = analysis_radius_mm * radius
        azimuth_rad = math.radians(azimuth_deg)
        places_mm[name] = (radius_mm * math.cos(azimuth_rad), radius_mm * math.sin(azimuth_rad))
    return places_mm


class RunningCovariance:
    """Running mean and covariance of vectors, by Welford's update.

    Attributes
    ----------
    count : int
        Number of vectors.
    mean : (k,) array
        Their mean.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean: FloatArray = np.zeros(size)
        self._squares: FloatArray = np.zeros((size, size))

    def add(self, vector: FloatArray) -> None:
        """Add a vector (k,)."""
        self.count += 1
        before = vector - self.mean
        self.mean = self.mean + before / self.count
        self._squares += np.outer(before, vector - self.mean)

    @property
    def covariance(self) -> FloatArray:
        """Unbiased covariance (k, k); zeros before the second vector."""
        return self._squares / max(self.count - 1, 1)


@dataclass
class Tally:
    """Running count, mean and range of a number; NaN before the first."""

    count: int = 0
    mean: float = math.nan
    low: float = math.nan
    high: float = math.nan

    def add(self, value: float) -> None:
        """Add a number."""
        self.count += 1
        if self.count == 1:
            self.mean = value
        else:
            self.mean += (value - self.mean) / self.count
        self.low = float(np.fmin(self.low, value))
        self.high = float(np.fmax(self.high, value))
