"""The one least-squares problem: Gauss-Newton on the common unknowns, surfaces eliminated
(`separable`).

`tables_of` gives the solution as the tables of `geometry.toml`. `[geometry]` is what every command
reads. `[covariance]` is what error bars and a Monte Carlo use: shifts and turns of camera and
screen in world, twelve of them, made from the eleven parameters (the twelfth direction, a turn of
everything about z, has no variance: it defines x), and the parameters of lens, bow and pitch that
were free. `[parameters]` are the calibration's own, `[calibration]` states the origin of all that.
The screen's bow is in `[geometry.screen]`. `[camera]` and `[pattern]` are there if the lens or the
screen's pitch were calibrated; a measurement with such a file needs them too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from membrane_ctrl.config.optics import (
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
    Vector3,
)
from membrane_ctrl.metrology.calibration import normal_equations
from membrane_ctrl.metrology.calibration.ring_pose import Rim
from membrane_ctrl.metrology.film import film_law
from membrane_ctrl.metrology.rays import bench_parameters, forward_model
from membrane_ctrl.metrology.rays.geometry import BOW_RADIUS_MM, Geometry
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Artefact, SeenScreen, Surface
from membrane_ctrl.metrology.reconstruction import surface_fit
from membrane_ctrl.metrology.uncertainty.geometry_spread import GENERAL_NAMES
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.plain_json import SCHEMA, content_hash
from membrane_ctrl.model.program import file_origin

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
    sets: tuple[forward_model.SetPhases, ...]  # at different sags
    sigmas: FloatArray  # (len(NAMES),): of the hand's measurements; 0 holds a parameter
    references: normal_equations.References  # laser and ring
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
    states: tuple[normal_equations.SetState, ...]  # surface and vertex of each set
    equations: tuple[normal_equations.Equations, ...]  # of each set, at the end
    at_rim: FloatArray  # (COMMON + 1, squared): the rim's equations
    covariance: FloatArray  # (COMMON, COMMON): of the common unknowns; zeros for what was held
    changes: tuple[float, ...]  # largest change of each step, in standard deviations
    converged: bool  # whether the last step was too small to matter

    @property
    def bench(self) -> bench_parameters.BenchGeometry:
        """The calibrated bench."""
        return bench_parameters.bench_at(self.problem.stated, self.values)

    def known(self, sigmas: FloatArray) -> FloatArray:
        """What is known besides the sets, as sums (COMMON + 1, squared), with these sigmas of the
        hand.
        """
        return prior(sigmas, self.common) + self.at_rim

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


def prior(sigmas: FloatArray, common: FloatArray) -> FloatArray:
    """The knowledge without the sets, as sums (COMMON + 1, squared) about the present unknowns."""
    wide = np.append(
        sigmas, np.full(normal_equations.COMMON - len(bench_parameters.NAMES), _FREE_RING_MM)
    )
    weight = np.divide(1, wide**2, out=np.zeros(normal_equations.COMMON), where=wide > 0)
    rows = np.hstack([np.diag(np.sqrt(weight)), -(np.sqrt(weight) * common)[:, None]])
    return np.asarray(rows.T @ rows)


@dataclass(frozen=True)
class SolverStep:
    """Step (COMMON,) of the common unknowns, their covariance, and the sum of squares after it."""

    delta: FloatArray
    covariance: FloatArray
    squares: float


def step(sums: FloatArray, sigmas: FloatArray) -> SolverStep:
    """Solve for the free unknowns. `sums` (COMMON + 1, squared) hold the sets and the prior."""
    free = np.flatnonzero(
        np.append(sigmas > 0, np.ones(normal_equations.COMMON - len(bench_parameters.NAMES), bool))
    )
    matrix, right = sums[np.ix_(free, free)], sums[free, -1]
    scale = 1 / np.sqrt(
        np.diag(matrix)
    )  # parameters have units of their own: the scaled matrix loses fewer digits
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    delta, covariance = (
        np.zeros(normal_equations.COMMON),
        np.zeros((normal_equations.COMMON, normal_equations.COMMON)),
    )
    delta[free] = inverse @ right
    covariance[np.ix_(free, free)] = inverse
    return SolverStep(delta, covariance, float(sums[-1, -1] - right @ delta[free]))


def solve(
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
        return _solve(problem, progress, start)


def _solve(
    problem: Problem, progress: Callable[[int, float], None] | None, start: Solution | None
) -> Solution:
    if start is None and max(phases.sigma_mm.size for phases in problem.sets) > 2 * _FEW:
        some = replace(problem, sets=tuple(phases.thinned(_FEW) for phases in problem.sets))
        start = _solve(some, progress, None)
        if not start.converged:
            return start  # means about a diverged bench would be meaningless
        clean = normal_equations.without_waves(start.bench, problem.sets, start.states)
        pairs = zip(clean, start.states, strict=True)
        problem = replace(
            problem,
            sets=tuple(normal_equations.averaged(start.bench, *pair, _FEW) for pair in pairs),
        )
    states = start.states if start is not None else first_states(problem)
    # the parameters as stated, and the ring as the first surfaces have it
    ring = np.mean([normal_equations.rim_of(states[k]) for k in problem.films], axis=0)
    common = (
        start.common
        if start is not None
        else np.append(np.zeros(len(bench_parameters.NAMES)), ring)
    )
    trust = tuple(normal_equations.Trust.full(phases) for phases in problem.sets)
    free = problem.sigmas > 0
    changes: list[float] = []
    # the step before was the first with new weights; they stay; a solution was near
    weighed = final = near = False
    while True:
        linear = _linearise(problem, states, common, trust)
        at_rim = (
            np.zeros((common.size + 1,) * 2)
            if problem.rim is None
            else problem.rim.sums(problem.stated, common)
        )
        sums = (
            np.sum([each.reduced() for each in linear], axis=0)
            + prior(problem.sigmas, common)
            + at_rim
        )
        moved = step(sums, problem.sigmas)
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
                normal_equations.less_trust(problem.sets, left, trust),
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
        states = tuple(_moved(s, each, delta) for s, each in zip(states, linear, strict=True))
        common = common + delta
        # Weights are renewed where the steps have nearly converged (at every step, the two may
        # chase each other), and where points with too much weight lead astray before a solution was
        # near
        near |= changes[-1] < _NEARLY
        weighed = not final and (changes[-1] < _NEARLY or (far > _FURTHEST and not near))
        if weighed:
            trust = tuple(
                normal_equations.Trust.seen(*pair) for pair in zip(problem.sets, left, strict=True)
            )


def _linearise(
    problem: Problem,
    states: Sequence[normal_equations.SetState],
    common: FloatArray,
    trust: Sequence[normal_equations.Trust],
) -> tuple[normal_equations.Equations, ...]:
    values = common[: len(bench_parameters.NAMES)]
    bench, turns = (
        bench_parameters.bench_at(problem.stated, values),
        bench_parameters.pose_derivatives(problem.stated, values),
    )
    return tuple(
        normal_equations.equations(
            bench, turns, phases, state, common, problem.references, believed
        )
        for phases, state, believed in zip(problem.sets, states, trust, strict=True)
    )


def _moved(
    state: normal_equations.SetState, linear: normal_equations.Equations, common_step: FloatArray
) -> normal_equations.SetState:
    own = linear.local_step(common_step)
    surface = Surface.from_parameters(
        state.surface.parameters + own[:PARAMETERS], state.surface.radius_mm
    )
    beyond_mm = (
        np.array(state.surface.beyond_mm or [0.0] * len(film_law.BEYOND))
        + own[forward_model.BEYOND]
    )
    surface = replace(surface, beyond_mm=tuple(beyond_mm.tolist()))
    vertex_z_mm, motion_mm = (
        state.vertex_z_mm + own[PARAMETERS],
        state.motion_mm + own[forward_model.MOTION],
    )
    steps = linear.moved(own, common_step)
    elsewhere = tuple(move + step for move, step in zip(state.elsewhere, steps, strict=True))
    return normal_equations.SetState(surface, float(vertex_z_mm), float(motion_mm), elsewhere)


def first_states(problem: Problem) -> tuple[normal_equations.SetState, ...]:
    """The sets' surfaces with the stated geometry. Raises ValueError if there is none."""
    return tuple(_first(problem, phases) for phases in problem.sets)


def _first(problem: Problem, phases: forward_model.SetPhases) -> normal_equations.SetState:
    moved_um, artefact = phases.displacement_um - problem.references.reference_um, phases.artefact
    vertex_z_mm = -moved_um * 1e-3 if np.isfinite(moved_um) else 0.0
    radius_mm = problem.radius_mm
    elsewhere = tuple(each.known(problem.references.laser_sigma_um)[0] for each in phases.elsewhere)
    if isinstance(artefact, SeenScreen):
        return normal_equations.SetState(
            Surface.from_parameters(np.zeros(PARAMETERS), radius_mm), 0.0, elsewhere=elsewhere
        )
    if artefact is not None:
        vertex_z_mm, radius_mm = artefact.vertex_mm, artefact.radius_mm
    fit = fit_on(bench_parameters.BenchGeometry(problem.stated), phases, radius_mm, vertex_z_mm)
    return normal_equations.SetState(fit.surface, vertex_z_mm, elsewhere=elsewhere)


def fit_on(
    bench: bench_parameters.BenchGeometry,
    phases: forward_model.SetPhases,
    radius_mm: float,
    vertex_z_mm: float,
) -> surface_fit.Fit:
    """One set's surface on a bench without bow, as `measure` fits it. Raises ValueError if there is
    none.
    """
    phases = phases.subset(phases.seen_with(0))
    tracer = surface_fit.Tracer(bench.geometry, radius_mm, vertex_z_mm)
    points = surface_fit.Points.of(
        forward_model.camera_rays(bench.geometry, phases), phases.screen_mm * bench.pitch
    )
    return surface_fit.solve(tracer, points, surface_fit.parabola(_START_SAG_MM, radius_mm))


_LENS = ("focal_relative", "principal_x_px", "principal_y_px", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Origin:
    """Origin of a geometry, as `[calibration]` states it."""

    date_utc: str
    sets: tuple[str, ...]
    screen_residual_um: (
        float  # median over the sets of the RMS of seen minus predicted screen points
    )
    # Median over the sets of the RMS that `measure` states with this geometry: the reference for a
    # drift
    slope_residual_urad: float
    slope_noise_urad: float  # share of the camera's noise in it
    condition: float  # see `propagate.condition_number`
    notes: tuple[str, ...] = ()  # findings of the calibration


def tables_of(solution: Solution, optics: OpticsConfig, origin: Origin) -> dict[str, Any]:
    """The content of `geometry.toml`; `optics` is the stated bench."""
    free = [bench_parameters.NAMES.index(name) for name in solution.free]
    tables: dict[str, Any] = {
        **file_origin(SCHEMA),
        "geometry": geometry_of(solution, optics).model_dump(exclude_none=True),
        "covariance": {
            "names": [*GENERAL_NAMES, *_optional(solution)],
            "matrix": general_covariance(solution).tolist(),
        },
        "parameters": {
            "names": [bench_parameters.NAMES[k] for k in free],
            "values": solution.values[free].tolist(),
            "sigmas": solution.sigmas[free].tolist(),
            "covariance": solution.covariance[np.ix_(free, free)].tolist(),
        },
    }
    bench = solution.bench
    if set(solution.free) & set(_LENS):
        of_camera = {
            key: getattr(optics.camera, key) for key in ("width_px", "height_px", "pixel_um")
        }
        tables["camera"] = of_camera | {
            "focal_mm": bench.geometry.focal_px * optics.camera.pixel_um * 1e-3,
            "principal_px": list(bench.geometry.principal_px),
            "distortion": list(bench.geometry.distortion),
        }
    if "pitch_relative" in solution.free:
        tables["pattern"] = {"period_mm": optics.pattern.period_mm * bench.pitch}
    tables["calibration"] = {
        "date_utc": origin.date_utc,
        "sets": list(origin.sets),
        "screen_residual_um": origin.screen_residual_um,
        "slope_residual_urad": origin.slope_residual_urad,
        "slope_noise_urad": origin.slope_noise_urad,
        "ring_um": (1e3 * solution.common[len(bench_parameters.NAMES) + 1 :]).tolist(),
        "condition": origin.condition,
        "notes": list(origin.notes),
        "hash": content_hash(tables),
    }
    return tables


def geometry_of(solution: Solution, optics: OpticsConfig) -> GeometryConfig:
    """The calibrated geometry in the general form; the screen's
    height map is the stated bench's.
    """
    reference = {"reference_displacement_um": solution.problem.references.reference_um}
    return general_form(solution.bench.geometry, optics).model_copy(update=reference)


def general_form(geometry: Geometry, optics: OpticsConfig) -> GeometryConfig:
    """A geometry as two poses; the height map and the reference displacement are the stated
    bench's.
    """
    stated = optics.geometry.screen
    right, down, forward = (_vector(row) for row in geometry.rotation)
    return GeometryConfig(
        reference_displacement_um=optics.geometry.reference_displacement_um,
        camera=CameraPoseConfig(
            position_mm=_vector(geometry.pinhole_mm), rotation=(right, down, forward)
        ),
        screen=ScreenPoseConfig(
            origin_mm=_vector(geometry.screen_origin_mm),
            s_x=_vector(geometry.screen_s_x),
            s_y=_vector(geometry.screen_s_y),
            bow_mm=geometry.face.bow_per_mm * BOW_RADIUS_MM**2,
            height_map=None if stated is None else stated.height_map,
        ),
    )


def general_covariance(solution: Solution) -> FloatArray:
    """Covariance (12 + k, 12 + k) of `GENERAL_NAMES` and of the k free parameters of lens, bow and
    pitch.

    Rows r of a body turned by a small w become r + w x r, so that C^T dC is minus the cross-product
    matrix of w.
    """
    geometry = solution.bench.geometry
    columns = []
    for turn in bench_parameters.pose_derivatives(solution.problem.stated, solution.values):
        turns = (
            _turn_vector(geometry.rotation.T @ turn.camera),
            _turn_vector(geometry.screen_axes.T @ turn.screen),
        )
        columns.append(np.concatenate([turn.pinhole_mm, turns[0], turn.origin_mm, turns[1]]))
    poses = np.stack(columns, axis=1)
    optional = [bench_parameters.NAMES.index(name) for name in _optional(solution)]
    used = [*range(len(bench_parameters.POSE)), *optional]
    matrix = np.eye(
        len(poses) + len(optional), len(used), k=len(bench_parameters.POSE) - len(poses)
    )
    matrix[: len(poses), : len(bench_parameters.POSE)] = poses
    covariance = matrix @ solution.covariance[np.ix_(used, used)] @ matrix.T
    return np.asarray((covariance + covariance.T) / 2)


def _optional(solution: Solution) -> list[str]:
    return [
        parameter.name for parameter in bench_parameters.OPTIONAL if parameter.name in solution.free
    ]


def _turn_vector(cross: FloatArray) -> FloatArray:
    return (
        -np.array([cross[2, 1] - cross[1, 2], cross[0, 2] - cross[2, 0], cross[1, 0] - cross[0, 1]])
        / 2
    )


def _vector(values: FloatArray) -> Vector3:
    return float(values[0]), float(values[1]), float(values[2])
