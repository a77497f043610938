"""Robust weights of the points, from their residuals and from patterns that neighbours share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.rays import forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray

# across the mirror's picture: finer than the geometry's patterns, coarser than a film's ripple
_PATCHES = 12
_FEW_IN_PATCH = 4
_CHANCE = 0.5  # by which patches' variance exceeds single points' without a cause
# of the length of two normal components: keeps 95 % of the efficiency of least squares
_HUBER = 1.9


@dataclass(frozen=True)
class RobustWeights:
    """Robust weights (n,) of points, 1 for a good one, and their variance over the expected one."""

    weights: FloatArray
    variance: float
    alike: float = 1.0  # part of the variance from residuals that neighbours share: a pattern

    @classmethod
    def full(cls, phases: set_phases.SetPhases) -> "RobustWeights":
        """Every point with the weight of its noise."""
        return cls(np.ones(phases.sigma_mm.size), 1.0)

    @classmethod
    def seen(cls, phases: set_phases.SetPhases, residual_mm: FloatArray) -> "RobustWeights":
        """From residuals (2, n): Huber's weights against their own scatter."""
        length = np.hypot(*residual_mm) / phases.sigma_mm
        # the median of a Rayleigh distribution is 1.177 sigma; less noise than the camera must have
        # is not accepted
        variance = max(float(np.median(length) / 1.1774) ** 2, 1.0)
        return cls(_HUBER / np.maximum(length / np.sqrt(variance), _HUBER), variance)


def reduce_weights(
    sets: Sequence[set_phases.SetPhases],
    left_mm: Sequence[FloatArray],
    trust: Sequence[RobustWeights],
) -> tuple[RobustWeights, ...]:
    """Robust weights of the points of all sets, from their residuals (2, n) at a solution.

    What a film has beyond the model is alike in neighbouring points, and in all sets: it does not
    average out as noise does. So the means over patches of the picture are compared with what
    single points let expect, set by set and as sums over the sets; where they scatter more, all
    points weigh less.
    """
    films = [
        k for k, phases in enumerate(sets) if phases.artefact is None
    ]  # an artefact is seen smaller
    side_px = max(across_px(sets[k]) for k in films) / _PATCHES
    sides_px = [
        side_px if phases.artefact is None else across_px(phases) / _PATCHES for phases in sets
    ]
    patches = [_patch_means(*each) for each in zip(sets, left_mm, trust, sides_px, strict=True)]
    together = _reduced_chi_square(
        np.sum([patches[k] for k in films], axis=0) / np.sqrt(len(films))
    )
    alike = [together if phases.artefact is None else 0.0 for phases in sets]
    factors = [
        max(1.0, _reduced_chi_square(m) - _CHANCE, all_ - _CHANCE)
        for m, all_ in zip(patches, alike, strict=True)
    ]
    return tuple(
        replace(t, variance=t.variance * f, alike=f) for t, f in zip(trust, factors, strict=True)
    )


def across_px(phases: set_phases.SetPhases) -> float:
    """Longer side of the picture of what the camera sees."""
    return float(max(np.ptp(phases.column_px), np.ptp(phases.row_px)))


def _patch_means(
    phases: set_phases.SetPhases, left_mm: FloatArray, trust: RobustWeights, side_px: float
) -> FloatArray:
    """Residuals' means over patches in units of their noise, (2, patches, patches); NaN with few
    points.
    """
    column, row = (
        np.floor(place / side_px).astype(int) for place in (phases.column_px, phases.row_px)
    )
    count = _PATCHES + 2
    patch = row % count * count + column % count  # the same in all sets
    weights = trust.weights / (trust.variance * phases.sigma_mm**2)
    total = np.bincount(patch, weights, count**2)
    sums = np.stack([np.bincount(patch, weights * part, count**2) for part in left_mm])
    full = np.bincount(patch, minlength=count**2) >= _FEW_IN_PATCH
    return np.where(full, sums / np.sqrt(np.where(full, total, 1.0)), np.nan)


def _reduced_chi_square(means: FloatArray) -> float:
    """Their variance, as if they were alone: those that the fit has taken are as good as gone."""
    known = means[np.isfinite(means)]
    taken = forward_model.LOCAL_EVEN  # waves are small, and mostly held: they take little
    free = known.size - taken
    return float(np.sum(known**2) / free) if free > taken else 1.0
