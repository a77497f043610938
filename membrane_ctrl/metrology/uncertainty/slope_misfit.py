"""Slopes that no surface has, against those that the stated geometry explains.

A film's slopes are a gradient, whatever its shape: wrinkles and dents leave slopes that the fit's
terms cannot represent, but that integrate to a height. Rays through a bench that is not as it is
stated give slopes that do not integrate. The part of the residual slopes that is no gradient
therefore shows an error of the bench, and none of the film.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.reconstruction.zonal_map import ResidualGrid
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.response_harmonics import ResponseHarmonics
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Patches along a side, over which slopes are averaged: the pixels' noise falls below a microradian.
_PATCHES = 40
_LEAST_SEEN = 1 / 3  # of the fullest patch's cells; patches at the edge are left out
# Slopes without a surface that light and gamma leave on a sound bench (1 to 3 measured).
_LIGHT_URAD = 5.0
_CONTRADICTING_SIGMAS = 4.0
# Beyond this, light no longer explains them: gamma, flicker, blur and 5 % of ambient light leave
# less than a tenth.
_UNUSABLE_URAD = 100.0


@dataclass(frozen=True)
class SlopeMisfit:
    """Slopes that belong to no surface.

    Attributes
    ----------
    seen_urad : float
        Their RMS over patches of 1/40 of the analysis' diameter.
    explained_urad : float
        What the geometry's stated uncertainty and the light explain, 1 sigma.
    harmonics : ResponseHarmonics or None
        Waves of the response that explain them; None: they do not.
    """

    seen_urad: float
    explained_urad: float
    harmonics: ResponseHarmonics | None = None

    @property
    def contradicts(self) -> bool:
        """Whether no stated uncertainty explains them."""
        return self.seen_urad > _CONTRADICTING_SIGMAS * self.explained_urad

    @property
    def contradicts_bench(self) -> bool:
        """Whether an error of the bench may be their cause."""
        return self.contradicts and self.harmonics is None

    @property
    def unusable(self) -> bool:
        """Whether, besides, they are so large that the figure means nothing."""
        return self.contradicts and self.seen_urad > _UNUSABLE_URAD

    def describe(self) -> str:
        """The misfit in words."""
        return (
            f"{self.seen_urad:.0f} µrad of the slopes belong to no surface, where the stated "
            f"geometry and light explain {self.explained_urad:.0f} µrad"
        )


def measure_slope_misfit(
    bench: TrialBench, spread: GeometrySpread, grid: ResidualGrid, height_mm: FloatArray
) -> SlopeMisfit:
    """Compare the slopes without a surface with what the geometry's spread leaves of them.

    Parameters
    ----------
    bench : TrialBench
        The set's bench.
    spread : GeometrySpread
        How well it is known.
    grid : ResidualGrid
        Slopes that the fit leaves, in cells.
    height_mm : (n, n) array
        The height that fits them best (`zonal_map.integrate_residual`).

    Raises
    ------
    ArithmeticError
        If the spread is so wide that a fit does not converge.
    """
    seen_urad = measure_curl_urad(grid, height_mm)
    return SlopeMisfit(seen_urad, estimate_explained_urad(bench, spread))


def estimate_explained_urad(bench: TrialBench, spread: GeometrySpread) -> float:
    """Slopes without a surface, 1 sigma, that the geometry's spread and the light explain.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set.
    spread : GeometrySpread
        Its numbers count as independent: each is moved by its sigma.

    Raises
    ------
    ArithmeticError
        If the spread is so wide that a fit does not converge.
    """
    squares_urad2 = [_LIGHT_URAD**2]
    for k, sigma in enumerate(spread.sigmas):
        step = np.zeros(len(spread.names))
        step[k] = sigma
        fit = bench.fit(bench.geometry(spread.names, step), linear=True)
        # What the fit leaves belongs to no surface: the terms represent nearly all of the rest.
        squares_urad2.append(1e12 * (fit.residual_x**2 + fit.residual_y**2) / 2)
    return math.sqrt(sum(squares_urad2))


def measure_curl_urad(grid: ResidualGrid, height_mm: FloatArray) -> float:
    """RMS, µrad, of the slopes less the gradient of the height, averaged over patches.

    Parameters
    ----------
    grid : ResidualGrid
        Measured slopes of cells, less those of the fit.
    height_mm : (n, n) array
        Height over the fit that explains them best.
    """
    seen = grid.count > 0
    # The slope between two neighbouring cells: measured as the mean of theirs, and by the height.
    measured_x = (grid.slope_x[:, :-1] + grid.slope_x[:, 1:]) / 2
    measured_y = (grid.slope_y[:-1] + grid.slope_y[1:]) / 2
    off_x = measured_x - np.diff(height_mm, axis=1) / grid.step_mm
    off_y = measured_y - np.diff(height_mm, axis=0) / grid.step_mm

    # Their differences as means over patches, in which the noise of single cells averages out.
    patches_x = _average_patches(off_x, seen[:, :-1] & seen[:, 1:])
    patches_y = _average_patches(off_y, seen[:-1] & seen[1:])
    patches = np.concatenate([patches_x, patches_y])
    if not patches.size:
        return 0.0
    return 1e6 * float(np.sqrt(np.mean(np.square(patches))))


def _average_patches(values: FloatArray, valid: BoolArray) -> FloatArray:
    """Means over square patches of those that are valid; patches that are mostly empty are left
    out.
    """
    rows, columns = np.nonzero(valid)
    height, width = values.shape
    patch = (rows * _PATCHES // height) * _PATCHES + columns * _PATCHES // width
    counts = np.bincount(patch, minlength=_PATCHES**2)
    sums = np.bincount(patch, values[rows, columns], _PATCHES**2)
    used = counts > _LEAST_SEEN * counts.max(initial=0)
    return np.asarray(sums[used] / counts[used])
