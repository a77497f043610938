"""Is the model right, and do the sets belong together? All of it from the equations at the solution.

Every test is the same: by how much does the sum of squares fall if more is free? With good data the fall is a
chi-square with as many degrees of freedom. Freed in turn: a parameter that was held (a bent screen, a lens that
distorts), the camera's pose for some of the sets, everything for one set.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibrate import parameters, propagate, separable, solve
from membrane_ctrl.model.arrays import FloatArray, IntArray

SURE = 1e-6  # probability that good data look as bad
_CAMERA = tuple(parameters.NAMES.index(name) for name in ("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg"))
_CAMERA_SIGMA_DEG = 1.0  # of a bump: a hand on the mount
_LASER_SIGMA = 1.0  # of its scale when the optics alone determine it


@dataclass(frozen=True)
class Suspect:
    """A held parameter that the sets want to move."""

    name: str
    value: float  # its value if it were free
    sigma: float
    fall: float  # of the sum of squares
    figure_um: float  # effect of freeing it on a surface, RMS without the best plane

    @property
    def sure(self) -> bool:
        """Whether noise hardly ever causes as large a fall."""
        return bool(chi2.sf(self.fall, 1) < SURE)


@dataclass(frozen=True)
class LaserScale:
    """Scale of the laser and its sigma by the optics alone (1: good); the fall is against the prior."""

    value: float
    sigma: float
    fall: float

    @property
    def sure(self) -> bool:
        """As for `Suspect`: whether it is off by more than its data sheet allows."""
        return bool(chi2.sf(((self.value - 1) / np.hypot(self.sigma, parameters.LASER.sigma)) ** 2, 1) < SURE)


@dataclass(frozen=True)
class CameraBump:
    """The camera's pose differs for some of the sets."""

    sets: tuple[int, ...]
    turned_deg: tuple[float, float, float]
    fall: float

    @property
    def sure(self) -> bool:
        """As for `Suspect`."""
        return bool(chi2.sf(self.fall, len(_CAMERA)) < SURE)


@dataclass(frozen=True)
class LeftOut:
    """One set against the geometry of all others."""

    index: int  # of the set
    fall: float  # of the sum of squares, when this set has a geometry and a ring of its own
    freedom: int  # numbers that the set then determines by itself

    @property
    def disagrees(self) -> bool:
        """As for `Suspect.sure`."""
        return bool(chi2.sf(self.fall, self.freedom) < SURE)


def suspects(solution: solve.Solution) -> tuple[Suspect, ...]:
    """Held optical parameters that would remove more than noise from the residuals, the strongest first."""
    sums = np.sum(_reduced(solution), axis=0)
    response = propagate.surface_response(solution, len(solution.states) // 2)[:, :-1]
    flat = propagate.without_plane(*propagate.disc(1.0))
    out = []
    for name in parameters.NAMES[len(parameters.POSE) : parameters.OPTICAL]:
        if name in solution.free:
            continue
        k = parameters.NAMES.index(name)
        freed = solution.problem.sigmas.copy()
        freed[k] = parameters.usual_sigma(name)
        moved = solve.step(sums + solve.prior(freed, solution.common), freed)
        fall = _squares(sums, solution.problem.sigmas, solution.common) - moved.squares
        sigma = float(np.sqrt(moved.covariance[k, k]))
        figure_um = 1e3 * float(np.std(flat @ (response @ moved.delta[: parameters.OPTICAL])))
        out.append(Suspect(name, float(moved.delta[k]), sigma, fall, figure_um))
    return tuple(sorted((s for s in out if s.sure), key=lambda s: -s.fall))


def laser_scale(solution: solve.Solution) -> LaserScale:
    """The laser's scale without a prior."""
    k = parameters.NAMES.index(parameters.LASER.name)
    free = solution.problem.sigmas.copy()
    free[k] = _LASER_SIGMA
    sums = np.sum(_reduced(solution), axis=0)
    moved = solve.step(sums + solve.prior(free, solution.common), free)
    fall = _squares(sums, solution.problem.sigmas, solution.common) - moved.squares
    return LaserScale(1 + float(solution.common[k] + moved.delta[k]), float(np.sqrt(moved.covariance[k, k])), fall)


def left_out(solution: solve.Solution) -> tuple[LeftOut, ...]:
    """Each set against the others."""
    reduced, sigmas = _reduced(solution), solution.problem.sigmas
    own = solve.prior(sigmas, solution.common)
    everything = solve.step(np.sum(reduced, axis=0) + own, sigmas).squares
    out = []
    for k, this in enumerate(reduced):
        others = np.sum([r for j, r in enumerate(reduced) if j != k], axis=0) + own
        alone, freedom = _alone(this, sigmas)
        fall = everything - solve.step(others, sigmas).squares - alone
        out.append(LeftOut(k, float(fall), freedom))
    return tuple(out)


def bumps(solution: solve.Solution) -> tuple[CameraBump, ...]:
    """Turns of the camera for one set, or from one set on; only sure ones, the strongest first."""
    reduced, sigmas = _reduced(solution), solution.problem.sigmas
    count = len(reduced)
    before = _squares(np.sum(reduced, axis=0), sigmas, solution.common)
    groups = {(k,) for k in range(count)} | {tuple(range(k, count)) for k in range(1, count)}
    out = []
    for group in sorted(groups):
        sums = np.sum([_with_bump(each, k in group) for k, each in enumerate(reduced)], axis=0)
        known = _with_bump(solve.prior(sigmas, solution.common), False)
        extra = np.arange(separable.COMMON, separable.COMMON + len(_CAMERA))
        known[extra, extra] += 1 / _CAMERA_SIGMA_DEG**2
        ring = separable.COMMON - len(parameters.NAMES)
        kept = np.append(sigmas > 0, np.ones(ring + len(_CAMERA), bool))
        delta, squares = _solved(sums + known, np.flatnonzero(kept))
        yaw, pitch, roll = (float(v) for v in delta[-len(_CAMERA) :])
        out.append(CameraBump(group, (yaw, pitch, roll), before - squares))
    return tuple(sorted((bump for bump in out if bump.sure), key=lambda bump: -bump.fall))


def without(solution: solve.Solution, index: int) -> solve.Solution:
    """The solution without one set, to first order: its equations and state are left out, the unknowns moved."""
    keep = [k for k in range(len(solution.states)) if k != index]
    problem = replace(solution.problem, sets=tuple(solution.problem.sets[k] for k in keep))
    linear = tuple(solution.equations[k] for k in keep)
    sigmas = problem.sigmas
    moved = solve.step(
        np.sum([each.reduced() for each in linear], axis=0) + solve.prior(sigmas, solution.common), sigmas
    )
    common = solution.common + moved.delta
    return replace(
        solution,
        problem=problem,
        values=common[: len(parameters.NAMES)],
        common=common,
        states=tuple(solution.states[k] for k in keep),
        equations=linear,
        covariance=moved.covariance,
    )


def _reduced(solution: solve.Solution) -> list[FloatArray]:
    return [each.reduced() for each in solution.equations]


def _squares(sums: FloatArray, sigmas: FloatArray, common: FloatArray) -> float:
    return solve.step(sums + solve.prior(sigmas, common), sigmas).squares


def _alone(reduced: FloatArray, sigmas: FloatArray) -> tuple[float, int]:
    """Least sum of squares of one set by itself, and how many numbers it determines; no prior."""
    free = np.flatnonzero(np.append(sigmas > 0, np.ones(separable.COMMON - len(parameters.NAMES), bool)))
    matrix, right = reduced[np.ix_(free, free)], reduced[free, -1]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    good = values > 1e-10
    along = vectors.T @ (right * scale)
    return float(reduced[-1, -1] - np.sum(along[good] ** 2 / values[good])), int(np.count_nonzero(good))


def _with_bump(sums: FloatArray, bumped: bool) -> FloatArray:
    """The sums with three more unknowns before the residual; for a bumped set they act as the camera's turns do."""
    order: Sequence[int] = [*range(separable.COMMON), *_CAMERA, separable.COMMON]
    out = sums[np.ix_(order, order)].copy()
    if not bumped:
        out[separable.COMMON : -1, :], out[:, separable.COMMON : -1] = 0.0, 0.0
    return np.asarray(out)


def _solved(sums: FloatArray, free: IntArray) -> tuple[FloatArray, float]:
    matrix, right = sums[np.ix_(free, free)], sums[free, -1]
    scale = 1 / np.sqrt(np.diag(matrix))
    found = scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right)
    delta = np.zeros(len(sums) - 1)
    delta[free] = found
    return delta, float(sums[-1, -1] - right @ found)
