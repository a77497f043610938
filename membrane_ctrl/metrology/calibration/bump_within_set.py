"""A camera that was bumped in the middle of a set: its x frames show one bench, its y frames
another.

No surface and no common bench explains such a set, whatever else is free. The other sets give the
bench. On it the set is fitted by itself, with the camera's three angles free for the y frames
alone. What that explains is compared with what a camera explains that was bumped before the set.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibration import normal_equations, robust_weights, set_state, solver
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses, forward_model, set_phases
from membrane_ctrl.model.arrays import FloatArray

_ANGLES = tuple(
    bench_parameters.NAMES.index(name)
    for name in ("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg")
)
_SIGMA_DEG = 1.0  # of a bump: a hand on the mount
_FEW_POINTS = 1000  # of a set: twenty times its unknowns
_STEPS = 4  # of least squares for a surface on a bench that is nearly right
_LEAST_SHARE = 0.8  # of what the set leaves without a bump: a foreign set leaves more
_SIGNIFICANCE = 1e-6  # probability that noise explains as much


@dataclass(frozen=True)
class BumpWithinSet:
    """The camera turned between the x and the y frames of a set.

    Attributes
    ----------
    index : int
        Number of the set.
    turned_deg : three floats
        Yaw, pitch and roll of the y frames about the x frames.
    left : float
        Sum of squares of all sets with it, in units of the expected variance.
    """

    index: int
    turned_deg: tuple[float, float, float]
    left: float


def find_bump_within_set(problem: solver.Problem) -> BumpWithinSet | None:
    """Find the set in the middle of which the camera was bumped, of sets that contradict.

    Parameters
    ----------
    problem : Problem
        The sets; a few points of each are used.

    Returns
    -------
    BumpWithinSet or None
        None unless a bump explains nearly all that a set leaves, and more than a camera that was
        bumped before the set.
    """
    few = replace(problem, sets=tuple(phases.thin_to(_FEW_POINTS) for phases in problem.sets))
    found = []
    for index in few.film_sets:
        if len(few.film_sets) < 2:
            continue
        bump = _free_bump_of_set(few, index)
        if bump is not None:
            found.append(bump)
    return min(found, key=lambda bump: bump.left, default=None)


def _free_bump_of_set(problem: solver.Problem, index: int) -> BumpWithinSet | None:
    """The bump in the middle of a set on the bench of the others; None if it is not sure."""
    # The bench by the others, whose films may have waves.
    phases = problem.sets[index]
    others = replace(
        problem,
        sets=problem.sets[:index] + problem.sets[index + 1 :],
        references=replace(problem.references, waves=True),
    )
    try:
        bench = solver.solve_calibration(others)
        state = solver.first_states(replace(problem, sets=(phases,)))[0]
        linear = _fit_alone(bench, phases, state)
    except (ValueError, np.linalg.LinAlgError):
        return None
    if not bench.converged:
        return None

    # What is left with no bump, one in the middle, and one before the set.
    none, _ = _solve_turn(linear.sums, np.zeros_like(linear.sums))
    within, turned_deg = _solve_turn(linear.sums, linear.y_sums)
    before, _ = _solve_turn(linear.sums, linear.sums)
    variance = within / (2 * phases.sigma_mm.size)
    is_sure = chi2.sf((none - within) / variance, len(_ANGLES)) < _SIGNIFICANCE
    if not is_sure or within > (1 - _LEAST_SHARE) * none or within >= before:
        return None

    # With the bump in another set than the true one, the others do not agree.
    left_of_others = [
        float(np.sum(each.residual_mm**2 / of_set.sigma_mm**2))
        for each, of_set in zip(bench.equations, bench.problem.sets, strict=True)
    ]
    yaw, pitch, roll = turned_deg.tolist()
    return BumpWithinSet(index, (yaw, pitch, roll), within + sum(left_of_others))


def _fit_alone(
    bench: solver.Solution, phases: set_phases.SetPhases, state: set_state.SetState
) -> normal_equations.Equations:
    """The equations of a set about its own surface on the bench of others."""
    at = bench_poses.bench_at(bench.problem.stated, bench.values)
    turns = bench_poses.pose_derivatives(bench.problem.stated, bench.values)
    weights = robust_weights.RobustWeights.unweighted(phases)
    still = np.zeros(set_state.COMMON)
    references = bench.problem.references
    for _ in range(_STEPS):
        linear = normal_equations.linearise_set(
            at, turns, phases, state, bench.common, references, weights
        )
        state = solver.move_state(state, linear, still)
    return normal_equations.linearise_set(
        at, turns, phases, state, bench.common, references, weights
    )


def _solve_turn(sums: FloatArray, of_turned: FloatArray) -> tuple[float, FloatArray]:
    """Least sum of squares of a set with a turn of the camera in some of its rows, and the turn.

    Parameters
    ----------
    sums : (LOCAL + COMMON + 1, squared) array
        Sums of all rows.
    of_turned : array of that shape
        Sums of the rows during which the camera was turned.
    """
    # Where the sums have the set's own unknowns with the right side, and the camera's angles.
    local = forward_model.LOCAL
    own = np.append(np.arange(local), len(sums) - 1)
    angles = local + np.array(_ANGLES)
    count = angles.size

    # Equations of own unknowns, turn, right side. The own unknowns act in all rows; the turn acts
    # in the turned rows only, so that all products with it are sums over these.
    whole = np.zeros((local + count + 1,) * 2)
    places = np.append(np.arange(local), local + count)
    turn = np.arange(local, local + count)
    whole[np.ix_(places, places)] = sums[np.ix_(own, own)]
    whole[np.ix_(turn, places)] = of_turned[np.ix_(angles, own)]
    whole[np.ix_(places, turn)] = of_turned[np.ix_(own, angles)]
    prior = np.eye(count) / _SIGMA_DEG**2
    whole[np.ix_(turn, turn)] = of_turned[np.ix_(angles, angles)] + prior

    # The surface eliminated, then the turn: the least sum of squares is c - b^T A^-1 b.
    reduced = normal_equations.eliminate_first(whole, local)
    turned_deg = np.linalg.solve(reduced[:-1, :-1], reduced[:-1, -1])
    least = float(reduced[-1, -1] - reduced[:-1, -1] @ turned_deg)
    return least, np.asarray(turned_deg, float)
