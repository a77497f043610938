"""Slopes that the fit leaves, as means over patches of the mirror, and their effects."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.metrology.reconstruction.zonal_map import ResidualGrid
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.model.arrays import FloatArray

_PATCHES = 40  # across the mirror: slopes that the fit leaves are independent from one to the next


def pixel_sources(
    full: FullResult, slope_variance: FloatArray, noise_adu: float, share_of_waves: float
) -> Iterator[Source]:
    """Rows of the budget for the noise of the pixels, and for what the slopes show beyond it.

    Parameters
    ----------
    full : FullResult
        The figure of a set.
    slope_variance : (2,) array
        Variance of an x and of a y slope from the noise.
    noise_adu : float
        Noise of a pixel.
    share_of_waves : float
        Part of the residuals' square that waves of the response explain, which have a row of their
        own.
    """
    # White noise: the covariance inverse M inverse, with M the matrix of the slopes' variances.
    fit = full.fit
    inverse = fit.normal.inverse
    middle = slope_variance[0] * fit.normal.x + slope_variance[1] * fit.normal.y
    noise = inverse @ np.linalg.cholesky(middle)
    yield Source("noise_adu", "noise of the pixels", noise_adu, noise, False, False)

    # Residual slopes, as one error for each patch of the mirror.
    left = Patches.from_grid(full.fit_grid).effects(full.surface.radius_mm, inverse)
    left_urad = 1e6 * math.hypot(fit.residual_x, fit.residual_y)
    noise_mm2 = float(np.sum(noise**2) + share_of_waves * np.sum(left**2))
    description = "slopes that the fit leaves: light, dust, ripple"
    yield Source("slope_urad", description, left_urad, left, common=False, noise_mm2=noise_mm2)


@dataclass(frozen=True)
class Patches:
    """Means of residual slopes over patches of the mirror.

    Attributes
    ----------
    places_mm : (2, patches) array
        Mean place of the points of a patch.
    count : (patches,) array
        Number of its points.
    slopes : (2, patches) array
        Mean residual slopes along x and y.
    """

    places_mm: FloatArray
    count: FloatArray
    slopes: FloatArray

    @classmethod
    def from_points(
        cls, places_mm: FloatArray, count: FloatArray, slopes: FloatArray, reach_mm: float
    ) -> "Patches":
        """Average points over patches.

        Parameters
        ----------
        places_mm : (2, n) array
            The points on the mirror.
        count : (n,) array
            Weight of each.
        slopes : (2, n) array
            Residual slopes along x and y.
        reach_mm : float
            Half the side of the square that the patches cover.
        """
        # The patch of each point: the square from -reach to reach has _PATCHES a side.
        in_patches = (places_mm / reach_mm + 1) / 2 * _PATCHES
        column, row = np.clip(in_patches.astype(int), 0, _PATCHES - 1)
        patch = row * _PATCHES + column

        # Sums of weight, places and slopes over each patch, and their means.
        sums = [
            np.bincount(patch, count * part, _PATCHES**2)
            for part in (np.ones_like(count), *places_mm, *slopes)
        ]
        means = np.array(sums[1:]) / np.maximum(sums[0], 1.0)
        return cls(means[:2], np.asarray(sums[0], float), means[2:])

    @classmethod
    def from_grid(cls, grid: ResidualGrid) -> "Patches":
        """Average the cells of a grid, in which each pixel has its weight in the fit.

        The fit's matrix is made with the same weights. Slopes that the fit left out, of wrinkles at
        the rim, would seem to move it by millimetres.
        """
        seen = grid.count > 0
        x_mm, y_mm = np.meshgrid(grid.axis_mm, grid.axis_mm)
        places_mm = np.stack([x_mm[seen], y_mm[seen]])
        slopes = np.stack([grid.slope_x[seen], grid.slope_y[seen]])
        return cls.from_points(places_mm, grid.count[seen], slopes, float(grid.axis_mm[-1]))

    def effects(self, radius_mm: float, inverse: FloatArray) -> FloatArray:
        """Effects of the residual slopes on the parameters, if only those of different patches are
        independent.

        The patches are those of the mirror, whatever was seen: two sets of a bench have the same
        ones.

        Parameters
        ----------
        radius_mm : float
            Radius of the Zernike disc.
        inverse : (parameters, parameters) array
            Inverse of the fit's normal matrix.

        Returns
        -------
        (parameters, patches) array
            In mm.
        """
        _, of_x, of_y = surface_basis.evaluate_basis(*self.places_mm / radius_mm)
        x, y = self.count * self.slopes
        return np.asarray(inverse @ ((of_x * x + of_y * y) / radius_mm))
