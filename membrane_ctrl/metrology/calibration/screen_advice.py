"""Sets with the screen in another place that would lower the sag's sigma, the most useful first."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.calibration import robust_weights, set_state
from membrane_ctrl.metrology.calibration.advice import WORTHWHILE_SHARE
from membrane_ctrl.metrology.calibration.figure_uncertainty import sag_um, surface_covariance
from membrane_ctrl.metrology.calibration.foreseen_sets import (
    foreseen_equations,
    foreseen_set,
    with_equations,
)
from membrane_ctrl.metrology.calibration.solver import Solution
from membrane_ctrl.metrology.rays import forward_model, set_phases
from membrane_ctrl.metrology.rays.artefacts import SeenScreen
from membrane_ctrl.model.arrays import FloatArray

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
        if not claims[name] < WORTHWHILE_SHARE * sag_um(surface_covariance(found, index)):
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
        elsewhere=(set_phases.ANYWHERE,),
    )
    rays = camera.rotation @ forward_model.camera_rays(camera, film)
    tangents = rays[:2] / rays[2]
    distance_mm = float(_FILLS * 2 * np.min(half_mm) / np.ptp(tangents, axis=1).max())
    middle = np.append(tangents.mean(axis=1), 1.0)
    state = set_state.SetState(
        solution.states[index].surface, 0.0, elsewhere=(np.zeros(set_phases.MOVED),)
    )
    more = []
    for turn in ("x", "y"):
        # it faces the camera, and s_y goes up in the picture
        facing = Rotation.from_euler(turn, TILT_DEG, degrees=True).as_matrix() @ np.diag(
            [1.0, -1.0, -1.0]
        )
        phases = replace(film, artefact=SeenScreen(distance_mm * middle, facing.T))
        seen = foreseen_set(solution, phases, state, half_mm)
        more.append(
            foreseen_equations(solution, seen, state, robust_weights.RobustWeights.full(seen))
        )
    return with_equations(solution, (*solution.equations, *more)), distance_mm


def _with_rail(solution: Solution, index: int, half_mm: FloatArray) -> tuple[Solution, float]:
    """The solution with the film of one set seen again, the screen moved along a rail, and by how
    far.
    """
    film, now = solution.problem.sets[index], solution.equations[index]
    known = set_phases.Elsewhere((0.0, 0.0, _RAIL_MM), RAIL_SIGMA_MM, _RAIL_TURN_DEG, 0.0, 0.0, 0.0)
    move = known.known(solution.problem.references.laser_sigma_um)[0]
    state = replace(solution.states[index], elsewhere=(move,))
    there = foreseen_set(solution, film.beside(film, known), state, half_mm)
    again = there.subset(there.seen_with(1))
    trust = replace(now.trust, weights=np.append(now.trust.weights, np.ones(again.sigma_mm.size)))
    linear = list(solution.equations)
    linear[index] = foreseen_equations(solution, film.beside(again, known), state, trust)
    return with_equations(solution, tuple(linear)), _RAIL_MM


_FORESEEN = {"screen": _with_screens, "screen_moved": _with_rail}
