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

with the covariances C_c and C_q of both observations. K is the size of a knock: some motions leave
so little that their estimate is noise alone. The gain b^T a is the decrease of chi-square.

Motions that are too small to be found are an error of the figure, too: each group adds
S (A + 1 / tau^2)^-1 S^T to the covariance, where tau, its allowance, is how far a body may move
without any sign.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.metrology.rays import rim_harmonics
from membrane_ctrl.metrology.rays.bench_motions import GROUPS, group_columns
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, ZERNIKE_DEGREE

# K: 100 µm or µrad, or some times what the mirror would have tilted: a camera that turns tilts the
# ring by a fourth, a screen that shifts by a fifth of it
_KNOCK, _KNOCK_PER_TILT = 100.0, 5.0
_CHANCE_GAIN = 9.0  # of each component of a group: below it there is no motion beyond the allowance
_SURE_GAIN = 25.0  # decrease of chi-square: 5 sigma
_PLAUSIBLE_GAIN = 9.0  # below the best: 3 sigma
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
class Observation:
    """What the frames show against the reference."""

    ring_mm: FloatArray  # c (2,)
    ring_mm2: FloatArray  # its covariance (2, 2)
    left: FloatArray  # q (components,)
    left_covariance: FloatArray  # (components, components)
    gram: FloatArray  # G (components, components)


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
    # (parameters, parameters): what motions may have done to the figure
    covariance_mm2: FloatArray
    figure_um: float  # RMS of the worst plausible effect, without tilt

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


def find_motion(effects: MotionEffects, seen: Observation) -> MotionFinding:
    """Estimate every group of motions from an observation."""
    groups = list(enumerate(group_columns()))
    evidence = [_evidence(effects, seen, columns) for _, columns in groups]
    mirror = next(number for number, group in enumerate(GROUPS) if group.is_of_mirror)
    tilt_urad = float(np.linalg.norm(np.linalg.solve(*evidence[mirror])))
    knock = max(_KNOCK, _KNOCK_PER_TILT * tilt_urad)
    fits: list[GroupFit] = []
    undetected = np.zeros((len(effects.figure_mm),) * 2)
    for (number, columns), (information, right) in zip(groups, evidence, strict=True):
        one = np.eye(len(right))
        amount = np.asarray(np.linalg.solve(information + one / knock**2, right), float)
        fits.append(GroupFit(number, amount, float(right @ amount)))
        if GROUPS[number].allowance > 0:
            effect = effects.figure_mm[:, columns]
            spread = np.linalg.inv(information + one / GROUPS[number].allowance ** 2)
            undetected += effect @ spread @ effect.T
    fits.sort(key=lambda fit: -fit.gain)
    worst, figure_um = _worst_effect(effects, fits)
    return MotionFinding(tuple(fits), undetected + np.outer(worst, worst), figure_um)


def _evidence(
    effects: MotionEffects, seen: Observation, columns: slice
) -> tuple[FloatArray, FloatArray]:
    """A (k, k) and b (k,) of a group of k components."""
    by_ring = ring_tilt() @ effects.figure_mm[:, columns]
    ring = by_ring.T @ np.linalg.inv(seen.ring_mm2)
    gram, scatter = seen.gram[columns, columns], seen.left_covariance[columns, columns]
    left = gram @ np.linalg.pinv(scatter, rcond=1e-9, hermitian=True)
    return ring @ by_ring + left @ gram, ring @ seen.ring_mm + left @ seen.left[columns]


def _worst_effect(effects: MotionEffects, fits: list[GroupFit]) -> tuple[FloatArray, float]:
    """Change (parameters,) of the figure by the worst plausible motion, and its RMS without tilt.

    Amounts count as far as they are beyond chance.
    """
    worst, figure_um = np.zeros(len(effects.figure_mm)), -math.inf
    for fit in fits:
        if fit.gain < fits[0].gain - _PLAUSIBLE_GAIN or GROUPS[fit.group].is_of_mirror:
            continue
        columns = group_columns()[fit.group]
        chance = _CHANCE_GAIN * GROUPS[fit.group].components
        share = math.sqrt(max(0.0, 1 - chance / max(fit.gain, 1e-12)))
        effect = share * (effects.figure_mm[:, columns] @ fit.amount)
        size_um = 1e3 * float(np.linalg.norm(effect[_FIGURE]))
        if size_um > figure_um:
            worst, figure_um = effect, size_um
    return worst, max(figure_um, 0.0)
