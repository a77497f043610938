"""Is the model right, and do the sets belong together? All of it from the equations at the
solution.

Every test is the same: by how much does the sum of squares fall if more is free? With good data the
fall is a chi-square with as many degrees of freedom. Freed in turn: a parameter that was held (a
bent screen, a lens that distorts), the camera's pose for some of the sets, everything for one set.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibration import (
    figure_uncertainty,
    normal_equations,
    reference_rows,
    set_state,
    solver,
)
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses, disc_heights, set_phases
from membrane_ctrl.model.arrays import FloatArray, IntArray

SURE = 1e-6  # probability that good data look as bad
_CAMERA = tuple(
    bench_parameters.NAMES.index(name)
    for name in ("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg")
)
_CAMERA_SIGMA_DEG = 1.0  # of a bump: a hand on the mount
_CREEP_SIGMA_MM = 1.0
_LEAST_TO_CREEP = 3  # sets
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
    """Scale of the laser and its sigma by the optics alone (1: good); the fall is against the
    prior.
    """

    value: float
    sigma: float
    fall: float

    @property
    def sure(self) -> bool:
        """As for `Suspect`: whether it is off by more than its data sheet allows."""
        return bool(
            chi2.sf(((self.value - 1) / np.hypot(self.sigma, bench_parameters.LASER.sigma)) ** 2, 1)
            < SURE
        )


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
class MountCreep:
    """Camera or screen moved evenly from the first set to the last."""

    name: str  # of the parameter that explains most of it alone
    amount: float  # by which that one changed
    fall: float
    freedom: int

    @property
    def sure(self) -> bool:
        """As for `Suspect`."""
        return bool(chi2.sf(self.fall, self.freedom) < SURE)


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


def find_suspects(solution: solver.Solution) -> tuple[Suspect, ...]:
    """Held optical parameters that would remove more than noise from the residuals, the strongest
    first.
    """
    sums = np.sum(_reduce_equations(solution), axis=0)
    response = figure_uncertainty.surface_response(solution, solution.problem.middle)[:, :-1]
    flat = disc_heights.remove_plane(*disc_heights.heights_over_disc(1.0))
    out = []
    for name in bench_parameters.NAMES[len(bench_parameters.POSE) : bench_poses.OPTICAL]:
        if name in solution.free:
            continue
        k = bench_parameters.NAMES.index(name)
        freed = solution.problem.sigmas.copy()
        freed[k] = bench_parameters.usual_sigma(name)
        moved = solver.solve_step(sums + solution.known(freed), freed)
        fall = _sum_squares(sums, solution) - moved.squares
        sigma = float(np.sqrt(moved.covariance[k, k]))
        figure_um = 1e3 * float(np.std(flat @ (response @ moved.delta[: bench_poses.OPTICAL])))
        out.append(Suspect(name, float(moved.delta[k]), sigma, fall, figure_um))
    return tuple(sorted((s for s in out if s.sure), key=lambda s: -s.fall))


def laser_scale(solution: solver.Solution) -> LaserScale:
    """The laser's scale without a prior."""
    k = bench_parameters.NAMES.index(bench_parameters.LASER.name)
    free = solution.problem.sigmas.copy()
    free[k] = _LASER_SIGMA
    sums = np.sum(_reduce_equations(solution), axis=0)
    moved = solver.solve_step(sums + solution.known(free), free)
    fall = _sum_squares(sums, solution) - moved.squares
    return LaserScale(
        1 + float(solution.common[k] + moved.delta[k]), float(np.sqrt(moved.covariance[k, k])), fall
    )


def compare_left_out_sets(solution: solver.Solution) -> tuple[LeftOut, ...]:
    """Each set against the others."""
    reduced, sigmas = _reduce_equations(solution), solution.problem.sigmas
    own = solution.known(sigmas)
    everything = solver.solve_step(np.sum(reduced, axis=0) + own, sigmas).squares
    out = []
    for k, this in enumerate(reduced):
        others = np.sum([r for j, r in enumerate(reduced) if j != k], axis=0) + own
        alone, freedom = _fit_alone(this, sigmas)
        fall = everything - solver.solve_step(others, sigmas).squares - alone
        out.append(LeftOut(k, float(fall), freedom))
    return tuple(out)


def find_moved_screens(solution: solver.Solution) -> list[tuple[int, float]]:
    """Sets beside which the screen was moved, but not as stated: each with the fall if that place
    is free.
    """
    reduced, out = _reduce_equations(solution), []
    everything, moved = (
        _sum_squares(np.sum(reduced, axis=0), solution),
        np.arange(bench_poses.SCREEN_MOVE),
    )
    for k, each in enumerate(solution.equations):
        free = each.sums.copy()
        phases, state = solution.problem.sets[k], solution.states[k]
        for sums, known, move in zip(
            each.elsewhere, phases.elsewhere, state.elsewhere, strict=True
        ):
            told, sigmas = known.known(solution.problem.references.laser_sigma_um)[:, moved]
            hand = np.hstack([np.eye(moved.size), (told - move[moved])[:, None]]) / sigmas[:, None]
            own, without_hand = np.append(moved, len(sums) - 1), sums.copy()
            without_hand[np.ix_(own, own)] -= hand.T @ hand
            free += normal_equations.eliminate_first(
                without_hand, set_phases.MOVED
            ) - normal_equations.eliminate_first(sums, set_phases.MOVED)
        others = [*reduced[:k], replace(each, sums=free).reduced(), *reduced[k + 1 :]]
        fall = everything - _sum_squares(np.sum(others, axis=0), solution)
        if chi2.sf(fall, moved.size) < SURE:
            out.append((k, float(fall)))
    return out


def find_camera_bumps(solution: solver.Solution) -> tuple[CameraBump, ...]:
    """Turns of the camera for one set, or from one set on; only sure ones, the strongest first."""
    count = len(solution.states)
    groups = {(k,) for k in range(count)} | {tuple(range(k, count)) for k in range(1, count)}
    out = []
    for group in sorted(groups):
        share = np.isin(np.arange(count), group).astype(float)
        amounts, fall = _moved_by(
            solution, _CAMERA, share, np.full(len(_CAMERA), _CAMERA_SIGMA_DEG)
        )
        yaw, pitch, roll = amounts
        out.append(CameraBump(group, (yaw, pitch, roll), fall))
    return tuple(sorted((bump for bump in out if bump.sure), key=lambda bump: -bump.fall))


def find_mount_creep(solution: solver.Solution) -> MountCreep | None:
    """Whether camera or screen crept from the first set to the last, and what changed most; None if
    not sure.
    """
    count, poses = len(solution.states), tuple(range(len(bench_parameters.POSE)))
    if count < _LEAST_TO_CREEP:
        return None
    share = np.linspace(-0.5, 0.5, count)
    sigmas = np.array(
        [_CAMERA_SIGMA_DEG if p.unit == "deg" else _CREEP_SIGMA_MM for p in bench_parameters.POSE]
    )
    whole = _moved_by(solution, poses, share, sigmas)[1]
    single = [_moved_by(solution, (k,), share, sigmas[[k]]) for k in poses]
    most = max(poses, key=lambda k: single[k][1])
    found = MountCreep(bench_parameters.NAMES[most], single[most][0][0], whole, len(poses))
    return found if found.sure else None


def _moved_by(
    solution: solver.Solution, columns: tuple[int, ...], share: FloatArray, sigmas: FloatArray
) -> tuple[tuple[float, ...], float]:
    """Amounts by which parameters moved in the sets, each by its share, and the fall of the sum of
    squares.
    """
    reduced, hand = _reduce_equations(solution), solution.problem.sigmas
    sums = np.sum(
        [_with_more(each, columns, part) for each, part in zip(reduced, share, strict=True)], axis=0
    )
    known = _with_more(solution.known(hand), columns, 0.0)
    extra = np.arange(set_state.COMMON, set_state.COMMON + len(columns))
    known[extra, extra] += 1 / sigmas**2
    kept = np.append(
        hand > 0,
        np.ones(set_state.COMMON - len(bench_parameters.NAMES) + len(columns), bool),
    )
    delta, squares = _solve_free(sums + known, np.flatnonzero(kept))
    return tuple(delta[-len(columns) :].tolist()), _sum_squares(
        np.sum(reduced, axis=0), solution
    ) - squares


def leave_set_out(solution: solver.Solution, index: int) -> solver.Solution:
    """The solution without one set, to first order: its equations and state are left out, the
    unknowns moved.
    """
    keep = [k for k in range(len(solution.states)) if k != index]
    problem = replace(solution.problem, sets=tuple(solution.problem.sets[k] for k in keep))
    linear = tuple(solution.equations[k] for k in keep)
    sigmas = problem.sigmas
    moved = solver.solve_step(
        np.sum([each.reduced() for each in linear], axis=0) + solution.known(sigmas), sigmas
    )
    common = solution.common + moved.delta
    return replace(
        solution,
        problem=problem,
        values=common[: len(bench_parameters.NAMES)],
        common=common,
        states=tuple(solution.states[k] for k in keep),
        equations=linear,
        covariance=moved.covariance,
    )


def move_to_solution(solution: solver.Solution) -> solver.Solution:
    """The solution of equations that were changed, to first order: the unknowns of all and of each
    set moved.
    """
    sigmas = solution.problem.sigmas
    reduced = np.sum(_reduce_equations(solution), axis=0)
    moved = solver.solve_step(reduced + solution.known(sigmas), sigmas)
    common = solution.common + moved.delta
    pairs = zip(solution.states, solution.equations, strict=True)
    return replace(
        solution,
        values=common[: len(bench_parameters.NAMES)],
        common=common,
        states=tuple(solver.move_state(state, each, moved.delta) for state, each in pairs),
        covariance=moved.covariance,
    )


def _reduce_equations(solution: solver.Solution) -> list[FloatArray]:
    return [each.reduced() for each in solution.equations]


def film_rise(solution: solver.Solution, film: set_state.FilmModel) -> float:
    """By how much the sum of squares of a solution with a free film
    rises if the film is like that.
    """
    bound = _change_film_rows(
        solution, lambda _, state: (1.0, reference_rows.film_rows(state.surface, film))
    )
    return sum_of_squares(bound) - sum_of_squares(solution)


def bind_waves(solution: solver.Solution) -> solver.Solution:
    """The equations of a solution with waves, for a film without; its unknowns stay."""
    return _change_film_rows(
        solution, lambda phases, state: (1.0, reference_rows.wave_rows(phases, state, free=False))
    )


def wave_fall(solution: solver.Solution) -> float:
    """By how much the sum of squares of a solution without waves falls if the film has them."""
    without = _change_film_rows(
        solution, lambda phases, state: (-1.0, reference_rows.wave_rows(phases, state, free=False))
    )
    free = _change_film_rows(
        without, lambda phases, state: (1.0, reference_rows.wave_rows(phases, state, free=True))
    )
    return sum_of_squares(solution) - sum_of_squares(free)


def sum_of_squares(solution: solver.Solution) -> float:
    """Least sum of squares of the linearised equations."""
    return _sum_squares(np.sum(_reduce_equations(solution), axis=0), solution)


def _change_film_rows(
    solution: solver.Solution,
    rows_of: Callable[[set_phases.SetPhases, set_state.SetState], tuple[float, FloatArray]],
) -> solver.Solution:
    """The solution with rows added to the equations of its films, or subtracted."""
    changed = list(solution.equations)
    for k in solution.problem.films:
        sign, rows = rows_of(solution.problem.sets[k], solution.states[k])
        changed[k] = replace(changed[k], sums=changed[k].sums + sign * rows.T @ rows)
    return replace(solution, equations=tuple(changed))


def _sum_squares(sums: FloatArray, solution: solver.Solution) -> float:
    sigmas = solution.problem.sigmas
    return solver.solve_step(sums + solution.known(sigmas), sigmas).squares


def _fit_alone(reduced: FloatArray, sigmas: FloatArray) -> tuple[float, int]:
    """Least sum of squares of one set by itself, and how many numbers it determines; no prior."""
    free = np.flatnonzero(
        np.append(sigmas > 0, np.ones(set_state.COMMON - len(bench_parameters.NAMES), bool))
    )
    matrix, right = reduced[np.ix_(free, free)], reduced[free, -1]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    good = values > 1e-10
    along = vectors.T @ (right * scale)
    return float(reduced[-1, -1] - np.sum(along[good] ** 2 / values[good])), int(
        np.count_nonzero(good)
    )


def _with_more(sums: FloatArray, columns: Sequence[int], share: float) -> FloatArray:
    """The sums with more unknowns before the residual, which act as some of the parameters do,
    times a share.
    """
    order: Sequence[int] = [*range(set_state.COMMON), *columns, set_state.COMMON]
    out = sums[np.ix_(order, order)].copy()
    out[set_state.COMMON : -1, :] *= share
    out[:, set_state.COMMON : -1] *= share
    return np.asarray(out)


def _solve_free(sums: FloatArray, free: IntArray) -> tuple[FloatArray, float]:
    matrix, right = sums[np.ix_(free, free)], sums[free, -1]
    scale = 1 / np.sqrt(np.diag(matrix))
    found = scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right)
    delta = np.zeros(len(sums) - 1)
    delta[free] = found
    return delta, float(sums[-1, -1] - right @ found)
