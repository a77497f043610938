"""Robust weights of the points, from their residuals and from patterns that neighbours share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.rays import forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray

# Patches across the mirror's picture: finer than the geometry's patterns, coarser than a film's
# ripple.
_PATCHES = 12
_FEWEST_IN_PATCH = 4
# By how much the variance of patches may exceed that of single points by chance.
_CHANCE = 0.5
# Huber's limit for the length of two normal components: it keeps 95 % of the efficiency of least
# squares.
_HUBER = 1.9
_RAYLEIGH_MEDIAN = 1.1774  # in sigmas


@dataclass(frozen=True)
class RobustWeights:
    """Robust weights of the points of a set.

    Attributes
    ----------
    weights : (n,) array
        Weight of each point over that of its noise; 1 for a good one.
    variance : float
        Variance of the points over the expected one.
    pattern_factor : float
        Factor of the variance from residuals that neighbours share: a pattern.
    """

    weights: FloatArray
    variance: float
    pattern_factor: float = 1.0

    @classmethod
    def unweighted(cls, phases: set_phases.SetPhases) -> "RobustWeights":
        """Every point with the weight of its noise."""
        return cls(np.ones(phases.sigma_mm.size), 1.0)

    @classmethod
    def from_residual(
        cls, phases: set_phases.SetPhases, residual_mm: FloatArray
    ) -> "RobustWeights":
        """Return Huber's weights of residuals, against their own scatter.

        Parameters
        ----------
        phases : SetPhases
            The set; the scatter is not less than the noise of its points.
        residual_mm : (2, n) array
            What the solution leaves of the screen points.

        Returns
        -------
        RobustWeights
            1 up to `_HUBER` standard deviations, falling with the inverse of the residual beyond.
        """
        # Lengths of two normal components are distributed as Rayleigh's; their median gives the
        # scatter.
        length = np.hypot(*residual_mm) / phases.sigma_mm
        variance = max(float(np.median(length) / _RAYLEIGH_MEDIAN) ** 2, 1.0)
        return cls(_HUBER / np.maximum(length / np.sqrt(variance), _HUBER), variance)


def reduce_weights(
    sets: Sequence[set_phases.SetPhases],
    left_mm: Sequence[FloatArray],
    robust: Sequence[RobustWeights],
) -> tuple[RobustWeights, ...]:
    """Reduce the weights of sets whose residuals show a pattern.

    The shape that a film has beyond the model is the same in neighbouring points, and in all sets:
    it does not average out as noise does. The means over patches of the picture are compared with
    the scatter that single points predict, set by set and as sums over the sets; if they scatter
    more, all points of the set have less weight.

    Parameters
    ----------
    sets : sequence of SetPhases
        All sets.
    left_mm : sequence of (2, n) arrays
        Their residuals at a solution.
    robust : sequence of RobustWeights
        Their present weights.

    Returns
    -------
    tuple of RobustWeights
    """
    # Patches of one size for all films; an artefact is smaller in the picture.
    films = [k for k, phases in enumerate(sets) if phases.artefact is None]
    film_side_px = max(across_px(sets[k]) for k in films) / _PATCHES
    patches = []
    for phases, residual_mm, weights in zip(sets, left_mm, robust, strict=True):
        side_px = film_side_px
        if phases.artefact is not None:
            side_px = across_px(phases) / _PATCHES
        patches.append(_patch_means(phases, residual_mm, weights, side_px))

    # A pattern of all films shows in their sum, whose variance is that of one if they are
    # independent. An artefact shares no shape with the films.
    of_films = np.sum([patches[k] for k in films], axis=0) / np.sqrt(len(films))
    chi_square_of_films = _reduced_chi_square(of_films)
    reduced = []
    for phases, means, weights in zip(sets, patches, robust, strict=True):
        common = chi_square_of_films
        if phases.artefact is not None:
            common = 0.0
        factor = max(1.0, _reduced_chi_square(means) - _CHANCE, common - _CHANCE)
        reduced.append(replace(weights, variance=weights.variance * factor, pattern_factor=factor))
    return tuple(reduced)


def across_px(phases: set_phases.SetPhases) -> float:
    """Longer side of the picture of what the camera sees."""
    return float(max(np.ptp(phases.column_px), np.ptp(phases.row_px)))


def _patch_means(
    phases: set_phases.SetPhases, left_mm: FloatArray, robust: RobustWeights, side_px: float
) -> FloatArray:
    """Means of residuals (2, n) over patches in units of their noise, (2, patches); NaN with few
    points.
    """
    # The patch of each point; the same place has the same patch in all sets.
    column = np.floor(phases.column_px / side_px).astype(int)
    row = np.floor(phases.row_px / side_px).astype(int)
    count = _PATCHES + 2
    patch = row % count * count + column % count

    # Weighted means over their standard errors.
    weights = robust.weights / (robust.variance * phases.sigma_mm**2)
    total = np.bincount(patch, weights, count**2)
    sums = np.stack([np.bincount(patch, weights * part, count**2) for part in left_mm])
    is_full = np.bincount(patch, minlength=count**2) >= _FEWEST_IN_PATCH
    return np.where(is_full, sums / np.sqrt(np.where(is_full, total, 1.0)), np.nan)


def _reduced_chi_square(means: FloatArray) -> float:
    """Reduced chi-square of patch means, without the degrees of freedom that the fit used.

    Waves count as unused: they are small, and mostly held.
    """
    known = means[np.isfinite(means)]
    fitted = forward_model.LOCAL_EVEN
    freedom = known.size - fitted
    if freedom <= fitted:
        return 1.0
    return float(np.sum(known**2) / freedom)
