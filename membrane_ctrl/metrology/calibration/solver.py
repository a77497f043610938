"""The least-squares problem of a calibration, solved by Gauss-Newton.

The unknowns are the common ones of all sets (parameters of the bench, harmonics of the ring) and
those of each set (surface, vertex, motion). The latter are eliminated set by set
(`normal_equations`), so that each step solves for the common ones alone. The weights of the points
have three stages:

1. equal weights, until the steps have nearly converged;
2. robust weights of each set (`RobustWeights.seen`), renewed after each further step;
3. once these steps have converged: weights of whole sets that contradict the others are reduced
   (`reduce_weights`), and stay until the end.

Equations: section 2 of docs/explanation/calibration.md.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.metrology.calibration import (
    fringe_waves,
    normal_equations,
    point_averages,
    robust_weights,
    set_state,
)
from membrane_ctrl.metrology.calibration.rim_equations import Rim
from membrane_ctrl.metrology.film import film_form, terms_beyond_fit
from membrane_ctrl.metrology.rays import (
    bench_parameters,
    bench_poses,
    forward_model,
    ray_tracing,
    set_phases,
)
from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.rim_harmonics import RING
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.reconstruction import surface_fit
from membrane_ctrl.model.arrays import FloatArray

MAX_ITERATIONS = 40
# Largest step, in the parameters' own standard deviations, that is invisible in the result; and
# that after which the next one is far below the noise.
_SETTLED = 1e-2
_NEARLY = 0.1
_FEW = 4000  # points of a set: a hundred times its unknowns
# Largest step in sigmas of the hand measurements: sets that contradict each other would lead to a
# bench that cannot exist.
_FURTHEST = 4.0
_START_SAG_MM = 40.0
_FREE_RING_MM = 1e3  # 1 sigma of the ring's form, which is not known beforehand
_PARAMETERS = len(bench_parameters.NAMES)


@dataclass(frozen=True)
class Problem:
    """The problem to solve.

    Attributes
    ----------
    stated : Geometry
        The bench as measured by hand.
    sets : tuple of SetPhases
        Capture sets at different sags, of the film or of artefacts.
    sigmas : (len(NAMES),) array
        Standard uncertainties of the hand measurements; 0 holds a parameter.
    references : References
        Knowledge of laser and ring.
    radius_mm : float
        Radius of the ring.
    rim : Rim, optional
        Edge of the light, where it is visible.
    """

    stated: Geometry
    sets: tuple[set_phases.SetPhases, ...]
    sigmas: FloatArray
    references: set_state.References
    radius_mm: float
    rim: Rim | None = None

    @property
    def film_sets(self) -> list[int]:
        """Numbers of the sets that show the film; the others show artefacts."""
        return [k for k, phases in enumerate(self.sets) if phases.artefact is None]

    @property
    def with_artefact(self) -> bool:
        """Whether a set shows a known surface in the mirror's place."""
        return any(isinstance(phases.artefact, Artefact) for phases in self.sets)

    @property
    def middle_film_set(self) -> int:
        """Number of the film's set in the middle of their order: results are stated for a figure
        like that one.
        """
        return self.film_sets[len(self.film_sets) // 2]


@dataclass(frozen=True)
class Solution:
    """The unknowns at the solution, and the equations there.

    Attributes
    ----------
    problem : Problem
        The problem; sets of very many bins are averaged.
    values : (len(NAMES),) array
        Parameters; 0 for the stated bench.
    common : (COMMON,) array
        Parameters and harmonics of the ring.
    states : tuple of SetState
        Surface and vertex of each set.
    equations : tuple of Equations
        Equations of each set, at the end.
    at_rim : (COMMON + 1, COMMON + 1) array
        Equations of the rim.
    covariance : (COMMON, COMMON) array
        Covariance of the common unknowns; zeros for held ones.
    changes : tuple of float
        Largest change of each step, in standard deviations.
    converged : bool
        Whether the last step was small enough.
    """

    problem: Problem
    values: FloatArray
    common: FloatArray
    states: tuple[set_state.SetState, ...]
    equations: tuple[normal_equations.Equations, ...]
    at_rim: FloatArray
    covariance: FloatArray
    changes: tuple[float, ...]
    converged: bool

    @property
    def bench(self) -> bench_poses.BenchGeometry:
        """The calibrated bench."""
        return bench_poses.bench_at(self.problem.stated, self.values)

    def prior_sums(self, sigmas: FloatArray) -> FloatArray:
        """Knowledge besides the sets, as sums (COMMON + 1, COMMON + 1), with these sigmas
        (len(NAMES),) of the hand measurements.
        """
        return make_prior(sigmas, self.common) + self.at_rim

    @property
    def free_names(self) -> list[str]:
        """Names of the parameters that were free."""
        pairs = zip(bench_parameters.NAMES, self.problem.sigmas, strict=True)
        return [name for name, sigma in pairs if sigma > 0]

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the parameters, in the order of `NAMES`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:_PARAMETERS]))


def make_prior(sigmas: FloatArray, common: FloatArray) -> FloatArray:
    """Knowledge without the sets, as sums about the present unknowns.

    Parameters
    ----------
    sigmas : (len(NAMES),) array
        Prior standard deviations of the parameters; 0 holds one.
    common : (COMMON,) array
        Present values of the common unknowns.

    Returns
    -------
    (COMMON + 1, COMMON + 1) array
        Normal matrix, with the right-hand side as last column and row.
    """
    form_mm = np.repeat(film_form.POWER_SIGMAS_MM, len(film_form.TURNING))
    wide = np.concatenate([sigmas, np.full(RING, _FREE_RING_MM), form_mm])
    weight = np.divide(1, wide**2, out=np.zeros(set_state.COMMON), where=wide > 0)

    # Each unknown is 0 within its sigma: rows (step) / sigma = -(present value) / sigma.
    root = np.sqrt(weight)
    right = -(root * common)
    rows = np.hstack([np.diag(root), right[:, None]])
    return np.asarray(rows.T @ rows)


@dataclass(frozen=True)
class SolverStep:
    """One step of the common unknowns.

    Attributes
    ----------
    delta : (COMMON,) array
        The step.
    covariance : (COMMON, COMMON) array
        Covariance of the unknowns.
    squares : float
        Sum of squares after the step.
    """

    delta: FloatArray
    covariance: FloatArray
    squares: float


def solve_step(sums: FloatArray, sigmas: FloatArray) -> SolverStep:
    """Solve for the free unknowns.

    Parameters
    ----------
    sums : (COMMON + 1, COMMON + 1) array
        Sums of the sets and of the prior.
    sigmas : (len(NAMES),) array
        Prior standard deviations; parameters with 0 are held.
    """
    is_free = np.append(sigmas > 0, np.ones(set_state.COMMON - _PARAMETERS, bool))
    free = np.flatnonzero(is_free)
    matrix = sums[np.ix_(free, free)]
    right = sums[free, -1]

    # Parameters differ in their units: the scaled matrix loses fewer digits.
    scale = 1 / np.sqrt(np.diag(matrix))
    scales = np.outer(scale, scale)
    inverse = np.linalg.inv(matrix * scales) * scales
    delta = np.zeros(set_state.COMMON)
    delta[free] = inverse @ right
    covariance = np.zeros((set_state.COMMON, set_state.COMMON))
    covariance[np.ix_(free, free)] = inverse
    # The sum of squares at the solution of normal equations: (b, b) - (right, step).
    squares = sums[-1, -1] - right @ delta[free]
    return SolverStep(delta, covariance, float(squares))


def solve_calibration(
    problem: Problem,
    progress: Callable[[int, float], None] | None = None,
    start: Solution | None = None,
) -> Solution:
    """Calibrate.

    Sets of very many bins are solved with some of the bins first, and then with means of all.

    Parameters
    ----------
    problem : Problem
        What to solve.
    progress : callable, optional
        Gets the number of each step, and its largest change in standard deviations.
    start : Solution, optional
        A solution of the same sets to start from.

    Returns
    -------
    Solution
        The solution; it may not have converged.

    Raises
    ------
    ValueError
        If there is no set of the film, if a set's points do not determine a surface, or if the
        steps diverge.
    """
    if not problem.film_sets:
        raise ValueError("no capture set of the film to calibrate with")
    with np.errstate(over="ignore", invalid="ignore"):  # a divergence is reported below
        return _solve_sets(problem, progress, start)


def _solve_sets(
    problem: Problem, progress: Callable[[int, float], None] | None, start: Solution | None
) -> Solution:
    """Solve with some of the bins first where there are very many."""
    largest = max(phases.sigma_mm.size for phases in problem.sets)
    if start is None and largest > 2 * _FEW:
        # Some of the bins give a bench that is nearly right.
        some = replace(problem, sets=tuple(phases.thin_to(_FEW) for phases in problem.sets))
        start = _solve_sets(some, progress, None)
        if not start.converged:
            return start  # means about a diverged bench would be meaningless

        # About it, waves of the fringes are removed and the bins averaged.
        clean = fringe_waves.remove_fringe_waves(start.bench, problem.sets, start.states)
        averaged = tuple(
            point_averages.average_points(start.bench, phases, state, _FEW)
            for phases, state in zip(clean, start.states, strict=True)
        )
        problem = replace(problem, sets=averaged)

    # From there, with the sag at which the film's figure is stated.
    if start is not None:
        sag_mm = start.problem.references.form_sag_mm
        problem = replace(problem, references=replace(problem.references, form_sag_mm=sag_mm))
        return _iterate(problem, progress, start.states, start.common)

    # Without a start: from the stated bench.
    states = first_states(problem)
    problem = _with_form_sag(problem, states)
    return _iterate(problem, progress, states, _make_first_common(problem, states))


def _iterate(
    problem: Problem,
    progress: Callable[[int, float], None] | None,
    states: tuple[set_state.SetState, ...],
    common: FloatArray,
) -> Solution:
    """Gauss-Newton steps from states of the sets and values of the common unknowns (COMMON,)."""
    weights = tuple(robust_weights.RobustWeights.unweighted(phases) for phases in problem.sets)
    changes: list[float] = []
    has_new_weights = False  # since the step before
    has_final_weights = False
    was_near = False  # to a solution
    while True:
        # The equations about the present unknowns, and their solution.
        linear = _linearise_sets(problem, states, common, weights)
        at_rim = _linearise_rim(problem, common)
        of_sets = np.sum([equations.eliminate_surface() for equations in linear], axis=0)
        sums = of_sets + make_prior(problem.sigmas, common) + at_rim
        step = solve_step(sums, problem.sigmas)
        change = _largest_change(step)
        changes.append(change)
        if progress is not None:
            progress(len(changes), change)

        # Converged with robust weights: reduce those of contradicting sets, once. Far from the
        # solution a wrong bench looks like another film, and weights would alternate between both.
        is_last = len(changes) == MAX_ITERATIONS
        is_settled = (has_new_weights or has_final_weights) and change < _SETTLED
        left_mm = [equations.residual_mm for equations in linear]
        if is_settled and not has_final_weights and not is_last:
            weights = robust_weights.reduce_weights(problem.sets, left_mm, weights)
            has_final_weights = True
            continue
        if is_settled or is_last:
            return Solution(
                problem=problem,
                values=common[:_PARAMETERS].copy(),
                common=common,
                states=states,
                equations=linear,
                at_rim=at_rim,
                covariance=step.covariance,
                changes=tuple(changes),
                converged=is_settled,
            )

        # Take the step, or a part of it that stays within a few sigmas of the hand measurements.
        far = _step_length(step.delta, problem.sigmas)
        delta = step.delta
        if far > 0:
            delta = step.delta * min(1.0, _FURTHEST / far)
        states = tuple(
            move_state(state, equations, delta)
            for state, equations in zip(states, linear, strict=True)
        )
        common = common + delta

        # Renew the weights if the steps have nearly converged (at every step, steps and weights may
        # never settle), or if points with too much weight lead far away before any solution was
        # near.
        was_near |= change < _NEARLY
        leads_away = far > _FURTHEST and not was_near
        has_new_weights = not has_final_weights and (change < _NEARLY or leads_away)
        if has_new_weights:
            weights = tuple(
                robust_weights.RobustWeights.from_residual(phases, residual_mm)
                for phases, residual_mm in zip(problem.sets, left_mm, strict=True)
            )


def _linearise_rim(problem: Problem, common: FloatArray) -> FloatArray:
    """Equations (COMMON + 1, COMMON + 1) of the rim in the pictures; zeros where it is not seen."""
    if problem.rim is None:
        return np.zeros((common.size + 1, common.size + 1))
    return problem.rim.make_sums(problem.stated, common)


def _largest_change(step: SolverStep) -> float:
    """Largest change of a free unknown by a step, in its standard deviations.

    Raises ValueError if the steps diverge.
    """
    sigmas = np.sqrt(np.diag(step.covariance))
    if not (np.isfinite(step.delta).all() and np.isfinite(sigmas).all()):
        raise ValueError("the calibration diverges: the sets do not show the stated bench")
    is_free = sigmas > 0
    relative = np.abs(step.delta[is_free]) / sigmas[is_free]
    return float(np.max(relative, initial=0.0))


def _step_length(delta: FloatArray, sigmas: FloatArray) -> float:
    """Largest change of a free parameter by a step (COMMON,), in its sigma (len(NAMES),) of the
    hand measurement.
    """
    is_free = sigmas > 0
    relative = np.abs(delta[:_PARAMETERS][is_free]) / sigmas[is_free]
    return float(np.max(relative, initial=0.0))


def _linearise_sets(
    problem: Problem,
    states: Sequence[set_state.SetState],
    common: FloatArray,
    weights: Sequence[robust_weights.RobustWeights],
) -> tuple[normal_equations.Equations, ...]:
    """Equations of each set about the present unknowns."""
    values = common[:_PARAMETERS]
    bench = bench_poses.bench_at(problem.stated, values)
    turns = bench_poses.pose_derivatives(problem.stated, values)
    return tuple(
        normal_equations.linearise_set(
            bench, turns, phases, state, common, problem.references, weights_of_set
        )
        for phases, state, weights_of_set in zip(problem.sets, states, weights, strict=True)
    )


def move_state(
    state: set_state.SetState, linear: normal_equations.Equations, common_step: FloatArray
) -> set_state.SetState:
    """Return the unknowns of a set after a step.

    Parameters
    ----------
    state : SetState
        The present ones.
    linear : Equations
        The set's equations about them.
    common_step : (COMMON,) array
        Step of the common unknowns, which the set's own follow.
    """
    own = linear.local_step(common_step)

    # Its surface, with the terms beyond the fit's.
    before = state.surface
    surface = Surface.from_parameters(before.parameters + own[:PARAMETERS], before.radius_mm)
    beyond_before_mm = np.array(before.beyond_mm or [0.0] * terms_beyond_fit.BEYOND_TERMS)
    beyond_mm = beyond_before_mm + own[forward_model.BEYOND]
    surface = replace(surface, beyond_mm=tuple(beyond_mm.tolist()))

    # Vertex, motion from y to x, and the places of the screen.
    vertex_z_mm = state.vertex_z_mm + own[PARAMETERS]
    motion_mm = state.motion_mm + own[forward_model.MOTION]
    steps = linear.screen_steps(own, common_step)
    moved_screens = tuple(
        move + step for move, step in zip(state.moved_screens, steps, strict=True)
    )
    x_mm, y_mm, turn_rad = (np.array(state.seat) + own[forward_model.SEAT]).tolist()
    seat = (x_mm, y_mm, turn_rad)
    return set_state.SetState(surface, float(vertex_z_mm), float(motion_mm), moved_screens, seat)


def _with_form_sag(problem: Problem, states: Sequence[set_state.SetState]) -> Problem:
    """The problem with the sag at which the film's figure is stated, if a mirror was turned."""
    references = problem.references
    if references.form_sag_mm is not None or all(each.turned is None for each in problem.sets):
        return problem
    sag_mm = float(np.mean([states[k].surface.sag_mm for k in problem.film_sets]))
    return replace(problem, references=replace(references, form_sag_mm=sag_mm))


def _make_first_common(problem: Problem, states: Sequence[set_state.SetState]) -> FloatArray:
    """The parameters as stated, the ring as the first surfaces have it, and no figure."""
    rings = [
        set_state.rim_height_harmonics(states[k])
        for k in problem.film_sets
        if problem.sets[k].turned is None
    ]
    if not rings:
        raise ValueError("every mirror was turned: a set of the mirror as it stands is needed")
    common = np.zeros(set_state.COMMON)
    common[set_state.RING_PLACE] = np.mean(rings, axis=0)
    return common


def first_states(problem: Problem) -> tuple[set_state.SetState, ...]:
    """Unknowns of the sets with the stated geometry.

    Raises ValueError if a set's points determine no surface.
    """
    return tuple(_make_first_state(problem, phases) for phases in problem.sets)


def _make_first_state(problem: Problem, phases: set_phases.SetPhases) -> set_state.SetState:
    """Unknowns of one set with the stated geometry, as `first_states`."""
    artefact = phases.artefact
    radius_mm = problem.radius_mm
    laser_sigma_um = problem.references.laser_sigma_um
    moved_screens = tuple(each.make_prior(laser_sigma_um)[0] for each in phases.moved_screens)
    if isinstance(artefact, SeenScreen):
        flat = Surface.from_parameters(np.zeros(PARAMETERS), radius_mm)
        return set_state.SetState(flat, 0.0, moved_screens=moved_screens)

    # The vertex is where the laser, or the artefact, has it.
    vertex_z_mm = 0.0
    moved_um = phases.displacement_um - problem.references.reference_um
    if np.isfinite(moved_um):
        vertex_z_mm = -moved_um * 1e-3
    if artefact is not None:
        vertex_z_mm = artefact.vertex_mm
        radius_mm = artefact.radius_mm
    fit = fit_on(bench_poses.BenchGeometry(problem.stated), phases, radius_mm, vertex_z_mm)
    return set_state.SetState(fit.surface, vertex_z_mm, moved_screens=moved_screens)


def fit_on(
    bench: bench_poses.BenchGeometry,
    phases: set_phases.SetPhases,
    radius_mm: float,
    vertex_z_mm: float,
) -> surface_fit.Fit:
    """Fit one set's surface on a bench without bow, as `measure` does.

    Parameters
    ----------
    bench : BenchGeometry
        The bench.
    phases : SetPhases
        The set; points seen with a moved screen are left out.
    radius_mm : float
        Radius of the Zernike disc.
    vertex_z_mm : float
        Height of the vertex in world.

    Raises
    ------
    ValueError
        If its points determine no surface.
    """
    phases = phases.subset(phases.select_screen(0))
    tracer = ray_tracing.Tracer(bench.geometry, radius_mm, vertex_z_mm)
    rays = forward_model.camera_rays(bench.geometry, phases)
    points = ray_tracing.Points.from_rays(rays, phases.screen_mm * bench.pitch)
    start = ray_tracing.make_parabola(_START_SAG_MM, radius_mm)
    return surface_fit.fit_surface(tracer, points, start)
