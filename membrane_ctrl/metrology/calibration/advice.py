"""What to measure next: the number, or the sets, that would lower the sag's sigma most, with the
sigma then.

A set that is not taken yet is foreseen on the bench found: its rays are followed to where they
would end, with the noise of the film's set, and its normal equations are added. No prediction needs
its readings.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.calibration import normal_equations
from membrane_ctrl.metrology.calibration.figure_uncertainty import (
    sag_um,
    surface_covariance,
    weak_combinations,
)
from membrane_ctrl.metrology.calibration.solver import Solution, step
from membrane_ctrl.metrology.rays import bench_parameters, forward_model
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Artefact, SeenScreen, Surface
from membrane_ctrl.model.arrays import FloatArray

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
    sums, own = (
        np.sum([each.reduced() for each in solution.equations], axis=0),
        solution.problem.sigmas,
    )
    found = []
    for k in np.flatnonzero(own > 0):
        better = own.copy()
        better[k] /= _BETTER
        moved = replace(solution, covariance=step(sums + solution.known(better), better).covariance)
        found.append(
            Advice(
                bench_parameters.NAMES[k],
                float(better[k]),
                sag_um(surface_covariance(moved, index)),
            )
        )
    best = min(found, key=lambda each: each.sag_um, default=None)
    return (
        best
        if best is not None and best.sag_um < _WORTH * sag_um(surface_covariance(solution, index))
        else None
    )


# A sphere that a telescope maker can deliver: radius of curvature by interferometer and scale,
# place by a dial gauge
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
    """What a sphere in the mirror's place would give; None if it is not worth it, or if an artefact
    stood there.

    Its set is foreseen from the bench found: rays of the film's set that meet the sphere, with
    their noise.
    """
    if solution.problem.with_artefact:
        return None
    phases, surface = solution.problem.sets[index], solution.states[index].surface
    phases = replace(phases.subset(phases.seen_with(0)), elsewhere=())
    # as deep as the film, so that the fringes fall on the same places of the screen
    curvature_mm = (surface.radius_mm**2 + surface.sag_mm**2) / (2 * surface.sag_mm)
    spread = _SPHERE_KNOWN / curvature_mm
    sphere = Artefact(
        1 / curvature_mm, spread, _FORM_MM, 0.0, _VERTEX_MM, min(_SPHERE_MM, surface.radius_mm)
    )
    terms = sphere.terms_mm()
    shape = replace(
        Surface.from_parameters(terms[:PARAMETERS], sphere.radius_mm),
        beyond_mm=tuple(terms[PARAMETERS:].tolist()),
    )
    bench = solution.bench
    points = forward_model.place_rays(bench, phases, shape, 0.0)
    x_mm, y_mm, _z = bench.geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    seen = replace(phases, displacement_um=np.nan, artefact=sphere).subset(
        np.hypot(x_mm, y_mm) < _SPHERE_USED * sphere.radius_mm
    )
    if seen.sigma_mm.size < 2 * forward_model.LOCAL:
        return None
    seen = replace(
        seen, screen_mm=seen.screen_mm - forward_model.residual_mm(bench, seen, shape, 0.0)
    )
    more = _equations(
        solution, seen, normal_equations.SetState(shape, 0.0), normal_equations.Trust.full(seen)
    )
    then = _with_equations(solution, (*solution.equations, more))
    then_um, now_um = (sag_um(surface_covariance(each, index)) for each in (then, solution))
    if not then_um < _WORTH * now_um:
        return None
    worst = max(
        weak_combinations(solution, index, surface.radius_mm),
        key=lambda each: each.figure_um,
        default=None,
    )
    together = () if worst is None else tuple(name for name, _ in worst.parts)
    return ArtefactAdvice(
        together, curvature_mm, _SPHERE_KNOWN * curvature_mm, _VERTEX_MM, sphere.radius_mm, then_um
    )


# The screen itself before the camera, and the screen on a rail: what a pair of hands and a dial
# gauge can do
# of the screen itself, to two sides: one tilt leaves the focal length with the distance
TILT_DEG = 25.0
RAIL_SIGMA_MM = 0.05
_RAIL_MM, _RAIL_TURN_DEG = -300.0, 0.5  # away from the mirror
_FILLS = 0.9  # of the picture that the fringes fill


@dataclass(frozen=True)
class ScreenAdvice:
    """Sets with the screen in another place, each in addition to those named before it."""

    sets: Literal[
        "screen", "screen_moved"
    ]  # `[artefact] form = "screen"`, or `[screen_moved]` beside a film's set
    distance_mm: float  # of the screen from the camera; by how far it moves along its normal
    sag_um: float  # 1 sigma then


def screen_advice(solution: Solution, index: int) -> tuple[ScreenAdvice, ...]:
    """Sets of the screen itself, and of the film with the screen elsewhere, the most useful first;
    those worth it.

    The second is judged as taken with the first.
    """
    problem, found = solution.problem, solution
    half_mm = np.max([np.abs(problem.sets[k].screen_mm).max(axis=1) for k in problem.films], axis=0)
    left: list[Literal["screen", "screen_moved"]] = []
    if not any(isinstance(phases.artefact, SeenScreen) for phases in problem.sets):
        left.append("screen")
    if not any(problem.sets[k].elsewhere for k in problem.films):
        left.append("screen_moved")
    out: list[ScreenAdvice] = []
    while left:
        tried = {name: _FORESEEN[name](found, index, half_mm) for name in left}
        claims = {
            name: sag_um(surface_covariance(then, index)) for name, (then, _) in tried.items()
        }
        name = min(claims, key=lambda each: claims[each])
        if not claims[name] < _WORTH * sag_um(surface_covariance(found, index)):
            break
        found, distance_mm = tried[name]
        out.append(ScreenAdvice(name, distance_mm, claims[name]))
        left.remove(name)
    return tuple(out)


def _with_screens(solution: Solution, index: int, half_mm: FloatArray) -> tuple[Solution, float]:
    """The solution with sets of the screen itself, tilted to two sides, and its distance from the
    camera.
    """
    film, camera = solution.problem.sets[index], solution.bench.geometry
    film = replace(
        film.subset(film.seen_with(0)),
        displacement_um=np.nan,
        screen=None,
        elsewhere=(forward_model.ANYWHERE,),
    )
    rays = camera.rotation @ forward_model.camera_rays(camera, film)
    tangents = rays[:2] / rays[2]
    distance_mm = float(_FILLS * 2 * np.min(half_mm) / np.ptp(tangents, axis=1).max())
    middle = np.append(tangents.mean(axis=1), 1.0)
    state = normal_equations.SetState(
        solution.states[index].surface, 0.0, elsewhere=(np.zeros(forward_model.MOVED),)
    )
    more = []
    for turn in ("x", "y"):
        # it faces the camera, and s_y goes up in the picture
        facing = Rotation.from_euler(turn, TILT_DEG, degrees=True).as_matrix() @ np.diag(
            [1.0, -1.0, -1.0]
        )
        phases = replace(film, artefact=SeenScreen(distance_mm * middle, facing.T))
        seen = _foreseen(solution, phases, state, half_mm)
        more.append(_equations(solution, seen, state, normal_equations.Trust.full(seen)))
    return _with_equations(solution, (*solution.equations, *more)), distance_mm


def _with_rail(solution: Solution, index: int, half_mm: FloatArray) -> tuple[Solution, float]:
    """The solution with the film of one set seen again, the screen moved along a rail, and by how
    far.
    """
    film, now = solution.problem.sets[index], solution.equations[index]
    known = forward_model.Elsewhere(
        (0.0, 0.0, _RAIL_MM), RAIL_SIGMA_MM, _RAIL_TURN_DEG, 0.0, 0.0, 0.0
    )
    move = known.known(solution.problem.references.laser_sigma_um)[0]
    state = replace(solution.states[index], elsewhere=(move,))
    there = _foreseen(solution, film.beside(film, known), state, half_mm)
    again = there.subset(there.seen_with(1))
    trust = replace(now.trust, weights=np.append(now.trust.weights, np.ones(again.sigma_mm.size)))
    linear = list(solution.equations)
    linear[index] = _equations(solution, film.beside(again, known), state, trust)
    return _with_equations(solution, tuple(linear)), _RAIL_MM


_FORESEEN = {"screen": _with_screens, "screen_moved": _with_rail}


def _foreseen(
    solution: Solution,
    phases: forward_model.SetPhases,
    state: normal_equations.SetState,
    half_mm: FloatArray,
) -> forward_model.SetPhases:
    """A set whose rays end where the bench found sends them; those that end on the fringes."""
    dark = replace(phases, screen_mm=np.zeros_like(phases.screen_mm))
    at_mm = -forward_model.residual_mm(
        solution.bench, dark, state.surface, state.vertex_z_mm, state.elsewhere
    )
    return replace(phases, screen_mm=at_mm).subset(
        np.asarray(np.all(np.abs(at_mm) < half_mm[:, None], axis=0))
    )


def _equations(
    solution: Solution,
    phases: forward_model.SetPhases,
    state: normal_equations.SetState,
    trust: normal_equations.Trust,
) -> normal_equations.Equations:
    turns = bench_parameters.pose_derivatives(solution.problem.stated, solution.values)
    references = solution.problem.references
    return normal_equations.equations(
        solution.bench, turns, phases, state, solution.common, references, trust
    )


def _with_equations(solution: Solution, linear: tuple[normal_equations.Equations, ...]) -> Solution:
    sums, sigmas = np.sum([each.reduced() for each in linear], axis=0), solution.problem.sigmas
    return replace(
        solution,
        equations=linear,
        covariance=step(sums + solution.known(sigmas), sigmas).covariance,
    )
