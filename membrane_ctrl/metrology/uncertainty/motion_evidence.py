"""Which rigid motion of the bench explains what the frames show, and what it does to the figure.

A motion of camera, screen, lens or mirror changes the screen points by E per µm or µrad. The fit
of the surface takes S = (J^T W J)^-1 J^T W E of it for a change of the film; R = E - J S remains as
slopes that no surface has. Two observations contradict the film:

- the *ring*: the film is clamped in a ring, which does not tilt with it. The first harmonic of the
  rim's height, c = H p, stays while only the film moves; a motion changes it by H S a;
- the *slopes that no surface has*: their products with R, q = R^T W r, are G a for a motion a, with
  G = R^T W R.

Each group of motions (`bench_motions.GROUPS`) is estimated as if it were the only one:

    a = (A + 1 / K^2)^-1 b,  A = h^T C_c^-1 h + G C_q^-1 G,  b = h^T C_c^-1 c + G C_q^-1 q,  h = H S

with the covariances C_c and C_q of both observations. K is the size of a knock (`MotionGroup`):
some motions leave so little that their estimate is noise alone. The gain b^T a is the decrease of
chi-square.

Motions that are too small to be found are an error of the figure, too: each group adds
S (A + 1 / tau^2)^-1 S^T to the covariance, where tau, its allowance, is how far a body may move
without any sign.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.metrology.rays import rim_harmonics
from membrane_ctrl.metrology.rays.bench_motions import AXIAL_UM, GROUPS, group_columns
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, ZERNIKE_DEGREE

# K is at least some times what the mirror would have tilted: a camera that turns tilts the ring by
# a fourth, a screen that shifts by a fifth of it
_KNOCK_PER_TILT = 5.0
_CHANCE_GAIN = 4.0  # of each component of a group: below it there is no motion beyond the allowance
_SURE_GAIN = 25.0  # decrease of chi-square: 5 sigma
_PLAUSIBLE_GAIN = 9.0  # below the best: 3 sigma
# Effects on the figure (RMS without tilt): beyond the first, a proven motion degrades it; beyond
# the second, one that camera, screen or mirror may have made
_PROVEN_UM, _POSSIBLE_UM = 0.03, 0.1
_FIGURE = slice(FIRST_FIGURE_INDEX - 2, None)  # of the parameters: without tilt


@cache
def ring_tilt() -> FloatArray:
    """Matrix (2, parameters): cosine and sine of the rim's height around the azimuth, in mm."""
    return rim_harmonics.rim_harmonics()[[1, 1 + ZERNIKE_DEGREE]]


@dataclass(frozen=True)
class MotionEffects:
    """What each component of the motions does to figure, ring and slopes."""

    figure_mm: FloatArray  # S (parameters, components): per µm or µrad
    # R (components, 2, n): screen points that no surface explains, in the unit of the observation
    left: FloatArray

    @classmethod
    def of(cls, changes: FloatArray, jacobian: FloatArray, weights: FloatArray) -> "MotionEffects":
        """Of changes E (components, 2, n), derivatives J (2, parameters, n) in the same unit, and
        weights (2, n).
        """
        weighted = jacobian * weights[:, None]
        normal = np.einsum("apn,aqn->pq", weighted, jacobian)
        right = np.einsum("apn,kan->pk", weighted, changes)
        figure = np.linalg.solve(normal, right)
        return cls(figure, changes - np.einsum("apn,pk->kan", jacobian, figure))

    def gram(self, weights: FloatArray) -> FloatArray:
        """G (components, components)."""
        flat = self.left.reshape(len(self.left), -1)
        return np.asarray((flat * weights.ravel()) @ flat.T)


@dataclass(frozen=True)
class GroupFit:
    """A group of motions as the only cause."""

    group: int  # of `GROUPS`
    amount: FloatArray  # (1,) or (2,): µm or µrad
    gain: float  # decrease of chi-square

    def describe(self) -> str:
        """What moved, for a person."""
        size = float(np.linalg.norm(self.amount))
        return f"{GROUPS[self.group].name} by {size:.2g} {GROUPS[self.group].unit}"


@dataclass(frozen=True)
class MotionFinding:
    """The motions that explain an observation."""

    fits: tuple[GroupFit, ...]  # most likely first
    # (parameters, parameters): what motions beyond chance may have done to the figure, and what
    # motions may have done that are too small to be found; the latter is common to all frames
    found_mm2: FloatArray
    allowed_mm2: FloatArray
    figure_um: float  # RMS of the worst plausible effect, without tilt

    @property
    def covariance_mm2(self) -> FloatArray:
        """What motions may have done to the figure, (parameters, parameters)."""
        return self.found_mm2 + self.allowed_mm2

    @property
    def excess_gain(self) -> float:
        """By how much the best motion explains more than the film or a mirror that tilts."""
        mirror = max(fit.gain for fit in self.fits if GROUPS[fit.group].is_of_mirror)
        return self.fits[0].gain - mirror

    @property
    def is_sure(self) -> bool:
        """Whether something else than film and mirror has moved."""
        return self.excess_gain > _SURE_GAIN

    def describe(self) -> str:
        """The most likely motion, with the runner-up unless it is excluded."""
        best, second = self.fits[:2]
        if best.gain - second.gain > _PLAUSIBLE_GAIN:
            return best.describe()
        return f"it looks like {best.describe()}, or {second.describe()}"


def find_motion_doubt(motion: MotionFinding, own_mm2: FloatArray, tilt_urad: float) -> str:
    """Why a figure must not be used as it is; empty if the error bars suffice.

    Parameters
    ----------
    motion : MotionFinding
    own_mm2 : (parameters, parameters) array
        Covariance of the figure on a bench that has not moved.
    tilt_urad : float
        Of the ring since the reference.
    """
    if motion.is_sure and motion.figure_um > _PROVEN_UM:
        return f"knocked: {motion.describe()}; check camera and screen"
    own_um = 1e3 * math.sqrt(float(np.trace(own_mm2[_FIGURE, _FIGURE])))
    if motion.figure_um > max(own_um, _POSSIBLE_UM):
        return (
            f"tilted by {tilt_urad:.2g} µrad since the reference: camera, screen or mirror moved, "
            f"and the figure may be {motion.figure_um:.2f} µm off"
        )
    return ""


@dataclass(frozen=True)
class _GroupTest:
    """How a group of k components is estimated."""

    columns: slice
    by_ring: FloatArray  # h^T C_c^-1 (k, 2)
    by_left: FloatArray  # G C_q^-1 (k, k)
    information: FloatArray  # A (k, k)
    spread: FloatArray  # (A + 1 / K^2)^-1 (k, k), with K of the group

    def weigh(self, ring_mm: FloatArray, left: FloatArray) -> FloatArray:
        """b (k,)."""
        return np.asarray(self.by_ring @ ring_mm + self.by_left @ left[self.columns])


def _spread(information: FloatArray, size: float) -> FloatArray:
    """Covariance (k, k) of a group whose components are of this size unless seen otherwise."""
    return np.asarray(np.linalg.inv(information + np.eye(len(information)) / size**2))


class MotionTest:
    """Estimates motions from observations of the same covariance.

    Parameters
    ----------
    effects : MotionEffects
    ring_mm2 : (2, 2) array
        Covariance C_c of the ring's tilt.
    left_covariance, gram : (components, components) arrays
        C_q and G of the slopes that no surface has.
    """

    def __init__(
        self,
        effects: MotionEffects,
        ring_mm2: FloatArray,
        left_covariance: FloatArray,
        gram: FloatArray,
    ) -> None:
        self._effects = effects
        self._tests: list[_GroupTest] = []
        self._undetected_mm2 = np.zeros((len(effects.figure_mm),) * 2)
        ring_weight = np.linalg.inv(ring_mm2)
        for group, columns in zip(GROUPS, group_columns(), strict=True):
            tilt = ring_tilt() @ effects.figure_mm[:, columns]
            by_ring = tilt.T @ ring_weight
            own = gram[columns, columns]
            scatter = left_covariance[columns, columns]
            by_left = own @ np.linalg.pinv(scatter, rcond=1e-9, hermitian=True)
            information = by_ring @ tilt + by_left @ own
            spread = _spread(information, group.knock)
            self._tests.append(_GroupTest(columns, by_ring, by_left, information, spread))
            if group.allowance > 0:
                effect = effects.figure_mm[:, columns]
                allowed = _spread(information, group.allowance)
                self._undetected_mm2 += effect @ allowed @ effect.T

    def find(self, ring_mm: FloatArray, left: FloatArray) -> MotionFinding:
        """Estimate every group from the ring's tilt c (2,) and the products q (components,)."""
        weighed = [test.weigh(ring_mm, left) for test in self._tests]
        mirror = next(number for number, group in enumerate(GROUPS) if group.is_of_mirror)
        tilt = np.linalg.solve(self._tests[mirror].information, weighed[mirror])
        tilt_knock = _KNOCK_PER_TILT * float(np.linalg.norm(tilt))
        fits: list[GroupFit] = []
        for number, (test, right) in enumerate(zip(self._tests, weighed, strict=True)):
            spread = test.spread
            if tilt_knock > GROUPS[number].knock:
                spread = _spread(test.information, tilt_knock)
            amount = spread @ right
            fits.append(GroupFit(number, amount, float(right @ amount)))
        fits.sort(key=lambda fit: -fit.gain)
        worst, figure_um = _worst_effect(self._effects, fits)
        return MotionFinding(tuple(fits), np.outer(worst, worst), self._undetected_mm2, figure_um)


def _worst_effect(effects: MotionEffects, fits: list[GroupFit]) -> tuple[FloatArray, float]:
    """Change (parameters,) of the figure by the worst plausible motion, and its RMS without tilt.

    Amounts count as far as they are beyond chance.
    """
    worst, figure_um = np.zeros(len(effects.figure_mm)), -math.inf
    for fit in fits:
        group = GROUPS[fit.group]
        if group.is_of_mirror or group.knock <= AXIAL_UM:  # no error; within the allowance
            continue
        if fit.gain < fits[0].gain - _PLAUSIBLE_GAIN:
            continue
        columns = group_columns()[fit.group]
        chance = _CHANCE_GAIN * GROUPS[fit.group].components
        share = math.sqrt(max(0.0, 1 - chance / max(fit.gain, 1e-12)))
        effect = share * (effects.figure_mm[:, columns] @ fit.amount)
        size_um = 1e3 * float(np.linalg.norm(effect[_FIGURE]))
        if size_um > figure_um:
            worst, figure_um = effect, size_um
    return worst, max(figure_um, 0.0)
