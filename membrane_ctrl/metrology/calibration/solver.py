"""The one least-squares problem: Gauss-Newton on the common unknowns, surfaces eliminated
(`normal_equations`).
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
from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import (
    bench_parameters,
    bench_poses,
    forward_model,
    ray_tracing,
    set_phases,
)
from membrane_ctrl.metrology.rays.artefacts import Artefact, SeenScreen
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.reconstruction import surface_fit
from membrane_ctrl.model.arrays import FloatArray

MAX_ITERATIONS = 40
_SETTLED = 1e-2  # of each parameter's own standard deviation: less is invisible in the result
_NEARLY = 0.1  # likewise: the next step is far below the noise
_FEW = 4000  # points of a set: a hundred times its unknowns
# in sigmas of the hand measurements; sets that contradict each other would lead out of the room
_FURTHEST = 4.0
_START_SAG_MM = 40.0
_FREE_RING_MM = 1e3  # the ring's form is not known beforehand


@dataclass(frozen=True)
class Problem:
    """The problem to solve."""

    stated: Geometry  # as measured by hand
    sets: tuple[set_phases.SetPhases, ...]  # at different sags
    sigmas: FloatArray  # (len(NAMES),): of the hand's measurements; 0 holds a parameter
    references: set_state.References  # laser and ring
    radius_mm: float  # of the ring
    rim: Rim | None = None  # the light's edge, where it is seen

    @property
    def films(self) -> list[int]:
        """Which sets show the film; the others show artefacts."""
        return [k for k, phases in enumerate(self.sets) if phases.artefact is None]

    @property
    def with_artefact(self) -> bool:
        """Whether a known surface stood in the mirror's place."""
        return any(isinstance(each.artefact, Artefact) for each in self.sets)

    @property
    def middle(self) -> int:
        """The set of the film in the middle of their order: results are stated for a figure like
        its.
        """
        return self.films[len(self.films) // 2]


@dataclass(frozen=True)
class Solution:
    """The unknowns at the solution, and the equations there."""

    problem: Problem  # as given, many bins averaged
    values: FloatArray  # (len(NAMES),): parameters, 0 for the stated bench
    common: FloatArray  # (COMMON,): parameters and ring
    states: tuple[set_state.SetState, ...]  # surface and vertex of each set
    equations: tuple[normal_equations.Equations, ...]  # of each set, at the end
    at_rim: FloatArray  # (COMMON + 1, squared): the rim's equations
    covariance: FloatArray  # (COMMON, COMMON): of the common unknowns; zeros for what was held
    changes: tuple[float, ...]  # largest change of each step, in standard deviations
    converged: bool  # whether the last step was too small to matter

    @property
    def bench(self) -> bench_poses.BenchGeometry:
        """The calibrated bench."""
        return bench_poses.bench_at(self.problem.stated, self.values)

    def known(self, sigmas: FloatArray) -> FloatArray:
        """What is known besides the sets, as sums (COMMON + 1, squared), with these sigmas of the
        hand.
        """
        return make_prior(sigmas, self.common) + self.at_rim

    @property
    def free(self) -> list[str]:
        """Names of the parameters that were free."""
        return [
            name
            for name, sigma in zip(bench_parameters.NAMES, self.problem.sigmas, strict=True)
            if sigma > 0
        ]

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the parameters, in the order of `NAMES`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[: len(bench_parameters.NAMES)]))


def make_prior(sigmas: FloatArray, common: FloatArray) -> FloatArray:
    """The knowledge without the sets, as sums (COMMON + 1, squared) about the present unknowns."""
    wide = np.append(sigmas, np.full(set_state.COMMON - len(bench_parameters.NAMES), _FREE_RING_MM))
    weight = np.divide(1, wide**2, out=np.zeros(set_state.COMMON), where=wide > 0)
    rows = np.hstack([np.diag(np.sqrt(weight)), -(np.sqrt(weight) * common)[:, None]])
    return np.asarray(rows.T @ rows)


@dataclass(frozen=True)
class SolverStep:
    """Step (COMMON,) of the common unknowns, their covariance, and the sum of squares after it."""

    delta: FloatArray
    covariance: FloatArray
    squares: float


def solve_step(sums: FloatArray, sigmas: FloatArray) -> SolverStep:
    """Solve for the free unknowns. `sums` (COMMON + 1, squared) hold the sets and the prior."""
    free = np.flatnonzero(
        np.append(sigmas > 0, np.ones(set_state.COMMON - len(bench_parameters.NAMES), bool))
    )
    matrix, right = sums[np.ix_(free, free)], sums[free, -1]
    scale = 1 / np.sqrt(
        np.diag(matrix)
    )  # parameters have units of their own: the scaled matrix loses fewer digits
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    delta, covariance = (
        np.zeros(set_state.COMMON),
        np.zeros((set_state.COMMON, set_state.COMMON)),
    )
    delta[free] = inverse @ right
    covariance[np.ix_(free, free)] = inverse
    return SolverStep(delta, covariance, float(sums[-1, -1] - right @ delta[free]))


def solve_calibration(
    problem: Problem,
    progress: Callable[[int, float], None] | None = None,
    start: Solution | None = None,
) -> Solution:
    """Calibrate. Sets of very many bins are solved with some of them first, and then with means of
    them all.

    Raises ValueError if there is no set of the film, or if a set's points do not determine a
    surface. `progress` gets the number of the step and its largest change in standard deviations;
    `start` is a solution of the same sets.
    """
    if not problem.films:
        raise ValueError("no capture set of the film to calibrate with")
    with np.errstate(over="ignore", invalid="ignore"):  # the numbers show a divergence, below
        return _solve_sets(problem, progress, start)


def _solve_sets(
    problem: Problem, progress: Callable[[int, float], None] | None, start: Solution | None
) -> Solution:
    if start is None and max(phases.sigma_mm.size for phases in problem.sets) > 2 * _FEW:
        some = replace(problem, sets=tuple(phases.thinned(_FEW) for phases in problem.sets))
        start = _solve_sets(some, progress, None)
        if not start.converged:
            return start  # means about a diverged bench would be meaningless
        clean = fringe_waves.remove_fringe_waves(start.bench, problem.sets, start.states)
        pairs = zip(clean, start.states, strict=True)
        problem = replace(
            problem,
            sets=tuple(point_averages.average_points(start.bench, *pair, _FEW) for pair in pairs),
        )
    states = start.states if start is not None else first_states(problem)
    # the parameters as stated, and the ring as the first surfaces have it
    ring = np.mean([set_state.rim_of(states[k]) for k in problem.films], axis=0)
    common = (
        start.common
        if start is not None
        else np.append(np.zeros(len(bench_parameters.NAMES)), ring)
    )
    trust = tuple(robust_weights.RobustWeights.full(phases) for phases in problem.sets)
    free = problem.sigmas > 0
    changes: list[float] = []
    # the step before was the first with new weights; they stay; a solution was near
    weighed = final = near = False
    while True:
        linear = _linearise_sets(problem, states, common, trust)
        at_rim = (
            np.zeros((common.size + 1,) * 2)
            if problem.rim is None
            else problem.rim.sums(problem.stated, common)
        )
        sums = (
            np.sum([each.reduced() for each in linear], axis=0)
            + make_prior(problem.sigmas, common)
            + at_rim
        )
        moved = solve_step(sums, problem.sigmas)
        sigmas = np.sqrt(np.diag(moved.covariance))
        if not (np.isfinite(moved.delta).all() and np.isfinite(sigmas).all()):
            raise ValueError("the calibration diverges: the sets do not show the stated bench")
        changes.append(
            float(np.max(np.abs(moved.delta[sigmas > 0]) / sigmas[sigmas > 0], initial=0.0))
        )
        if progress is not None:
            progress(len(changes), changes[-1])
        settled = (weighed or final) and changes[-1] < _SETTLED
        left = [each.residual_mm for each in linear]
        if settled and not final and len(changes) < MAX_ITERATIONS:
            # not before: far from the solution a wrong bench looks like a film, and both would be
            # believed in turn
            trust, final, settled = (
                robust_weights.reduce_weights(problem.sets, left, trust),
                True,
                False,
            )
            continue
        if settled or len(changes) == MAX_ITERATIONS:
            values = common[: len(bench_parameters.NAMES)].copy()
            return Solution(
                problem,
                values,
                common,
                states,
                linear,
                at_rim,
                moved.covariance,
                tuple(changes),
                settled,
            )
        far = float(
            np.max(
                np.abs(moved.delta[: len(bench_parameters.NAMES)][free]) / problem.sigmas[free],
                initial=0.0,
            )
        )
        delta = moved.delta * min(1.0, _FURTHEST / far) if far > 0 else moved.delta
        states = tuple(_move_state(s, each, delta) for s, each in zip(states, linear, strict=True))
        common = common + delta
        # Weights are renewed where the steps have nearly converged (at every step, the two may
        # chase each other), and where points with too much weight lead astray before a solution was
        # near
        near |= changes[-1] < _NEARLY
        weighed = not final and (changes[-1] < _NEARLY or (far > _FURTHEST and not near))
        if weighed:
            trust = tuple(
                robust_weights.RobustWeights.seen(*pair)
                for pair in zip(problem.sets, left, strict=True)
            )


def _linearise_sets(
    problem: Problem,
    states: Sequence[set_state.SetState],
    common: FloatArray,
    trust: Sequence[robust_weights.RobustWeights],
) -> tuple[normal_equations.Equations, ...]:
    values = common[: len(bench_parameters.NAMES)]
    bench, turns = (
        bench_poses.bench_at(problem.stated, values),
        bench_poses.pose_derivatives(problem.stated, values),
    )
    return tuple(
        normal_equations.linearise_set(
            bench, turns, phases, state, common, problem.references, believed
        )
        for phases, state, believed in zip(problem.sets, states, trust, strict=True)
    )


def _move_state(
    state: set_state.SetState, linear: normal_equations.Equations, common_step: FloatArray
) -> set_state.SetState:
    own = linear.local_step(common_step)
    surface = Surface.from_parameters(
        state.surface.parameters + own[:PARAMETERS], state.surface.radius_mm
    )
    beyond_mm = (
        np.array(state.surface.beyond_mm or [0.0] * terms_beyond_fit.BEYOND_TERMS)
        + own[forward_model.BEYOND]
    )
    surface = replace(surface, beyond_mm=tuple(beyond_mm.tolist()))
    vertex_z_mm, motion_mm = (
        state.vertex_z_mm + own[PARAMETERS],
        state.motion_mm + own[forward_model.MOTION],
    )
    steps = linear.moved(own, common_step)
    elsewhere = tuple(move + step for move, step in zip(state.elsewhere, steps, strict=True))
    return set_state.SetState(surface, float(vertex_z_mm), float(motion_mm), elsewhere)


def first_states(problem: Problem) -> tuple[set_state.SetState, ...]:
    """The sets' surfaces with the stated geometry. Raises ValueError if there is none."""
    return tuple(_make_first_states(problem, phases) for phases in problem.sets)


def _make_first_states(problem: Problem, phases: set_phases.SetPhases) -> set_state.SetState:
    moved_um, artefact = phases.displacement_um - problem.references.reference_um, phases.artefact
    vertex_z_mm = -moved_um * 1e-3 if np.isfinite(moved_um) else 0.0
    radius_mm = problem.radius_mm
    elsewhere = tuple(each.known(problem.references.laser_sigma_um)[0] for each in phases.elsewhere)
    if isinstance(artefact, SeenScreen):
        return set_state.SetState(
            Surface.from_parameters(np.zeros(PARAMETERS), radius_mm), 0.0, elsewhere=elsewhere
        )
    if artefact is not None:
        vertex_z_mm, radius_mm = artefact.vertex_mm, artefact.radius_mm
    fit = fit_on(bench_poses.BenchGeometry(problem.stated), phases, radius_mm, vertex_z_mm)
    return set_state.SetState(fit.surface, vertex_z_mm, elsewhere=elsewhere)


def fit_on(
    bench: bench_poses.BenchGeometry,
    phases: set_phases.SetPhases,
    radius_mm: float,
    vertex_z_mm: float,
) -> surface_fit.Fit:
    """One set's surface on a bench without bow, as `measure` fits it. Raises ValueError if there is
    none.
    """
    phases = phases.subset(phases.seen_with(0))
    tracer = ray_tracing.Tracer(bench.geometry, radius_mm, vertex_z_mm)
    points = ray_tracing.Points.of(
        forward_model.camera_rays(bench.geometry, phases), phases.screen_mm * bench.pitch
    )
    return surface_fit.fit_surface(
        tracer, points, ray_tracing.make_parabola(_START_SAG_MM, radius_mm)
    )
