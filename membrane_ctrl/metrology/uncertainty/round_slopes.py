"""The round part of the slopes that a fit leaves: means over rings of the mirror.

Waves around the mirror, of wrinkles at its rim, are a thousand times larger than a film's round
error and grow steeply with the radius. They cancel in the mean over a whole ring, if each sector of
the ring counts equally. The means of every fourth sector must then agree: their scatter is the
error of the ring's mean.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_SECTORS = 72
_GROUPS = 4  # of interleaved sectors
_RINGS_LEAST = 12
_RINGS_MOST = 60
_POINTS_A_SECTOR = 16.0  # on average: their noise is then far below their slopes
_LEAST_RADIUS_MM = 1e-9  # a point at the centre has no radial direction
_TINY = 1e-300  # keeps the mean of an empty cell finite


@dataclass(frozen=True)
class RoundSlopes:
    """Mean radial slopes of rings of even width.

    Attributes
    ----------
    inner_mm, outer_mm : (rings,) array
        Edges of the rings that were seen.
    slope : (rings,) array
        Mean over azimuth of the radial slope.
    sigma : (rings,) array
        1 sigma, by the scatter between interleaved sectors.
    share : (rings,) array
        Variance of the mean over that of a point's slope, by independent noise of the points.
    """

    inner_mm: FloatArray
    outer_mm: FloatArray
    slope: FloatArray
    sigma: FloatArray
    share: FloatArray

    @classmethod
    def from_points(
        cls, places_mm: FloatArray, count: FloatArray, slopes: FloatArray, reach_mm: float
    ) -> "RoundSlopes":
        """Average the slopes of points.

        Parameters
        ----------
        places_mm, slopes : (2, n) arrays
            Along x and y.
        count : (n,) array
            What each stands for; 0 leaves it out.
        reach_mm : float
            Outer edge of the last ring.
        """
        # As many rings as give each sector enough points.
        wanted = places_mm.shape[1] / _SECTORS / _POINTS_A_SECTOR
        rings = int(np.clip(wanted, _RINGS_LEAST, _RINGS_MOST))

        # The cell of each point: its ring and its sector.
        x, y = places_mm
        radius_mm = np.maximum(np.hypot(x, y), _LEAST_RADIUS_MM)
        ring = np.minimum((radius_mm / reach_mm * rings).astype(int), rings - 1)
        turns = np.arctan2(y, x) / (2 * np.pi) % 1.0
        sector = (turns * _SECTORS).astype(int) % _SECTORS
        cell = ring * _SECTORS + sector

        # Mean radial slope of each cell.
        size = rings * _SECTORS
        total = np.bincount(cell, count, size).reshape(rings, _SECTORS)
        radial = (slopes[0] * x + slopes[1] * y) / radius_mm
        sums = np.bincount(cell, count * radial, size).reshape(rings, _SECTORS)
        full = total > 0
        means = np.where(full, sums / np.maximum(total, _TINY), 0.0)

        # Means of every fourth sector; a ring counts if each of them was seen.
        groups = np.arange(_SECTORS) % _GROUPS == np.arange(_GROUPS)[:, None]
        filled = full.astype(float) @ groups.T
        of_groups = means @ groups.T / np.maximum(filled, 1.0)
        used = filled.min(axis=1) > 0

        # Variance of a ring's mean, from the scatter of its four. Neighbours have about the same
        # scatter, and that of four means is poorly known: it is averaged over three rings.
        scatter = np.var(of_groups[used], axis=1, ddof=1) / _GROUPS
        three = np.ones(3)
        neighbours = np.convolve(np.ones(scatter.size), three, "same")
        near = np.convolve(scatter, three, "same") / neighbours

        # Share of a point's noise in a ring's mean.
        inverse = np.where(full, 1 / np.maximum(total, _TINY), 0.0).sum(axis=1)
        edges = reach_mm * np.arange(rings + 1) / rings
        return cls(
            edges[:-1][used],
            edges[1:][used],
            of_groups[used].mean(axis=1),
            np.sqrt(near),
            (inverse / np.maximum(full.sum(axis=1), 1.0) ** 2)[used],
        )
