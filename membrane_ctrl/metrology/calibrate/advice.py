"""What to measure next: the number, or the sets, that would lower the sag's sigma most, with the sigma then.

A set that is not taken yet is foreseen on the bench found: its rays are followed to where they would end, with the
noise of the film's set, and its normal equations are added. No prediction needs its readings.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.calibrate import parameters, residuals, separable
from membrane_ctrl.metrology.calibrate.propagate import sag_um, surface_covariance, weak_combinations
from membrane_ctrl.metrology.calibrate.solve import Solution, step
from membrane_ctrl.metrology.optics.surface import PARAMETERS, Artefact, SeenScreen, Surface
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_BETTER = 5.0  # times: what another instrument may give
_WORTH = 0.9  # of the sag's sigma: less of a gain is not worth the trouble


@dataclass(frozen=True)
class Advice:
    """The one hand measurement that would lower the sag's sigma most."""

    name: str
    sigma: float  # to which it should be known
    sag_um: float  # 1 sigma then


def number_advice(solution: Solution, index: int) -> Advice | None:
    """What to measure better, from the equations alone; None if no single number is worth it."""
    sums, own = np.sum([each.reduced() for each in solution.equations], axis=0), solution.problem.sigmas
    found = []
    for k in np.flatnonzero(own > 0):
        better = own.copy()
        better[k] /= _BETTER
        moved = replace(solution, covariance=step(sums + solution.known(better), better).covariance)
        found.append(Advice(parameters.NAMES[k], float(better[k]), sag_um(surface_covariance(moved, index))))
    best = min(found, key=lambda each: each.sag_um, default=None)
    return best if best is not None and best.sag_um < _WORTH * sag_um(surface_covariance(solution, index)) else None


# A sphere that a telescope maker can deliver: radius of curvature by interferometer and scale, place by a dial gauge
_SPHERE_MM, _SPHERE_USED = 200.0, 0.95
_SPHERE_KNOWN, _FORM_MM, _VERTEX_MM = 1e-4, 5e-5, 0.05


@dataclass(frozen=True)
class ArtefactAdvice:
    """A sphere in the mirror's place, where lengths of the bench cannot be told apart."""

    together: tuple[str, ...]  # parameters that move together
    curvature_radius_mm: float
    curvature_radius_sigma_mm: float
    vertex_sigma_mm: float
    radius_mm: float  # of the sphere's edge
    sag_um: float  # 1 sigma then


def artefact_advice(solution: Solution, index: int) -> ArtefactAdvice | None:
    """What a sphere in the mirror's place would give; None if it is not worth it, or if an artefact stood there.

    Its set is foreseen from the bench found: rays of the film's set that meet the sphere, with their noise.
    """
    if solution.problem.with_artefact:
        return None
    now = surface_covariance(solution, index)
    phases, surface = solution.problem.sets[index], solution.states[index].surface
    phases = replace(phases.subset(phases.seen_with(0)), elsewhere=())
    # as deep as the film, so that the fringes fall on the same places of the screen
    curvature_mm = (surface.radius_mm**2 + surface.sag_mm**2) / (2 * surface.sag_mm)
    spread = _SPHERE_KNOWN / curvature_mm
    sphere = Artefact(1 / curvature_mm, spread, _FORM_MM, 0.0, _VERTEX_MM, min(_SPHERE_MM, surface.radius_mm))
    terms = sphere.terms_mm()
    shape = replace(
        Surface.from_parameters(terms[:PARAMETERS], sphere.radius_mm), beyond_mm=tuple(terms[PARAMETERS:].tolist())
    )
    bench, turns = solution.bench, parameters.pose_derivatives(solution.problem.stated, solution.values)
    points = residuals.place_rays(bench, phases, shape, 0.0)
    x_mm, y_mm, _z = bench.geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    seen = replace(phases, displacement_um=np.nan, artefact=sphere).subset(
        np.hypot(x_mm, y_mm) < _SPHERE_USED * sphere.radius_mm
    )
    if seen.sigma_mm.size < 2 * residuals.LOCAL:
        return None
    seen = replace(seen, screen_mm=seen.screen_mm - residuals.residual_mm(bench, seen, shape, 0.0))
    state = separable.SetState(shape, 0.0)
    trust, known = separable.Trust.full(seen), solution.problem.references
    more = separable.equations(bench, turns, seen, state, solution.common, known, trust).reduced()
    sums = np.sum([each.reduced() for each in solution.equations], axis=0)
    sigmas = solution.problem.sigmas
    then = replace(solution, covariance=step(sums + more + solution.known(sigmas), sigmas).covariance)
    then_um, now_um = (sag_um(covariance) for covariance in (surface_covariance(then, index), now))
    if not then_um < _WORTH * now_um:
        return None
    worst = max(weak_combinations(solution, index, surface.radius_mm), key=lambda each: each.figure_um, default=None)
    together = () if worst is None else tuple(name for name, _ in worst.parts)
    return ArtefactAdvice(together, curvature_mm, _SPHERE_KNOWN * curvature_mm, _VERTEX_MM, sphere.radius_mm, then_um)


# The screen itself before the camera, and the screen on a rail: what a pair of hands and a steel rule can do
_TILTED_DEG = ((0.0, 25.0), (25.0, 0.0))  # to two sides: one tilt leaves the focal length with the distance
_FILLS = 0.9  # of the picture that the fringes fill
_RAIL_MM, _RAIL_SIGMA_MM, _RAIL_TURN_DEG = -300.0, 0.05, 0.5  # away from the mirror; a dial gauge's length


@dataclass(frozen=True)
class ScreenAdvice:
    """Sets with the screen in another place, each in addition to those named before it."""

    sets: Literal["screen", "screen_moved"]  # `[artefact] form = "screen"`, or `[screen_moved]` beside a film's set
    distance_mm: float  # of the screen from the camera; by how far it moves along its normal
    sag_um: float  # 1 sigma then


def screen_advice(solution: Solution, index: int) -> tuple[ScreenAdvice, ...]:
    """Sets of the screen itself, and of the film with the screen elsewhere, the most useful first; those worth it.

    The second is judged as taken with the first.
    """
    problem, found = solution.problem, solution
    half_mm = np.max([np.abs(problem.sets[k].screen_mm).max(axis=1) for k in problem.films], axis=0)
    left: dict[Literal["screen", "screen_moved"], float] = {}
    if not any(isinstance(phases.artefact, SeenScreen) for phases in problem.sets):
        left["screen"] = _fills_mm(solution, index, half_mm)
    if not any(problem.sets[k].elsewhere for k in problem.films):
        left["screen_moved"] = _RAIL_MM
    out: list[ScreenAdvice] = []
    while left:
        tried = {
            name: _with_screens(found, index, half_mm, mm) if name == "screen" else _with_rail(found, index, half_mm)
            for name, mm in left.items()
        }
        claims = {name: sag_um(surface_covariance(then, index)) for name, then in tried.items()}
        name = min(claims, key=lambda each: claims[each])
        if not claims[name] < _WORTH * sag_um(surface_covariance(found, index)):
            break
        out.append(ScreenAdvice(name, left.pop(name), claims[name]))
        found = tried[name]
    return tuple(out)


def _fills_mm(solution: Solution, index: int, half_mm: FloatArray) -> float:
    """Distance at which the fringes fill the part of the picture that sees the mirror."""
    rays = solution.bench.geometry.rotation @ residuals.camera_rays(
        solution.bench.geometry, solution.problem.sets[index]
    )
    return float(_FILLS * 2 * np.min(half_mm) / np.ptp(rays[:2] / rays[2], axis=1).max())


def _with_screens(solution: Solution, index: int, half_mm: FloatArray, distance_mm: float) -> Solution:
    """The solution with sets of the screen itself at that distance, tilted to two sides."""
    film, state = solution.problem.sets[index], solution.states[index]
    film = replace(film.subset(film.seen_with(0)), displacement_um=np.nan, screen=None)
    rays = solution.bench.geometry.rotation @ residuals.camera_rays(solution.bench.geometry, film)
    middle = np.append((rays[:2] / rays[2]).mean(axis=1), 1.0)
    state = separable.SetState(state.surface, 0.0, elsewhere=(np.zeros(residuals.MOVED),))
    more = []
    for tilt_deg in _TILTED_DEG:
        # its back to the camera's view: s_y goes up in the picture
        facing = Rotation.from_euler("xy", tilt_deg, degrees=True).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        screen = SeenScreen(distance_mm * middle, facing.T)
        more.append(
            _foreseen(solution, replace(film, artefact=screen, elsewhere=(residuals.ANYWHERE,)), state, half_mm)
        )
    return _with_equations(solution, (*solution.equations, *more))


def _with_rail(solution: Solution, index: int, half_mm: FloatArray) -> Solution:
    """The solution with the film of one set seen again, the screen moved along a rail."""
    film, state, now = solution.problem.sets[index], solution.states[index], solution.equations[index]
    known = residuals.Elsewhere((0.0, 0.0, _RAIL_MM), _RAIL_SIGMA_MM, _RAIL_TURN_DEG, 0.0, 0.0, 0.0)
    move = known.known(solution.problem.references.laser_sigma_um)[0]
    again = film.subset(film.seen_with(0))
    again = replace(again, elsewhere=(known,), screen=np.ones(again.sigma_mm.size, int))
    state = replace(state, elsewhere=(move,))
    at_mm = -residuals.residual_mm(solution.bench, _dark(again), state.surface, state.vertex_z_mm, state.elsewhere)
    seen = _on_fringes(at_mm, half_mm)
    again = replace(again, screen_mm=at_mm).subset(seen)
    both = replace(
        film,
        column_px=np.append(film.column_px, again.column_px),
        row_px=np.append(film.row_px, again.row_px),
        screen_mm=np.hstack([film.screen_mm, again.screen_mm]),
        sigma_mm=np.append(film.sigma_mm, again.sigma_mm),
        elsewhere=(known,),
        screen=np.repeat([0, 1], [film.sigma_mm.size, again.sigma_mm.size]),
    )
    trust = replace(now.trust, weights=np.append(now.trust.weights, np.ones(again.sigma_mm.size)))
    linear = list(solution.equations)
    linear[index] = _equations(solution, both, state, trust)
    return _with_equations(solution, tuple(linear))


def _on_fringes(at_mm: FloatArray, half_mm: FloatArray) -> BoolArray:
    return np.asarray(np.all(np.abs(at_mm) < half_mm[:, None], axis=0))


def _dark(phases: residuals.SetPhases) -> residuals.SetPhases:
    return replace(phases, screen_mm=np.zeros_like(phases.screen_mm))


def _foreseen(
    solution: Solution, phases: residuals.SetPhases, state: separable.SetState, half_mm: FloatArray
) -> separable.Equations:
    """Equations of a set whose rays end where the bench found sends them, on the fringes."""
    at_mm = -residuals.residual_mm(solution.bench, _dark(phases), state.surface, state.vertex_z_mm, state.elsewhere)
    seen = replace(phases, screen_mm=at_mm).subset(_on_fringes(at_mm, half_mm))
    return _equations(solution, seen, state, separable.Trust.full(seen))


def _equations(
    solution: Solution, phases: residuals.SetPhases, state: separable.SetState, trust: separable.Trust
) -> separable.Equations:
    turns = parameters.pose_derivatives(solution.problem.stated, solution.values)
    references = solution.problem.references
    return separable.equations(solution.bench, turns, phases, state, solution.common, references, trust)


def _with_equations(solution: Solution, linear: tuple[separable.Equations, ...]) -> Solution:
    sums, sigmas = np.sum([each.reduced() for each in linear], axis=0), solution.problem.sigmas
    return replace(solution, equations=linear, covariance=step(sums + solution.known(sigmas), sigmas).covariance)
