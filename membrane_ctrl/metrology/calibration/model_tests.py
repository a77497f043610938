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
from membrane_ctrl.metrology.rays import (
    bench_parameters,
    bench_poses,
    disc_heights,
    moved_screen,
    set_phases,
)
from membrane_ctrl.model.arrays import FloatArray, IntArray

SIGNIFICANCE = 1e-6  # probability that good data look as bad
_CAMERA = tuple(
    bench_parameters.NAMES.index(name)
    for name in ("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg")
)
_CAMERA_SIGMA_DEG = 1.0  # of a bump: a hand on the mount
_CREEP_SIGMA_MM = 1.0
_LEAST_TO_CREEP = 3  # sets
_LASER_SIGMA = 1.0  # of its scale when the optics alone determine it
_DETERMINED = 1e-10  # eigenvalue, of scaled equations, from which on a combination is determined
_SMALLEST_SQUARE = 1e-300  # keeps the scale of an unknown that nothing depends on finite


def _is_significant(fall: float, freedom: int) -> bool:
    """Whether noise hardly ever causes as large a fall of the sum of squares.

    With good data the fall is a chi-square of so many degrees of freedom.
    """
    return bool(chi2.sf(fall, freedom) < SIGNIFICANCE)


@dataclass(frozen=True)
class Suspect:
    """A held parameter that the sets want to move.

    Attributes
    ----------
    name : str
        Of the parameter.
    value, sigma : float
        Its value and standard uncertainty if it were free.
    fall : float
        By how much the sum of squares then falls.
    figure_um : float
        Effect of freeing it on a surface, RMS without the best plane.
    """

    name: str
    value: float
    sigma: float
    fall: float
    figure_um: float

    @property
    def is_significant(self) -> bool:
        """Whether noise hardly ever causes as large a fall."""
        return _is_significant(self.fall, 1)


@dataclass(frozen=True)
class LaserScale:
    """Scale of the laser by the optics alone.

    Attributes
    ----------
    value, sigma : float
        The scale (1: good) and its standard uncertainty.
    fall : float
        By how much the sum of squares falls without the prior.
    """

    value: float
    sigma: float
    fall: float

    @property
    def is_significant(self) -> bool:
        """As for `Suspect`: whether it is off by more than its data sheet allows."""
        sigma = np.hypot(self.sigma, bench_parameters.LASER.sigma)
        return _is_significant(((self.value - 1) / sigma) ** 2, 1)


@dataclass(frozen=True)
class CameraBump:
    """The camera's pose differs for some of the sets.

    Attributes
    ----------
    sets : tuple of int
        Numbers of these sets.
    turned_deg : three floats
        Yaw, pitch and roll by which the camera turned.
    fall : float
        By how much the sum of squares falls if it is free.
    """

    sets: tuple[int, ...]
    turned_deg: tuple[float, float, float]
    fall: float

    @property
    def is_significant(self) -> bool:
        """As for `Suspect`."""
        return _is_significant(self.fall, len(_CAMERA))


@dataclass(frozen=True)
class MountCreep:
    """Camera or screen moved evenly from the first set to the last.

    Attributes
    ----------
    name : str
        Of the parameter that explains most of it alone.
    amount : float
        By which that one changed.
    fall : float
        By how much the sum of squares falls if all poses creep.
    freedom : int
        Number of these poses.
    """

    name: str
    amount: float
    fall: float
    freedom: int

    @property
    def is_significant(self) -> bool:
        """As for `Suspect`."""
        return _is_significant(self.fall, self.freedom)


@dataclass(frozen=True)
class LeftOut:
    """One set against the geometry of all others.

    Attributes
    ----------
    index : int
        Of the set.
    fall : float
        By how much the sum of squares falls if this set has a geometry and a ring of its own.
    freedom : int
        Numbers that the set then determines by itself.
    """

    index: int
    fall: float
    freedom: int

    @property
    def disagrees(self) -> bool:
        """As for `Suspect.is_significant`."""
        return _is_significant(self.fall, self.freedom)


def find_suspects(solution: solver.Solution) -> tuple[Suspect, ...]:
    """Held optical parameters that would remove more than noise from the residuals, the strongest
    first.
    """
    sums = np.sum(_reduce_equations(solution), axis=0)
    held_squares = _sum_squares(sums, solution)

    # From a change of the parameters to the change of a surface, without its plane.
    response = figure_uncertainty.surface_response(solution, solution.problem.middle_film_set)[
        :, :-1
    ]
    flat_heights = disc_heights.remove_plane(*disc_heights.heights_over_disc(1.0))

    suspects = []
    for name in bench_parameters.NAMES[len(bench_parameters.POSE) : bench_poses.OPTICAL]:
        if name in solution.free_names:
            continue
        # The solution with this one free.
        k = bench_parameters.NAMES.index(name)
        freed = solution.problem.sigmas.copy()
        freed[k] = bench_parameters.usual_sigma(name)
        moved = solver.solve_step(sums + solution.prior_sums(freed), freed)

        change_mm = flat_heights @ (response @ moved.delta[: bench_poses.OPTICAL])
        suspect = Suspect(
            name=name,
            value=float(moved.delta[k]),
            sigma=float(np.sqrt(moved.covariance[k, k])),
            fall=held_squares - moved.squares,
            figure_um=1e3 * float(np.std(change_mm)),
        )
        if suspect.is_significant:
            suspects.append(suspect)
    return tuple(sorted(suspects, key=lambda suspect: -suspect.fall))


def laser_scale(solution: solver.Solution) -> LaserScale:
    """The laser's scale without a prior."""
    # One step from the solution, with a wide sigma instead of the prior.
    k = bench_parameters.NAMES.index(bench_parameters.LASER.name)
    free = solution.problem.sigmas.copy()
    free[k] = _LASER_SIGMA
    sums = np.sum(_reduce_equations(solution), axis=0)
    moved = solver.solve_step(sums + solution.prior_sums(free), free)
    return LaserScale(
        value=1 + float(solution.common[k] + moved.delta[k]),
        sigma=float(np.sqrt(moved.covariance[k, k])),
        fall=_sum_squares(sums, solution) - moved.squares,
    )


def compare_left_out_sets(solution: solver.Solution) -> tuple[LeftOut, ...]:
    """Each set against the others: the fall of the sum of squares if it is solved by itself."""
    reduced = _reduce_equations(solution)
    together = _sum_squares(np.sum(reduced, axis=0), solution)
    compared = []
    for k, of_set in enumerate(reduced):
        others = np.sum([sums for j, sums in enumerate(reduced) if j != k], axis=0)
        alone, freedom = _fit_alone(of_set, solution.problem.sigmas)
        fall = together - _sum_squares(others, solution) - alone
        compared.append(LeftOut(k, float(fall), freedom))
    return tuple(compared)


def find_moved_screens(solution: solver.Solution) -> list[tuple[int, float]]:
    """Sets beside which the screen was moved, but not as stated: each with the fall if that place
    is free.
    """
    reduced = _reduce_equations(solution)
    held_squares = _sum_squares(np.sum(reduced, axis=0), solution)
    found = []
    for k, of_set in enumerate(solution.equations):
        # The equations of this set with the screens' moves free.
        free = replace(of_set, sums=_free_screen_moves(solution, k))
        others = [*reduced[:k], free.eliminate_surface(), *reduced[k + 1 :]]
        fall = held_squares - _sum_squares(np.sum(others, axis=0), solution)
        if _is_significant(fall, bench_poses.SCREEN_MOVE):
            found.append((k, float(fall)))
    return found


def _free_screen_moves(solution: solver.Solution, k: int) -> FloatArray:
    """Sums of set k without what was stated of its screens' moves."""
    phases = solution.problem.sets[k]
    state = solution.states[k]
    of_set = solution.equations[k]
    laser_sigma_um = solution.problem.references.laser_sigma_um
    places = np.arange(bench_poses.SCREEN_MOVE)
    free = of_set.sums.copy()
    for sums, known, move in zip(
        of_set.moved_screens, phases.moved_screens, state.moved_screens, strict=True
    ):
        # The rows of the stated move, which were added to the normal equations.
        stated, sigmas = known.make_prior(laser_sigma_um)[:, places]
        off = stated - move[places]
        stated_rows = np.hstack([np.eye(places.size), off[:, None]])
        stated_rows /= sigmas[:, None]
        own = np.append(places, len(sums) - 1)
        without_stated = sums.copy()
        without_stated[np.ix_(own, own)] -= stated_rows.T @ stated_rows

        # Their effect on the unknowns of the set.
        free += normal_equations.eliminate_first(without_stated, moved_screen.MOVED)
        free -= normal_equations.eliminate_first(sums, moved_screen.MOVED)
    return np.asarray(free)


def find_camera_bumps(solution: solver.Solution) -> tuple[CameraBump, ...]:
    """Turns of the camera for one set, or from one set on; only sure ones, the strongest first."""
    count = len(solution.states)
    # Groups of sets that one bump may have moved.
    single = {(k,) for k in range(count)}
    from_one_on = {tuple(range(k, count)) for k in range(1, count)}
    sigmas = np.full(len(_CAMERA), _CAMERA_SIGMA_DEG)
    bumps = []
    for group in sorted(single | from_one_on):
        # The camera's three angles are free for this group alone.
        share = np.isin(np.arange(count), group).astype(float)
        amounts, fall = _free_motion(solution, _CAMERA, share, sigmas)
        yaw, pitch, roll = amounts
        bump = CameraBump(group, (yaw, pitch, roll), fall)
        if bump.is_significant:
            bumps.append(bump)
    return tuple(sorted(bumps, key=lambda bump: -bump.fall))


def find_mount_creep(solution: solver.Solution) -> MountCreep | None:
    """Find whether camera or screen crept from the first set to the last.

    Returns
    -------
    MountCreep or None
        With what changed most; None if it is not significant, or there are too few sets.
    """
    count = len(solution.states)
    if count < _LEAST_TO_CREEP:
        return None

    # A creep is even in the number of the set, 0 in the middle; amounts are from first to last.
    share = np.linspace(-0.5, 0.5, count)
    units = [parameter.unit for parameter in bench_parameters.POSE]
    sigmas = np.array([_CAMERA_SIGMA_DEG if unit == "deg" else _CREEP_SIGMA_MM for unit in units])

    # All poses together decide whether anything crept; the one that alone explains most is named.
    poses = tuple(range(len(bench_parameters.POSE)))
    _, fall = _free_motion(solution, poses, share, sigmas)
    alone = [_free_motion(solution, (k,), share, sigmas[[k]]) for k in poses]
    most = max(poses, key=lambda k: alone[k][1])
    amounts, _ = alone[most]
    creep = MountCreep(bench_parameters.NAMES[most], amounts[0], fall, len(poses))
    if not creep.is_significant:
        return None
    return creep


def _free_motion(
    solution: solver.Solution, columns: tuple[int, ...], share: FloatArray, sigmas: FloatArray
) -> tuple[tuple[float, ...], float]:
    """Free the motion of some parameters between the sets.

    Parameters
    ----------
    solution : Solution
        The calibration.
    columns : tuple of int
        Numbers of the k parameters.
    share : (sets,) array
        Share of the motion by which each set moved.
    sigmas : (k,) array
        Standard deviations of the motion before the sets.

    Returns
    -------
    amounts : tuple of k floats
        The motion.
    fall : float
        By how much the sum of squares falls.
    """
    # The equations with the motion as further unknowns, which act as the parameters do.
    reduced = _reduce_equations(solution)
    prior = solution.problem.sigmas
    pairs = zip(reduced, share, strict=True)
    sums = np.sum([_with_more(each, columns, part) for each, part in pairs], axis=0)

    # What is known of all unknowns before the sets.
    known = _with_more(solution.prior_sums(prior), columns, 0.0)
    extra = np.arange(set_state.COMMON, set_state.COMMON + len(columns))
    known[extra, extra] += 1 / sigmas**2

    # Held parameters stay; ring, form and motion are free.
    others = set_state.COMMON - len(bench_parameters.NAMES) + len(columns)
    free = np.flatnonzero(np.append(prior > 0, np.ones(others, bool)))
    delta, squares = _solve_free(sums + known, free)
    fall = _sum_squares(np.sum(reduced, axis=0), solution) - squares
    return tuple(delta[-len(columns) :].tolist()), fall


def leave_set_out(solution: solver.Solution, index: int) -> solver.Solution:
    """Return the solution without one set, to first order.

    Its equations and state are left out, and the unknowns are moved by one step.

    Parameters
    ----------
    solution : Solution
    index : int
        Number of the set.
    """
    # The problem without the set.
    keep = [k for k in range(len(solution.states)) if k != index]
    problem = replace(solution.problem, sets=tuple(solution.problem.sets[k] for k in keep))
    linear = tuple(solution.equations[k] for k in keep)

    # One step from the same residuals: the surfaces are eliminated, the prior is added.
    sigmas = problem.sigmas
    of_sets = np.sum([each.eliminate_surface() for each in linear], axis=0)
    moved = solver.solve_step(of_sets + solution.prior_sums(sigmas), sigmas)
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
    moved = solver.solve_step(reduced + solution.prior_sums(sigmas), sigmas)
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
    """Equations of the common unknowns alone, (COMMON + 1, squared), one for each set."""
    return [each.eliminate_surface() for each in solution.equations]


def film_rise(solution: solver.Solution, film: set_state.FilmModel) -> float:
    """Rise of the sum of squares if the film follows a law.

    Parameters
    ----------
    solution : Solution
        With a free film.
    film : FilmModel
        The law.
    """
    bound = _change_film_rows(
        solution, lambda _, state: (1.0, reference_rows.film_rows(state.surface, film))
    )
    return sum_of_squares(bound) - sum_of_squares(solution)


def bind_waves(solution: solver.Solution) -> solver.Solution:
    """The equations of a solution with waves, for a film without; its unknowns stay."""

    def bind(phases: set_phases.SetPhases, state: set_state.SetState) -> tuple[float, FloatArray]:
        """Rows that bind the waves, to be added."""
        return 1.0, reference_rows.wave_rows(phases, state, free=False)

    return _change_film_rows(solution, bind)


def wave_fall(solution: solver.Solution) -> float:
    """By how much the sum of squares of a solution without waves falls if the film has them."""

    def unbind(phases: set_phases.SetPhases, state: set_state.SetState) -> tuple[float, FloatArray]:
        """Rows that bind the waves, to be subtracted."""
        return -1.0, reference_rows.wave_rows(phases, state, free=False)

    def free_waves(
        phases: set_phases.SetPhases, state: set_state.SetState
    ) -> tuple[float, FloatArray]:
        """Rows of a film's usual waves, to be added."""
        return 1.0, reference_rows.wave_rows(phases, state, free=True)

    free = _change_film_rows(_change_film_rows(solution, unbind), free_waves)
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
    for k in solution.problem.film_sets:
        sign, rows = rows_of(solution.problem.sets[k], solution.states[k])
        sums = changed[k].sums + sign * rows.T @ rows
        changed[k] = replace(changed[k], sums=sums)
    return replace(solution, equations=tuple(changed))


def _sum_squares(sums: FloatArray, solution: solver.Solution) -> float:
    """Least sum of squares of the sets' sums with what is known besides."""
    sigmas = solution.problem.sigmas
    return solver.solve_step(sums + solution.prior_sums(sigmas), sigmas).squares


def _fit_alone(reduced: FloatArray, sigmas: FloatArray) -> tuple[float, int]:
    """Least sum of squares of one set by itself, and how many numbers it determines; no prior."""
    # The free unknowns, scaled to a unit diagonal.
    others = set_state.COMMON - len(bench_parameters.NAMES)
    free = np.flatnonzero(np.append(sigmas > 0, np.ones(others, bool)))
    matrix = reduced[np.ix_(free, free)]
    right = reduced[free, -1]
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), _SMALLEST_SQUARE))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))

    # Least squares over the combinations that the set determines.
    is_determined = values > _DETERMINED
    along = vectors.T @ (right * scale)
    explained = np.sum(along[is_determined] ** 2 / values[is_determined])
    least_squares = float(reduced[-1, -1] - explained)
    return least_squares, int(np.count_nonzero(is_determined))


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
    """Solve for the free unknowns: the step of all unknowns, 0 for the others, and the least sum of
    squares.
    """
    matrix = sums[np.ix_(free, free)]
    right = sums[free, -1]
    scale = 1 / np.sqrt(np.diag(matrix))
    found = scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right)
    delta = np.zeros(len(sums) - 1)
    delta[free] = found
    return delta, float(sums[-1, -1] - right @ found)
