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
    full: FullResult, slope_variance: FloatArray, noise_adu: float
) -> Iterator[Source]:
    """White noise of the pixels; and what the slopes show beyond it, taken as one error per patch
    of the mirror.
    """
    inverse = full.fit.normal.inverse
    middle = slope_variance[0] * full.fit.normal.x + slope_variance[1] * full.fit.normal.y
    noise = inverse @ np.linalg.cholesky(middle)
    yield Source("noise_adu", "noise of the pixels", noise_adu, noise, False, False)
    left = Patches.of_grid(full.fit_grid).effects(full.surface.radius_mm, inverse)
    left_urad = 1e6 * math.hypot(full.fit.residual_x, full.fit.residual_y)
    says = "slopes that the fit leaves: gamma, light, dust, ripple"
    yield Source(
        "slope_urad", says, left_urad, left, common=False, noise_mm2=float(np.sum(noise**2))
    )


@dataclass(frozen=True)
class Patches:
    """Means of residual slopes over patches of the mirror."""

    places_mm: FloatArray  # (2, patches)
    count: FloatArray  # (patches,): points in each
    slopes: FloatArray  # (2, patches)

    @classmethod
    def of(
        cls, places_mm: FloatArray, count: FloatArray, slopes: FloatArray, reach_mm: float
    ) -> "Patches":
        """Of points that stand for `count` (n,) each, over a square of half the side `reach_mm`."""
        column, row = np.clip(
            ((places_mm / reach_mm + 1) / 2 * _PATCHES).astype(int), 0, _PATCHES - 1
        )
        patch = row * _PATCHES + column
        sums = [
            np.bincount(patch, count * part, _PATCHES**2)
            for part in (np.ones_like(count), *places_mm, *slopes)
        ]
        means = np.array(sums[1:]) / np.maximum(sums[0], 1.0)
        return cls(means[:2], np.asarray(sums[0], float), means[2:])

    @classmethod
    def of_grid(cls, grid: ResidualGrid) -> "Patches":
        """Of a measured set; in the grid each pixel has its weight in the fit.

        The fit's matrix is made with the same weights. Slopes that the fit left out, of wrinkles at
        the rim, would seem to move it by millimetres.
        """
        seen, (x, y) = grid.count > 0, np.meshgrid(grid.axis_mm, grid.axis_mm)
        slopes = np.stack([grid.slope_x[seen], grid.slope_y[seen]])
        return cls.of(
            np.stack([x[seen], y[seen]]), grid.count[seen], slopes, float(grid.axis_mm[-1])
        )

    def effects(self, radius_mm: float, inverse: FloatArray) -> FloatArray:
        """(parameters, patches) on the parameters if the residual slopes are independent from patch
        to patch only.

        The patches are those of the mirror, whatever was seen: two sets of a bench have the same
        ones. `inverse` is that of the fit's normal matrix.
        """
        _, of_x, of_y = surface_basis.evaluate_basis(*self.places_mm / radius_mm)
        x, y = self.count * self.slopes
        return np.asarray(inverse @ ((of_x * x + of_y * y) / radius_mm))
