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
from membrane_ctrl.metrology.rays import forward_model, moved_screen
from membrane_ctrl.metrology.rays.artefacts import SeenScreen
from membrane_ctrl.metrology.rays.moved_screen import MovedScreen
from membrane_ctrl.model.arrays import FloatArray

# The screen itself before the camera, tilted to two sides: with one tilt, focal length and distance
# remain ambiguous.
TILT_DEG = 25.0
_FILLED = 0.9  # share of the picture that the fringes fill
# The screen on a rail, away from the mirror: what two hands and a dial gauge can do.
RAIL_SIGMA_MM = 0.05
_RAIL_MM = -300.0
_RAIL_TURN_DEG = 0.5

Placement = Literal["screen", "screen_moved"]


@dataclass(frozen=True)
class ScreenAdvice:
    """Sets with the screen in another place, each in addition to those named before it.

    Attributes
    ----------
    sets : "screen" or "screen_moved"
        Sets with `[artefact] form = "screen"`, or one with `[screen_moved]` of a film's set.
    distance_mm : float
        Distance of the screen from the camera, or its motion along its normal.
    sag_um : float
        1 sigma of the sag with these sets.
    """

    sets: Placement
    distance_mm: float
    sag_um: float


def advise_screen_sets(solution: Solution, index: int) -> tuple[ScreenAdvice, ...]:
    """Sets of the screen itself, and of the film with the screen elsewhere, that are worth taking.

    The second is judged as taken with the first.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set whose sag is considered.

    Returns
    -------
    tuple of ScreenAdvice
        The most useful first.
    """
    problem = solution.problem
    # What has not been taken yet.
    half_mm = np.max(
        [np.abs(problem.sets[k].screen_mm).max(axis=1) for k in problem.film_sets], axis=0
    )
    candidates: list[Placement] = []
    if not any(isinstance(phases.artefact, SeenScreen) for phases in problem.sets):
        candidates.append("screen")
    if not any(problem.sets[k].moved_screens for k in problem.film_sets):
        candidates.append("screen_moved")

    # Add the best candidate, as long as it reduces the sigma enough.
    found = solution
    advice: list[ScreenAdvice] = []
    while candidates:
        foreseen = {name: _foresee(name, found, index, half_mm) for name in candidates}
        sigmas_um = {
            name: sag_um(surface_covariance(then, index)) for name, (then, _) in foreseen.items()
        }
        best = min(sigmas_um, key=lambda name: sigmas_um[name])
        present_um = sag_um(surface_covariance(found, index))
        if not sigmas_um[best] < WORTHWHILE_SHARE * present_um:
            break
        found, distance_mm = foreseen[best]
        advice.append(ScreenAdvice(best, distance_mm, sigmas_um[best]))
        candidates.remove(best)
    return tuple(advice)


def _foresee(
    placement: Placement, solution: Solution, index: int, half_mm: FloatArray
) -> tuple[Solution, float]:
    """The solution with sets of that kind, and their distance.

    `half_mm` (2,) is half the size of the screen that the film's sets show.
    """
    if placement == "screen":
        return _with_screens(solution, index, half_mm)
    return _with_rail(solution, index, half_mm)


def _with_screens(solution: Solution, index: int, half_mm: FloatArray) -> tuple[Solution, float]:
    """The solution with sets of the screen itself, tilted to two sides, and its distance from the
    camera.
    """
    # The bins of the film's set, which see the screen instead.
    film = solution.problem.sets[index]
    film = replace(
        film.subset(film.select_screen(0)),
        displacement_um=np.nan,
        screen=None,
        moved_screens=(MovedScreen.unknown_place(),),
    )

    # The distance at which the fringes fill the picture.
    camera = solution.bench.geometry
    rays = camera.rotation @ forward_model.camera_rays(camera, film)
    tangents = rays[:2] / rays[2]
    width = np.ptp(tangents, axis=1).max()
    distance_mm = float(_FILLED * 2 * np.min(half_mm) / width)
    middle = np.append(tangents.mean(axis=1), 1.0)

    # Two sets, tilted about x and about y. The screen faces the camera, and s_y goes up in the
    # picture.
    no_moves = (np.zeros(moved_screen.MOVED),)
    state = set_state.SetState(solution.states[index].surface, 0.0, moved_screens=no_moves)
    more = []
    for axis in ("x", "y"):
        tilt = Rotation.from_euler(axis, TILT_DEG, degrees=True).as_matrix()
        facing = tilt @ np.diag([1.0, -1.0, -1.0])
        phases = replace(film, artefact=SeenScreen(distance_mm * middle, facing.T))
        seen = foreseen_set(solution, phases, state, half_mm)
        weights = robust_weights.RobustWeights.unweighted(seen)
        more.append(foreseen_equations(solution, seen, state, weights))
    return with_equations(solution, (*solution.equations, *more)), distance_mm


def _with_rail(solution: Solution, index: int, half_mm: FloatArray) -> tuple[Solution, float]:
    """The solution with the film of one set seen again, the screen moved along a rail, and by how
    far.
    """
    # The screen a rail's length away, known as well as a rail allows.
    film = solution.problem.sets[index]
    present = solution.equations[index]
    known = MovedScreen((0.0, 0.0, _RAIL_MM), RAIL_SIGMA_MM, _RAIL_TURN_DEG, 0.0, 0.0, 0.0)
    move = known.make_prior(solution.problem.references.laser_sigma_um)[0]
    state = replace(solution.states[index], moved_screens=(move,))
    there = foreseen_set(solution, film.add_screen_place(film, known), state, half_mm)
    again = there.subset(there.select_screen(1))
    # The equations of this set with the points of both places.
    all_weights = np.append(present.robust.weights, np.ones(again.sigma_mm.size))
    robust = replace(present.robust, weights=all_weights)
    linear = list(solution.equations)
    linear[index] = foreseen_equations(solution, film.add_screen_place(again, known), state, robust)
    return with_equations(solution, tuple(linear)), _RAIL_MM
