"""Whether a solution may be used: the objections, one line each, the cause before its
consequences.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from membrane_ctrl.metrology.calibration import model_tests, set_state, turn_tests
from membrane_ctrl.metrology.calibration.bump_within_set import BumpWithinSet
from membrane_ctrl.metrology.calibration.solver import (
    Problem,
    Solution,
    first_states,
    solve_calibration,
)
from membrane_ctrl.metrology.film import terms_beyond_fit
from membrane_ctrl.metrology.rays import bench_parameters, bench_poses

# Sets closer together than this add nothing to one set: the sag's sigma is then twice that of sets
# 8 mm apart.
LEAST_SPREAD_UM = 1000.0
GOOD_SPREAD_UM = 8000.0
# A wrong geometry changes the sag's slope against the laser by some per cent at most; a wrong unit
# or sign by more.
_SLOPE_OFF = 0.2
_LASER_SIGMAS = 10.0  # of one reading: below, the fringes are as likely to be wrong
_FEW_POINTS = 500  # of a set: ten times its unknowns
_SCATTER = 3.0  # times the others' noise
# With noise of nanometres, effects are significant that have no use: a figure needs 5 µm.
_HARMLESS_UM = 2.5
# A correction leaves some hundredths of the motion: in a blurred picture more than the noise.
_STEADY_UM = 4.0
_FILM_NAMES = {
    "hencky": "Hencky's without pre-strain and nu = 0.3",
    "prestressed": "of the law, whatever its pre-strain",
}


@dataclass(frozen=True)
class CalibrationFinding:
    """Something that is wrong with a calibration.

    Attributes
    ----------
    fatal : bool
        Whether the result is not used, and the previous geometry stays.
    description : str
        One line for a person.
    sets : tuple of int
        Numbers of the sets it is about; empty for all of them.
    """

    fatal: bool
    description: str
    sets: tuple[int, ...] = ()


@dataclass(frozen=True)
class Cause:
    """A possible cause of what is wrong.

    Attributes
    ----------
    explained : float
        What it explains of the sum of squares, less two for each number that it frees (Akaike's
        rule).
    finding : CalibrationFinding
        What to report if it is the cause.
    """

    explained: float
    finding: CalibrationFinding


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

    # How far the film's sets are apart, by the laser and by the fringes.
    moved_um = np.array([problem.sets[k].displacement_um for k in problem.film_sets])
    sag_um = np.array([1e3 * states[k].surface.sag_mm for k in problem.film_sets])
    known = np.isfinite(moved_um)
    spread_um = 0.0
    if known.any():
        spread_um = float(np.ptp(moved_um[known]))
    sag_spread_um = float(np.ptp(sag_um))
    if max(spread_um, sag_spread_um) < LEAST_SPREAD_UM:
        if problem.with_artefact:
            return ()  # the artefacts add what the film does not
        return (_describe_close_sets(max(spread_um, sag_spread_um)),)
    if np.count_nonzero(known) < 2:
        return ()  # nothing to compare

    # The sag against the laser, whose slope should be 1.
    slope = np.inf
    if spread_um > 0:
        slope = float(np.polyfit(moved_um[known], sag_um[known], 1)[0])
    if slope < 0:
        description = "the laser counts the wrong way: its reading falls as the bowl deepens"
        return (CalibrationFinding(True, description),)
    if abs(slope - 1) > _SLOPE_OFF:
        description = (
            "the laser's unit or scale is wrong, or it is stuck: its readings are "
            f"{spread_um:.4g} µm apart, the sags {sag_spread_um:.4g} µm"
        )
        return (CalibrationFinding(True, description),)
    return ()


def _describe_close_sets(spread_um: float) -> CalibrationFinding:
    description = (
        f"the sets are only {spread_um:.0f} µm apart: they add nothing to one of them; "
        f"at least {LEAST_SPREAD_UM / 1000:.0f} mm are needed, "
        f"{GOOD_SPREAD_UM / 1000:.0f} mm are good"
    )
    return CalibrationFinding(True, description)


def check_solution(solution: Solution) -> tuple[CalibrationFinding, ...]:
    """Findings from the solution about sets and model.

    One error makes many things look wrong. Of all explanations, the one that removes most from the
    sum of squares, less two for each number it frees (Akaike's rule), is the cause; the others wait
    until it is gone.
    """
    # A film of another kind may keep the steps from converging: it is judged first.
    of_film = _judge_film(solution)
    if not solution.converged:
        if of_film:
            return (of_film[0].finding,)
        return (_judge_divergence(solution),)
    findings: list[CalibrationFinding] = []
    causes = [*of_film, *list_causes(solution)]
    if causes:
        findings.append(_name_still_set_cause(solution, find_largest_cause(causes).finding))
    else:
        findings += _judge_scatter(solution)
    return (*findings, *_judge_spread(solution))


def find_largest_cause(causes: Sequence[Cause]) -> Cause:
    """The cause that explains most."""
    return max(causes, key=lambda cause: cause.explained)


def list_causes(solution: Solution) -> list[Cause]:
    """Errors of bench and sets that the equations show."""
    return [*_judge_turns(solution), *list_causes_besides_turns(solution)]


def list_causes_besides_turns(solution: Solution) -> list[Cause]:
    """As `list_causes`, without mirrors that were not turned as stated."""
    return [
        *_judge_screen_positions(solution),
        *_judge_sets(solution),
        *_judge_laser(solution),
        *_judge_model(solution),
    ]


def _judge_screen_positions(solution: Solution) -> list[Cause]:
    """A screen that was not where a set states it."""
    causes = []
    for k, fall in model_tests.find_moved_screens(solution):
        description = (
            "the screen was not where screen_moved states, beside "
            f"{solution.problem.sets[k].name}: correct shift_mm, or its sigmas"
        )
        explained = fall - 2 * bench_poses.SCREEN_MOVE
        causes.append(Cause(explained, CalibrationFinding(True, description, (k,))))
    return causes


def _judge_turns(solution: Solution) -> list[Cause]:
    """Mirrors that were not turned as their sets state."""
    causes = []
    for found in turn_tests.find_unturned_figures(solution):
        finding = describe_unturned(solution.problem, found.index, found.found_deg)
        causes.append(Cause(found.explained, finding))
    return causes


def describe_unturned(problem: Problem, index: int, found_deg: float | None) -> CalibrationFinding:
    """Return the finding on a figure that did not turn as stated.

    Parameters
    ----------
    problem : Problem
    index : int
        Number of the set.
    found_deg : float or None
        The angle that fits; None: no other angle fits better.
    """
    if found_deg is not None:
        return CalibrationFinding(True, _describe_angle(problem, index, found_deg), (index,))
    description = (
        f"{problem.sets[index].name}: the film's figure did not turn with the mirror, cause "
        "unknown; it looks like a ring that bends in its seat, a film that changed meanwhile, or "
        "an error of the bench that no parameter describes: seat the mirror again, wait, and "
        "repeat the set"
    )
    return CalibrationFinding(True, description, (index,))


def _describe_angle(problem: Problem, index: int, found_deg: float) -> str:
    phases = problem.sets[index]
    stated_deg = 0.0
    if phases.turned is not None:
        stated_deg = phases.turned.angle_deg
    return (
        f"{phases.name}: the film's figure is turned by {found_deg:.4g} degrees, mirror_turned "
        f"states {stated_deg:g} (counter-clockwise as the camera sees the mirror): correct "
        "angle_deg"
    )


def _name_still_set_cause(solution: Solution, finding: CalibrationFinding) -> CalibrationFinding:
    """The finding to report where the film moved much in some sets: that of the other sets, or the
    motion if they have none. Without such sets, the given one.
    """
    sets = solution.problem.sets
    moved = [k for k, phases in enumerate(sets) if phases.moved_um >= _STEADY_UM]
    if not moved:
        return finding

    # The causes that the others show, if there are enough of them.
    causes: list[Cause] = []
    if len(solution.problem.film_sets) - len(moved) > 1:
        rest = solution
        for k in reversed(moved):
            rest = model_tests.leave_set_out(rest, k)
        causes = [*_judge_sets(rest), *_judge_laser(rest), *_judge_model(rest)]
    if causes:
        return replace(find_largest_cause(causes).finding, sets=())

    most = sets[max(moved, key=lambda k: sets[k].moved_um)]
    description = (
        f"the film moved by {most.moved_um:.0f} µm RMS while {most.name} was taken: hold it "
        "still, and repeat the set"
    )
    return CalibrationFinding(True, description, tuple(moved))


def _judge_film(solution: Solution) -> list[Cause]:
    """A film that is not of the stated kind, by a solution that is free of it."""
    problem = solution.problem
    kind = problem.references.film
    if kind == "free":
        return []
    free = replace(problem, references=replace(problem.references, film="free"))
    start = None
    if solution.converged:
        start = solution
    try:
        other = solve_calibration(free, start=start)
    except ValueError:
        return []

    # By how much the stated kind raises the sum of squares of that solution.
    freedom = len(terms_beyond_fit.ROUND_DEGREES) * len(problem.sets)
    rise = model_tests.film_rise(other, kind)
    if not other.converged or chi2.sf(rise, freedom) > model_tests.SIGNIFICANCE:
        return []
    description = f"the film's figure is not {_FILM_NAMES[kind]}: use --film free"
    return [Cause(rise - 2 * freedom, CalibrationFinding(True, description))]


def _judge_sets(solution: Solution) -> list[Cause]:
    """A set of another bench, a bumped camera, a mount that creeps, a set that disagrees with all
    others, sets that do not belong together.
    """
    return [
        *_judge_foreign_set(solution),
        *_judge_camera(solution),
        *_judge_mounts(solution),
        *_judge_left_out(solution),
    ]


def _judge_foreign_set(solution: Solution) -> list[Cause]:
    """A set whose fringes show a bench of their own: they hardly count, and by a pattern, not by
    noise. It explains all else.
    """
    ratios = np.array(
        [(np.sqrt(each.variance), each.robust.pattern_factor) for each in solution.equations]
    )
    is_foreign = (ratios > _SCATTER * np.median(ratios, axis=0)).all(axis=1)
    if not is_foreign.any():
        return []
    k = int(np.argmax(is_foreign))
    doubt = _describe_doubt(solution.problem, k)
    return [Cause(np.inf, _make_disagreement(solution.problem, k, doubt))]


def _judge_camera(solution: Solution) -> list[Cause]:
    """A camera that was bumped for one set, or from one set on."""
    bumps = model_tests.find_camera_bumps(solution)
    if not bumps:
        return []
    bump = bumps[0]
    first = solution.problem.sets[bump.sets[0]].name
    where = f"from {first} on"
    if len(bump.sets) == 1:
        where = f"in {first}"
    yaw, pitch, roll = bump.turned_deg
    description = (
        f"the camera had moved {where}: yaw {yaw:+.3f}, pitch {pitch:+.3f}, roll {roll:+.3f} "
        "degrees"
    )
    explained = bump.fall - 2 * len(bump.turned_deg)
    return [Cause(explained, CalibrationFinding(True, description, bump.sets))]


def describe_bump_within(problem: Problem, bump: BumpWithinSet) -> CalibrationFinding:
    """Return the finding on a camera that was bumped in the middle of a set.

    Parameters
    ----------
    problem : Problem
        The sets, for the name.
    bump : BumpWithinSet
        Number of the set, and yaw, pitch and roll of its y frames about its x frames in degrees.

    Returns
    -------
    CalibrationFinding
        It spoils the calibration; the set is to be repeated.
    """
    yaw, pitch, roll = bump.turned_deg
    description = (
        f"the camera moved while {problem.sets[bump.index].name} was taken, between its x and its "
        f"y frames: yaw {yaw:+.3f}, pitch {pitch:+.3f}, roll {roll:+.3f} degrees: repeat the set"
    )
    return CalibrationFinding(True, description, (bump.index,))


def _judge_mounts(solution: Solution) -> list[Cause]:
    """Camera or screen that crept from the first set to the last."""
    creep = model_tests.find_mount_creep(solution)
    if creep is None:
        return []
    sets = solution.problem.sets
    parameter = bench_parameters.ALL[bench_parameters.NAMES.index(creep.name)]
    description = (
        f"camera or screen crept from {sets[0].name} to {sets[-1].name}, as if by "
        f"{creep.amount:+.2g} {parameter.unit} of {creep.name} ({parameter.description}): let the "
        "mounts settle, and repeat the sets"
    )
    return [Cause(creep.fall - 2 * creep.freedom, CalibrationFinding(True, description))]


def _judge_left_out(solution: Solution) -> list[Cause]:
    """One set that disagrees with all the others; or, if these disagree, too, sets that do not
    belong together.
    """
    worst = max(model_tests.compare_left_out_sets(solution), key=lambda each: each.fall)
    if not worst.disagrees:
        return []
    explained = worst.fall - 2 * worst.freedom
    if len(solution.problem.sets) > 2:
        others = model_tests.leave_set_out(solution, worst.index)
        compared = model_tests.compare_left_out_sets(others)
        if not any(each.disagrees for each in compared):
            wrong_part = _name_wrong_part(solution, worst.index)
            finding = _make_disagreement(solution.problem, worst.index, wrong_part)
            return [Cause(explained, finding)]
    description = (
        "the sets contradict each other: they are not of one bench, or several of them are bad"
    )
    return [Cause(explained, CalibrationFinding(True, description))]


def _make_disagreement(problem: Problem, index: int, reason: str) -> CalibrationFinding:
    description = f"{problem.sets[index].name} disagrees with all the others: {reason}"
    return CalibrationFinding(True, description, (index,))


def _describe_doubt(problem: Problem, index: int) -> str:
    """Why a set may disagree with the others."""
    artefact = problem.sets[index].artefact
    if artefact is None:
        return "it is of another bench"
    return artefact.doubt


def _judge_divergence(solution: Solution) -> CalibrationFinding:
    """No common geometry was found: is there one without one of the sets, or for those before and
    after a moment?
    """
    problem = solution.problem
    sets = problem.sets
    count = len(sets)

    # Without one of the sets?
    if count > 2:
        for k in range(count):
            others = replace(problem, sets=sets[:k] + sets[k + 1 :])
            if _have_common_bench(others):
                return _make_disagreement(problem, k, _describe_doubt(problem, k))

    # Before and after a moment?
    for k in range(2, count - 1):
        before = replace(problem, sets=sets[:k])
        after = replace(problem, sets=sets[k:])
        if _have_common_bench(before) and _have_common_bench(after):
            description = f"the bench was changed between {sets[k - 1].name} and {sets[k].name}"
            return CalibrationFinding(True, description, tuple(range(k, count)))
    description = (
        "the sets do not show one bench: they are of different benches, or several of them are bad"
    )
    return CalibrationFinding(True, description)


def _have_common_bench(problem: Problem) -> bool:
    """Whether the sets share one bench; a few points of each are enough to show that they do
    not.
    """
    few = replace(problem, sets=tuple(phases.thin_to(_FEW_POINTS) for phases in problem.sets))
    try:
        solution = solve_calibration(few)
    except ValueError:
        return False
    if not solution.converged:
        return False
    compared = model_tests.compare_left_out_sets(solution)
    return not any(each.disagrees for each in compared)


def _name_wrong_part(solution: Solution, index: int) -> str:
    """Whether it is one set's laser reading that is wrong, or its fringes."""
    phases = solution.problem.sets[index]
    if phases.artefact is not None:
        return phases.artefact.doubt
    if phases.turned is not None:
        return "its fringes show another bench"  # its ring is elsewhere

    # The vertex that the optics give: the others' ring, less the height of this set's rim over its
    # vertex.
    rest = model_tests.leave_set_out(solution, index)
    ring_mm = rest.common[len(bench_parameters.NAMES)]
    rim_mm = set_state.rim_height_harmonics(replace(solution.states[index], vertex_z_mm=0.0))[0]
    vertex_um = 1e3 * (ring_mm - rim_mm)

    # The laser's reading against it: vertex = -(1 + scale) (d - reference).
    scale = 1 + rest.values[bench_parameters.NAMES.index(bench_parameters.LASER.name)]
    references = solution.problem.references
    moved_um = phases.displacement_um - references.reference_um
    miss_um = moved_um + vertex_um / scale
    if abs(miss_um) > _LASER_SIGMAS * references.laser_sigma_um:
        return f"its laser reads {miss_um:+.1f} µm against the optics"
    return "its fringes show another bench"


def _judge_scatter(solution: Solution) -> list[CalibrationFinding]:
    """Sets that hardly count beside the others, because their fringes are so much worse."""
    ratios = np.sqrt([each.variance for each in solution.equations])
    findings = []
    for k in np.flatnonzero(ratios > _SCATTER * np.median(ratios)):
        name = solution.problem.sets[k].name
        description = f"{name} scatters {ratios[k]:.1f} times as much as its camera should"
        findings.append(CalibrationFinding(False, description, (int(k),)))
    return findings


def _judge_laser(solution: Solution) -> list[Cause]:
    """A laser whose scale is off by more than its data sheet allows."""
    laser = model_tests.laser_scale(solution)
    if not laser.is_significant:
        return []
    description = (
        f"the laser's scale is wrong: the optics see {laser.value:.4f} +- {laser.sigma:.4f} µm "
        "per µm of it"
    )
    return [Cause(laser.fall - 2, CalibrationFinding(True, description))]


def _judge_model(solution: Solution) -> list[Cause]:
    """A parameter that was held, and that the sets want to move."""
    suspects = model_tests.find_suspects(solution)
    if not suspects:
        return []
    first, *others = suspects
    parameter = bench_parameters.ALL[bench_parameters.NAMES.index(first.name)]
    unit = ""
    if parameter.unit:
        unit = f" {parameter.unit}"
    also = ""
    if others:
        also = f" (or {', '.join(other.name for other in others)})"
    description = (
        f"the residuals have the pattern of {first.name} = {first.value:.3g} +- "
        f"{first.sigma:.2g}{unit} ({parameter.description}){also}, {first.figure_um:.1f} µm of "
        f"figure: free it with --free {first.name}"
    )
    is_harmful = first.figure_um > _HARMLESS_UM
    return [Cause(first.fall - 2, CalibrationFinding(is_harmful, description))]


def _judge_spread(solution: Solution) -> tuple[CalibrationFinding, ...]:
    """What other sets would have determined."""
    problem = solution.problem
    if problem.with_artefact:
        return ()  # the sag rests on the artefacts
    readings_um = np.array([problem.sets[k].displacement_um for k in problem.film_sets])
    known_um = readings_um[np.isfinite(readings_um)]
    if known_um.size < 2:
        description = (
            "fewer than two sets carry a laser reading: the sag rests on fringes and ring alone"
        )
        return (CalibrationFinding(False, description),)
    spread_um = float(np.ptp(known_um))
    if spread_um >= GOOD_SPREAD_UM / 2:
        return ()
    description = (
        f"the sets are {spread_um / 1000:.1f} mm apart; {GOOD_SPREAD_UM / 1000:.0f} mm would "
        "determine the sag better"
    )
    return (CalibrationFinding(False, description),)
