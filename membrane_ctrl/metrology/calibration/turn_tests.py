"""Did the film's figure turn with the mirror, and by the stated angle?"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibration import model_tests, set_state, turned_rows
from membrane_ctrl.metrology.calibration.solver import Problem, Solution
from membrane_ctrl.metrology.film import film_form
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray

_ANGLES_DEG = np.arange(0.0, 360.0, 0.5)
# An angle is wrong if the squares of the misfit at another one are less than this share of those at
# the stated one.
_FITS_BETTER = 0.1
_FAR_DEG = 10.0  # difference of angles: the stated bench does not turn a figure by as much
_NEAR_DEG = 1.0  # difference up to which two angles are the same


@dataclass(frozen=True)
class UnturnedFigure:
    """A set whose figure is not that of the film in the turned mirror.

    Attributes
    ----------
    index : int
        Number of the set.
    explained : float
        Fall of the sum of squares, less two for each number that is freed.
    found_deg : float, optional
        The angle that fits; None: no other angle fits better.
    """

    index: int
    explained: float
    found_deg: float | None


def find_unturned_figures(solution: Solution) -> tuple[UnturnedFigure, ...]:
    """Sets of turned mirrors whose figure did not turn as stated; only significant ones."""
    everything = model_tests.sum_of_squares(solution)
    out = []
    for k, phases in enumerate(solution.problem.sets):
        if phases.turned is None or not phases.turned.figure_turns:
            continue

        # The whole figure of this set is free: does it not turn as stated?
        freed = _free_figure(solution, k)
        found_deg = find_angle_of_set(freed, k)
        fall = everything - model_tests.sum_of_squares(freed)
        if chi2.sf(fall, len(film_form.TURNING)) < model_tests.SIGNIFICANCE:
            explained = fall - 2 * len(film_form.TURNING)
            out.append(UnturnedFigure(k, explained, found_deg))

        # Its angle alone is free: was it turned by another one?
        turned = _free_angle(solution, k)
        fall = everything - model_tests.sum_of_squares(turned)
        if chi2.sf(fall, 1) < model_tests.SIGNIFICANCE:
            more_deg = float(np.degrees(turned.states[k].seat[2]))
            linear_deg = phases.turned.angle_deg + more_deg
            angle_deg = linear_deg
            if found_deg is not None:
                angle_deg = found_deg
            out.append(UnturnedFigure(k, fall - 2, angle_deg))
    return tuple(out)


def free_figures(problem: Problem, indices: Sequence[int]) -> Problem:
    """Return the problem without the assumption that the film's figure turns in some sets.

    Parameters
    ----------
    problem : Problem
    indices : sequence of int
        Numbers of these sets.
    """
    sets = list(problem.sets)
    for k in indices:
        turned = sets[k].turned
        if turned is not None:
            sets[k] = replace(sets[k], turned=replace(turned, figure_turns=False))
    return replace(problem, sets=tuple(sets))


def bind_figures(solution: Solution, stated: Problem) -> Solution:
    """Return the equations of a solution with free figures, for figures that turn as stated.

    Its unknowns stay.

    Parameters
    ----------
    solution : Solution
        Of the problem with free figures.
    stated : Problem
        The problem as stated.
    """
    # A stated angle adds rows to the sums of its set: its figure less the film's, turned.
    equations = list(solution.equations)
    sets = list(solution.problem.sets)
    for k, phases in enumerate(stated.sets):
        if phases.turned is None or sets[k].turned == phases.turned:
            continue
        sets[k] = replace(sets[k], turned=phases.turned)
        rows = turned_rows.form_rows(
            phases.turned, solution.states[k], solution.common, solution.problem.references
        )
        equations[k] = replace(equations[k], sums=equations[k].sums + rows.T @ rows)
    problem = replace(solution.problem, sets=tuple(sets))
    return replace(solution, problem=problem, equations=tuple(equations))


def _free_angle(solution: Solution, index: int) -> Solution:
    """The solution without knowledge of one mirror's angle, to first order."""
    equations = list(solution.equations)
    state = solution.states[index]
    turned = solution.problem.sets[index].turned
    rows = turned_rows.seat_rows(turned, state)[-1:]
    equations[index] = replace(equations[index], sums=equations[index].sums - rows.T @ rows)
    return model_tests.move_to_solution(replace(solution, equations=tuple(equations)))


def _free_figure(solution: Solution, index: int) -> Solution:
    """The solution without the rows that turn the film's figure in one set, to first order."""
    equations = list(solution.equations)
    state = solution.states[index]
    turned = solution.problem.sets[index].turned
    rows = turned_rows.form_rows(turned, state, solution.common, solution.problem.references)
    equations[index] = replace(equations[index], sums=equations[index].sums - rows.T @ rows)
    return model_tests.move_to_solution(replace(solution, equations=tuple(equations)))


def find_wrong_angles(
    problem: Problem, states: Sequence[set_state.SetState]
) -> list[tuple[int, float]]:
    """Sets whose figure is turned by another angle than stated, before anything is solved.

    The stated bench adds some ten micrometres to each figure, so that only a strong figure at an
    angle far from the stated one is found here. Smaller errors are left to
    `find_unturned_figures`: a solution is near them.

    Parameters
    ----------
    problem : Problem
    states : sequence of SetState
        Surfaces of the sets on the stated bench.

    Returns
    -------
    list of (int, float)
        Number of the set, and the angle of its figure in degrees.
    """
    # Sets of the mirror as it was: without one there is nothing to compare with.
    not_turned = [k for k in problem.film_sets if problem.sets[k].turned is None]
    if not not_turned:
        return []
    out = []
    for k in problem.film_sets:
        turned = problem.sets[k].turned
        if turned is None:
            continue

        # The film's figure is that of the set with the nearest sag, as it depends on the sag.
        sag_mm = states[k].surface.sag_mm
        near = min(not_turned, key=lambda j: abs(states[j].surface.sag_mm - sag_mm))
        of_film = states[near].surface.parameters[list(film_form.TURNING)]
        sigmas = np.ones(of_film.size)
        found_deg = _find_angle(of_film, states[k].surface, sigmas, turned.angle_deg)
        if found_deg is not None and _angle_between(found_deg, turned.angle_deg) > _FAR_DEG:
            out.append((k, found_deg))
    return out


def find_angle_of_set(freed: Solution, index: int) -> float | None:
    """Return the angle by which the others' figure fits that of a set.

    Parameters
    ----------
    freed : Solution
        Without the assumption that the set's figure turns as stated.
    index : int
        Number of the set.

    Returns
    -------
    float or None
        In degrees; None if the stated angle fits about as well.
    """
    references = freed.problem.references
    state = freed.states[index]
    turned = freed.problem.sets[index].turned
    if references.form_sag_mm is None or turned is None:
        return None

    # The film's figure at the sag of this set.
    form = freed.common[set_state.FORM_PLACE].reshape(film_form.POWERS, -1)
    deeper_mm = state.surface.sag_mm - references.form_sag_mm
    of_film = film_form.depth_powers(deeper_mm) @ form
    sigmas = turned_rows.form_sigmas_mm(references)
    return _find_angle(of_film, state.surface, sigmas, turned.angle_deg)


def _find_angle(
    of_film: FloatArray, surface: Surface, sigmas_mm: FloatArray, stated_deg: float
) -> float | None:
    """The angle at which a film's figure fits a surface, its axis anywhere; None if the stated one
    fits about as well.
    """
    # The terms that a turn changes, and their changes by a shift of the axis, in sigmas.
    terms = np.array(film_form.TURNING)
    seen = surface.parameters[terms]
    shifts = turned_rows.shift_derivatives(surface, terms) / sigmas_mm[:, None]

    def compute_misfit(angle_deg: float) -> float:
        """Sum of squares at an angle, with the axis where it fits best."""
        turned = film_form.turn_matrix(np.radians(angle_deg)) @ of_film
        left = (turned - seen) / sigmas_mm
        best_shift = np.linalg.lstsq(shifts, left, rcond=None)[0]
        left = left - shifts @ best_shift
        return float(left @ left)

    # Every half degree is tried: the misfit has several minima.
    misfits = np.array([compute_misfit(angle_deg) for angle_deg in _ANGLES_DEG])
    best_deg = float(_ANGLES_DEG[np.argmin(misfits)])
    better = float(misfits.min()) < _FITS_BETTER * compute_misfit(stated_deg)
    if better and _angle_between(best_deg, stated_deg) >= _NEAR_DEG:
        return best_deg
    return None


def _angle_between(one_deg: float, other_deg: float) -> float:
    """Between 0 and 180 degrees."""
    return abs((one_deg - other_deg + 180.0) % 360.0 - 180.0)
