"""Whether a solution may be used: the objections, one line each, the cause before its
consequences.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibration import model_tests, set_state, turn_tests
from membrane_ctrl.metrology.calibration.solver import (
    Problem,
    Solution,
    first_states,
    solve_calibration,
)
from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses

# Sets closer together than this add nothing to one set: the sag's sigma is then twice that of sets
# 8 mm apart
LEAST_SPREAD_UM = 1000.0
GOOD_SPREAD_UM = 8000.0
# A wrong geometry changes the sag's slope against the laser by some per cent at most; a wrong unit
# or sign by more
_SLOPE_OFF = 0.2
_LASER_SIGMAS = 10.0  # of one reading: below, the fringes are as likely to be wrong
_FEW_POINTS = 500  # of a set: ten times its unknowns
_SCATTER = 3.0  # times the others' noise
# with noise of nanometres, effects are significant that nobody needs to know: a figure needs 5 µm
_HARMLESS_UM = 2.5
# a correction leaves some hundredths of the motion: in a blurred picture more than the noise
_STEADY_UM = 4.0


@dataclass(frozen=True)
class CalibrationFinding:
    """Something that is wrong."""

    fatal: bool  # whether the old geometry stays in force
    description: str  # one line for a person
    sets: tuple[int, ...] = ()  # sets it is about; empty for all of them


def check_before_solving(problem: Problem) -> tuple[CalibrationFinding, ...]:
    """Findings without solving: a mirror turned by another angle, sets too close together, a laser
    with another scale or sign.
    """
    states = first_states(problem)
    wrong_angles = turn_tests.find_wrong_angles(problem, states)
    if wrong_angles:
        return tuple(
            CalibrationFinding(True, _describe_angle(problem, k, found_deg), (k,))
            for k, found_deg in wrong_angles
        )
    moved = np.array([problem.sets[k].displacement_um for k in problem.films])
    known = np.isfinite(moved)
    sag_um = np.array([1e3 * states[k].surface.sag_mm for k in problem.films])
    spread_um = float(np.ptp(moved[known])) if known.any() else 0.0
    seen_um = float(np.ptp(sag_um))
    if max(spread_um, seen_um) < LEAST_SPREAD_UM:
        if problem.with_artefact:
            return ()  # the artefacts add what the film does not
        description = (
            f"the sets are only {max(spread_um, seen_um):.0f} µm apart: they add nothing to "
            "one of them; "
            f"at least {LEAST_SPREAD_UM / 1000:.0f} mm are needed, "
            f"{GOOD_SPREAD_UM / 1000:.0f} mm are good"
        )
        return (CalibrationFinding(True, description),)
    if np.count_nonzero(known) < 2:
        return ()  # nothing to compare
    slope = float(np.polyfit(moved[known], sag_um[known], 1)[0]) if spread_um > 0 else np.inf
    if slope < 0:
        return (
            CalibrationFinding(
                True, "the laser counts the wrong way: its reading falls as the bowl deepens"
            ),
        )
    if abs(slope - 1) > _SLOPE_OFF:
        description = f"its readings are {spread_um:.4g} µm apart, the sags {seen_um:.4g} µm"
        return (
            CalibrationFinding(
                True, f"the laser's unit or scale is wrong, or it is stuck: {description}"
            ),
        )
    return ()


def check_solution(solution: Solution) -> tuple[CalibrationFinding, ...]:
    """Findings from the solution about sets and model.

    One error makes many things look wrong. Of all explanations, the one that removes most from the
    sum of squares, less two for each number it frees (Akaike's rule), is the cause; the others wait
    until it is gone.
    """
    film = _judge_film(solution)
    if not solution.converged:
        return (film[0][1] if film else _judge_divergence(solution),)
    causes = [*film, *list_causes(solution)]
    cause = [_of_still_sets(solution, max(causes, key=lambda each: each[0])[1])] if causes else []
    return (*cause, *([] if causes else _judge_scatter(solution)), *_judge_spread(solution))


def list_causes(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    """Errors of bench and sets that the equations show, each with what it explains."""
    return [*_judge_turns(solution), *list_causes_besides_turns(solution)]


def list_causes_besides_turns(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    """As `list_causes`, without mirrors that were not turned as stated."""
    return [
        *_judge_screen_positions(solution),
        *_judge_sets(solution),
        *_judge_laser(solution),
        *_judge_model(solution),
    ]


def _judge_screen_positions(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    """A screen that stood elsewhere than a set states, with the share that it explains."""
    description = (
        "the screen was not where screen_moved says beside {}: correct shift_mm, or its sigmas"
    )
    names = [phases.name for phases in solution.problem.sets]
    return [
        (
            fall - 2 * bench_poses.SCREEN_MOVE,
            CalibrationFinding(True, description.format(names[k]), (k,)),
        )
        for k, fall in model_tests.find_moved_screens(solution)
    ]


def _judge_turns(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    """Mirrors that were not turned as their sets state, with the share that it explains."""
    return [
        (each.explained, describe_unturned(solution.problem, each.index, each.found_deg))
        for each in turn_tests.find_unturned_figures(solution)
    ]


def describe_unturned(problem: Problem, index: int, found_deg: float | None) -> CalibrationFinding:
    """Finding on a figure that did not turn as stated; None: no other angle fits better."""
    if found_deg is not None:
        return CalibrationFinding(True, _describe_angle(problem, index, found_deg), (index,))
    description = (
        f"{problem.sets[index].name}: the film's figure did not turn with the mirror, cause "
        "unknown; it looks like a ring that bends in its seat, a film that changed meanwhile, or "
        "an error of the bench that no parameter describes: seat the mirror anew, wait, and take "
        "the set again"
    )
    return CalibrationFinding(True, description, (index,))


def _describe_angle(problem: Problem, index: int, found_deg: float) -> str:
    phases = problem.sets[index]
    stated_deg = 0.0 if phases.turned is None else phases.turned.angle_deg
    return (
        f"{phases.name}: the film's figure is turned by {found_deg:.4g} degrees, mirror_turned "
        f"says {stated_deg:g} (counter-clockwise as the camera sees the mirror): correct angle_deg"
    )


def _of_still_sets(solution: Solution, finding: CalibrationFinding) -> CalibrationFinding:
    """The finding; where the film moved much in some sets, that of the others, or its motion if
    they have none.
    """
    sets = solution.problem.sets
    moved = [k for k, phases in enumerate(sets) if phases.moved_um >= _STEADY_UM]
    if not moved:
        return finding
    causes, rest = [], solution
    if len(solution.problem.films) - len(moved) > 1:
        for k in reversed(moved):
            rest = model_tests.leave_set_out(rest, k)
        causes = [*_judge_sets(rest), *_judge_laser(rest), *_judge_model(rest)]
    if causes:
        return replace(max(causes, key=lambda each: each[0])[1], sets=())
    most = sets[max(moved, key=lambda k: sets[k].moved_um)]
    description = (
        f"the film moved by {most.moved_um:.0f} µm RMS while {most.name} was taken: hold it "
        "still, and take it anew"
    )
    return CalibrationFinding(True, description, tuple(moved))


def _judge_film(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    """A film that is not as the calibration was told, by a solution that knows nothing of it."""
    film_kind, problem = solution.problem.references.film, solution.problem
    if film_kind == "free":
        return []
    free = replace(problem, references=replace(problem.references, film="free"))
    try:
        other = solve_calibration(free, start=solution if solution.converged else None)
    except ValueError:
        return []
    freedom = len(terms_beyond_fit.ROUND_DEGREES) * len(problem.sets)
    fall = model_tests.film_rise(other, film_kind)
    if not other.converged or chi2.sf(fall, freedom) > model_tests.SURE:
        return []
    name = {
        "hencky": "Hencky's without pre-strain and nu = 0.3",
        "prestressed": "of the law, whatever its pre-strain",
    }
    description = f"the film's figure is not {name[film_kind]}: use --film free"
    return [(fall - 2 * freedom, CalibrationFinding(True, description))]


def _judge_sets(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    """A bumped camera, a bad set, sets that do not belong together, each with the share that it
    explains.
    """
    names = [phases.name for phases in solution.problem.sets]
    out = [
        (
            np.inf,
            CalibrationFinding(
                True,
                f"{names[k]} disagrees with all the others: {_describe_doubt(solution.problem, k)}",
                (k,),
            ),
        )
        for k in _of_others(solution)[:1]
    ]
    for bump in model_tests.find_camera_bumps(solution)[:1]:
        yaw, pitch, roll = bump.turned_deg
        where = (
            f"in {names[bump.sets[0]]}" if len(bump.sets) == 1 else f"from {names[bump.sets[0]]} on"
        )
        description = (
            f"the camera had moved {where}: yaw {yaw:+.3f}, pitch {pitch:+.3f}, roll {roll:+.3f} "
            "degrees"
        )
        out.append((bump.fall - 2 * 3, CalibrationFinding(True, description, bump.sets)))
    if (crept := model_tests.find_mount_creep(solution)) is not None:
        parameter = bench_parameters.ALL[bench_parameters.NAMES.index(crept.name)]
        description = (
            f"camera or screen crept from {names[0]} to {names[-1]}, as if by "
            f"{crept.amount:+.2g} {parameter.unit} of {crept.name} ({parameter.description}): let "
            "the mounts settle, and take the sets again"
        )
        out.append((crept.fall - 2 * crept.freedom, CalibrationFinding(True, description)))
    worst = max(model_tests.compare_left_out_sets(solution), key=lambda each: each.fall)
    if worst.disagrees:
        explained = worst.fall - 2 * worst.freedom
        if len(names) > 2 and not any(
            each.disagrees
            for each in model_tests.compare_left_out_sets(
                model_tests.leave_set_out(solution, worst.index)
            )
        ):
            wrong_part = _name_wrong_part(solution, worst.index)
            description = f"{names[worst.index]} disagrees with all the others: {wrong_part}"
            out.append((explained, CalibrationFinding(True, description, (worst.index,))))
        else:
            description = (
                "the sets contradict each other: they are not of one bench, or several of them "
                "are bad"
            )
            out.append((explained, CalibrationFinding(True, description)))
    return out


def _describe_doubt(problem: Problem, index: int) -> str:
    artefact = problem.sets[index].artefact
    return "it is of another bench" if artefact is None else artefact.doubt


def _of_others(solution: Solution) -> list[int]:
    """Sets whose fringes show a bench of their own: they hardly count, and by a pattern, not by
    noise.
    """
    ratios = np.array(
        [(np.sqrt(each.variance), each.robust.pattern_factor) for each in solution.equations]
    )
    return [
        int(k) for k in np.flatnonzero((ratios > _SCATTER * np.median(ratios, axis=0)).all(axis=1))
    ]


def _judge_divergence(solution: Solution) -> CalibrationFinding:
    """No common geometry was found: is there one without one of the sets, or for those before and
    after a moment?
    """
    problem, count = solution.problem, len(solution.problem.sets)
    for k in range(count if count > 2 else 0):
        if _have_common_bench(replace(problem, sets=problem.sets[:k] + problem.sets[k + 1 :])):
            doubt = _describe_doubt(problem, k)
            description = f"{problem.sets[k].name} disagrees with all the others: {doubt}"
            return CalibrationFinding(True, description, (k,))
    for k in range(2, count - 1):
        if all(
            _have_common_bench(replace(problem, sets=part))
            for part in (problem.sets[:k], problem.sets[k:])
        ):
            description = (
                f"the bench was changed between {problem.sets[k - 1].name} and "
                f"{problem.sets[k].name}"
            )
            return CalibrationFinding(True, description, tuple(range(k, count)))
    description = (
        "the sets do not show one bench: they are of different benches, or several of them are bad"
    )
    return CalibrationFinding(True, description)


def _have_common_bench(problem: Problem) -> bool:
    """Whether the sets share one bench; a few points of each are
    enough to show that they do not.
    """
    few = replace(problem, sets=tuple(phases.thinned(_FEW_POINTS) for phases in problem.sets))
    try:
        solution = solve_calibration(few)
    except ValueError:
        return False
    return solution.converged and not any(
        each.disagrees for each in model_tests.compare_left_out_sets(solution)
    )


def _name_wrong_part(solution: Solution, index: int) -> str:
    """Whether it is one set's laser reading that is wrong, or its fringes."""
    rest, phases = model_tests.leave_set_out(solution, index), solution.problem.sets[index]
    if phases.artefact is not None:
        return phases.artefact.doubt
    if phases.turned is not None:
        return "its fringes show another bench"  # its ring stands elsewhere
    rim_mm = set_state.rim_of(replace(solution.states[index], vertex_z_mm=0.0))[0]
    vertex_um = 1e3 * (rest.common[len(bench_parameters.NAMES)] - rim_mm)
    moved_um = phases.displacement_um - solution.problem.references.reference_um
    miss_um = moved_um + vertex_um / (
        1 + rest.values[bench_parameters.NAMES.index(bench_parameters.LASER.name)]
    )
    if abs(miss_um) > _LASER_SIGMAS * solution.problem.references.laser_sigma_um:
        return f"its laser reads {miss_um:+.1f} µm against the optics"
    return "its fringes show another bench"


def _judge_scatter(solution: Solution) -> list[CalibrationFinding]:
    """Sets that hardly count beside the others, because their fringes are so much worse."""
    ratios = np.sqrt([each.variance for each in solution.equations])
    worse = np.flatnonzero(ratios > _SCATTER * np.median(ratios))
    names = [phases.name for phases in solution.problem.sets]
    description = "{} scatters {:.1f} times as much as its camera should"
    return [
        CalibrationFinding(False, description.format(names[k], ratios[k]), (int(k),)) for k in worse
    ]


def _judge_laser(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    laser = model_tests.laser_scale(solution)
    if not laser.sure:
        return []
    description = (
        f"the laser's scale is wrong: the optics see {laser.value:.4f} +- {laser.sigma:.4f} µm "
        "per µm of it"
    )
    return [(laser.fall - 2, CalibrationFinding(True, description))]


def _judge_model(solution: Solution) -> list[tuple[float, CalibrationFinding]]:
    found = model_tests.find_suspects(solution)
    if not found:
        return []
    first, *others = found
    parameter = bench_parameters.ALL[bench_parameters.NAMES.index(first.name)]
    unit = f" {parameter.unit}" if parameter.unit else ""
    also = f" (or {', '.join(other.name for other in others)})" if others else ""
    description = (
        f"the residuals have the pattern of {first.name} = {first.value:.3g} +- "
        f"{first.sigma:.2g}{unit} "
        f"({parameter.description}){also}, {first.figure_um:.1f} µm of figure: free it with --free "
        f"{first.name}"
    )
    return [(first.fall - 2, CalibrationFinding(first.figure_um > _HARMLESS_UM, description))]


def _judge_spread(solution: Solution) -> tuple[CalibrationFinding, ...]:
    """What other sets would have determined."""
    problem = solution.problem
    moved = np.array([problem.sets[k].displacement_um for k in problem.films])
    if problem.with_artefact:
        return ()  # the sag rests on the artefacts
    if np.count_nonzero(np.isfinite(moved)) < 2:
        description = (
            "fewer than two sets carry a laser reading: the sag rests on fringes and ring alone"
        )
        return (CalibrationFinding(False, description),)
    spread_um = float(np.ptp(moved[np.isfinite(moved)]))
    if spread_um >= GOOD_SPREAD_UM / 2:
        return ()
    description = (
        f"the sets are {spread_um / 1000:.1f} mm apart; {GOOD_SPREAD_UM / 1000:.0f} mm would "
        "determine the sag better"
    )
    return (CalibrationFinding(False, description),)
