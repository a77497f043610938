"""A film that is not isotropic, or whose ring is not flat: its waves beyond the fit's terms.

Such waves are hundredths of a micrometre, but their slopes are far above the noise of a full set:
without them the sets contradict each other, and every other test of the model blames something
else. With them the sets determine the bench less well. So the sets are solved without waves first.
Where waves would explain more than noise, or the sets would be refused, they are solved with waves,
and what these explain is compared with what every other cause would explain in their place
(Akaike's rule).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibration import model_tests, turn_tests, verdict
from membrane_ctrl.metrology.calibration.bump_within_set import find_bump_within_set
from membrane_ctrl.metrology.calibration.solver import Problem, Solution, solve_calibration
from membrane_ctrl.metrology.film import film_form, terms_beyond_fit

_UNLIKELY = 1e-3  # probability that noise looks as much like waves: then they are tried


def solve_any_film(
    problem: Problem, progress: Callable[[int, float], None] | None = None
) -> tuple[Solution, tuple[verdict.CalibrationFinding, ...]]:
    """Calibrate with sets of any film, and judge the solution.

    Parameters
    ----------
    problem : Problem
        Sets of one bench; `references.waves` is chosen here.
    progress : callable, optional
        Gets the number of each step and its largest change in standard deviations.

    Returns
    -------
    Solution
        Without waves where the sets show none.
    tuple of CalibrationFinding
        As `verdict.check_solution` has them, with a note on the waves.

    Raises
    ------
    ValueError
        As `solve_calibration`.
    """
    # As the sets state their mirrors' turns; if that gives no usable solution, with the figures of
    # turned mirrors free.
    refused: ValueError | None = None
    try:
        solution, findings = _solve_as_stated(problem, progress)
        if not any(finding.fatal for finding in findings):
            return solution, findings
    except ValueError as error:
        refused = error
    # A camera that was bumped in the middle of a set looks like many other things.
    bump = find_bump_within_set(problem)
    if bump is not None:
        finding = verdict.describe_bump_within(problem, bump)
        if refused is not None:
            raise ValueError(finding.description)
        return solution, (finding,)
    unturned = _solve_unturned(problem, progress)
    if unturned is not None:
        return unturned
    if refused is not None:
        raise refused
    return solution, findings


def _solve_as_stated(
    problem: Problem, progress: Callable[[int, float], None] | None
) -> tuple[Solution, tuple[verdict.CalibrationFinding, ...]]:
    """The solution of sets whose mirrors were turned as stated; with waves where these explain
    most.
    """
    # An even film, which has no waves beyond the fit's terms.
    failed: ValueError | None = None
    even: Solution | None = None
    try:
        even = solve_calibration(problem, progress)
    except ValueError as error:
        failed = error
    if even is not None and even.converged and not _may_have_waves(even):
        # Also where the sets contradict each other: they scatter so much that waves are lost in it.
        judged = verdict.check_solution(even)
        if not any(finding.fatal for finding in judged):
            return even, judged

    # An uneven film, if its waves explain more than any error of bench or sets.
    uneven = _solve_with_waves(problem, progress)
    if uneven is not None and _waves_explain_most(uneven):
        return uneven, (*verdict.check_solution(uneven), _note_on_waves(uneven))
    if even is None:
        raise failed or ValueError("the calibration diverges")
    return even, verdict.check_solution(even)


def _solve_unturned(
    problem: Problem, progress: Callable[[int, float], None] | None
) -> tuple[Solution, tuple[verdict.CalibrationFinding, ...]] | None:
    """The cause of a refusal, if the sets agree as soon as the figure of a turned mirror is free.

    It is that figure, or what would explain more in its place (Akaike's rule): a camera that was
    bumped looks like another figure, too.
    """
    # The figure of each turned set alone is freed, then those of all of them.
    turned = [k for k, phases in enumerate(problem.sets) if phases.turned is not None]
    groups = [*((k,) for k in turned), tuple(turned)]
    for group in dict.fromkeys(groups):
        freed = _solve_with_waves(turn_tests.free_figures(problem, group), progress)
        if not group or freed is None or verdict.list_causes(freed):
            continue

        # What the freed figures explain: the fall of the sum of squares, less 2 for each number
        # that is free (Akaike). Another cause that explains more is named instead.
        bound = turn_tests.bind_figures(freed, problem)
        fall = model_tests.sum_of_squares(bound) - model_tests.sum_of_squares(freed)
        explained = fall - 2 * len(film_form.TURNING) * len(group)
        others = verdict.list_causes_besides_turns(bound)
        if others:
            largest = verdict.find_largest_cause(others)
            if largest.explained > explained:
                return freed, (largest.finding,)

        # The angle by which the mirror of each set seems to be turned.
        findings = []
        for k in group:
            found_deg = turn_tests.find_angle_of_set(freed, k)
            findings.append(verdict.describe_unturned(problem, k, found_deg))
        return freed, tuple(findings)
    return None


def _may_have_waves(solution: Solution) -> bool:
    """Whether waves would lower the sum of squares by more than noise does."""
    fall = model_tests.wave_fall(solution)
    return bool(chi2.sf(fall, _count_freedom(solution)) < _UNLIKELY)


def _solve_with_waves(
    problem: Problem, progress: Callable[[int, float], None] | None
) -> Solution | None:
    references = replace(problem.references, waves=True)
    try:
        found = solve_calibration(replace(problem, references=references), progress)
    except ValueError:
        return None
    if found.converged:
        return found
    return None


def _waves_explain_most(uneven: Solution) -> bool:
    """Whether the waves explain more than any error of bench or sets would in their place."""
    bound = model_tests.bind_waves(uneven)
    fall = model_tests.sum_of_squares(bound) - model_tests.sum_of_squares(uneven)
    explained = fall - 2 * _count_freedom(uneven)
    others = [cause.explained for cause in verdict.list_causes(bound)]
    return explained > max([0.0, *others])


def _count_freedom(solution: Solution) -> int:
    return len(terms_beyond_fit.WAVES) * len(solution.problem.film_sets)


def _note_on_waves(solution: Solution) -> verdict.CalibrationFinding:
    """Size of the waves in the middle set, and what has such waves."""
    waves_mm = np.array(
        solution.states[solution.problem.middle_film_set].surface.beyond_mm[terms_beyond_fit.WAVE]
    )
    orders = np.array([abs(wave.azimuthal_order) for wave in terms_beyond_fit.WAVES])
    most = int(orders[np.argmax(np.abs(waves_mm))])
    rms_um = 1e3 * float(np.sqrt(np.sum(waves_mm**2)))
    description = (
        f"the film has waves beyond the fitted terms, {rms_um:.2g} µm RMS, most of azimuthal order "
        f"{most}; they are part of the solution. It looks like a film that is stiffer in one "
        "direction, or a ring that is not flat"
    )
    return verdict.CalibrationFinding(False, description)
