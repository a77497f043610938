"""Calibration with the screen put elsewhere, and with the screen seen directly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.calibration.figure_uncertainty import propagate_to_figure
from membrane_ctrl.metrology.calibration.point_averages import average_points
from membrane_ctrl.metrology.calibration.rim_equations import Rim
from membrane_ctrl.metrology.calibration.screen_advice import advise_screen_sets
from membrane_ctrl.metrology.calibration.screen_pose import screen_seen
from membrane_ctrl.metrology.calibration.solver import Problem, Solution, solve_calibration
from membrane_ctrl.metrology.calibration.verdict import check_solution
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, prior_sigmas, usual_sigma
from membrane_ctrl.metrology.rays.bench_poses import OPTICAL, bench_at, pose_derivatives
from membrane_ctrl.metrology.rays.forward_model import (
    COLUMNS,
    LOCAL,
    linearise_points,
    residual_mm,
    screen_views,
)
from membrane_ctrl.metrology.rays.geometry import project_points
from membrane_ctrl.metrology.rays.moved_screen import MovedScreen
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.sim.optics.bench_poses import CameraPose, ScreenPose
from membrane_ctrl.sim.optics.trace import trace_rays
from tests.support import calibration_truth
from tests.support.calibration_truth import (
    PIXEL_SIGMA_MM,
    STATED,
    FloatArray,
    Truth,
    calibrated_errors_um,
    make,
)

# a screen whose pitch is known from its data sheet, moved along a rail
SIGMAS = prior_sigmas({name: usual_sigma(name) for name in NAMES} | {"pitch_relative": 1e-4})
SAGS_MM = (33.0, 37.0)
SHIFT_MM, SHIFT_SIGMA_MM, TURN_SIGMA_DEG = (0.0, 0.0, -300.0), 0.05, 0.5
DEEPER_UM = 2.0  # the film beside the moved screen
FREE = [k for k, name in enumerate(NAMES) if name != "bow_mm"]


def bench_of(seed: int) -> tuple[FloatArray, Truth, Problem]:
    """A bench that is off in everything but the bow, and sets of a stretched film with the rim's
    edge.
    """
    values = SIGMAS * np.random.default_rng(seed).normal(size=len(NAMES))
    values[NAMES.index("bow_mm")] = 0.0
    truth = make(values, seed, points=700, sags_mm=SAGS_MM, prestrain=3e-4, poisson=0.36)
    sets = tuple(
        replace(phases, screen_mm=phases.screen_mm / bench_at(STATED, values).pitch)
        for phases in truth.sets
    )
    theta = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    x, y = 500.0 * np.cos(theta), 500.0 * np.sin(theta)
    edges = project_points(
        bench_at(STATED, values).geometry, np.stack([x, y, truth.film.height_mm(x, y)])
    )
    return values, truth, replace(truth.problem(SIGMAS, sets), rim=Rim(edges, 500.0, 0.2))


def with_moved_screen(
    values: FloatArray, truth: Truth, base: SetPhases, seed: int, off_mm: float = 0.0
) -> SetPhases:
    """The set, and the same film, a little deeper, with the screen elsewhere; the twin traces the
    rays.
    """
    rng, bench = np.random.default_rng((seed, 1)), bench_at(STATED, values)
    there = bench.geometry
    rail, turn = (
        Rotation.from_rotvec(np.radians(TURN_SIGMA_DEG) * rng.normal(size=3)).as_matrix()
        for _ in range(2)
    )
    shift_mm = rail @ np.array(SHIFT_MM) + SHIFT_SIGMA_MM * rng.normal(size=3) + [0.0, 0.0, off_mm]
    s_x, s_y = turn @ there.screen_s_x, turn @ there.screen_s_y
    screen = ScreenPose(there.screen_origin_mm + shift_mm @ there.screen_axes, s_x, s_y)
    column, row = rng.uniform(0, 2447, 1700), rng.uniform(0, 2047, 1700)
    scale = 1 + values[NAMES.index("laser_relative")]
    moved_um = 1e3 * (SAGS_MM[int(base.name[-1])] - calibration_truth.NOMINAL_MM) + DEEPER_UM
    camera, film = CameraPose(there.pinhole_mm, there.rotation), truth.film
    rays = there.rays(column, row).T
    met = trace_rays(
        camera, rays, film.terms_at(moved_um), film.sag_at_mm(moved_um), -1e-3 * moved_um, screen
    )
    seen = np.stack([met.s_x_mm, met.s_y_mm])
    inside = (np.hypot(met.x_mm, met.y_mm) < 475.0) & (np.abs(seen) < 199).all(axis=0)
    sigma = PIXEL_SIGMA_MM * np.sqrt(700 / calibration_truth.PIXELS)
    seen = seen[:, inside] / bench.pitch + rng.normal(0, sigma, (2, np.count_nonzero(inside)))
    deeper_um = moved_um / scale + rng.normal() - base.displacement_um
    known = MovedScreen(SHIFT_MM, SHIFT_SIGMA_MM, TURN_SIGMA_DEG, deeper_um, 0.0, 0.0)
    return replace(
        base,
        column_px=np.append(base.column_px, column[inside]),
        row_px=np.append(base.row_px, row[inside]),
        screen_mm=np.hstack([base.screen_mm, seen]),
        sigma_mm=np.append(base.sigma_mm, np.full(seen.shape[1], sigma)),
        moved_screens=(known,),
        screen=np.repeat([0, 1], [base.sigma_mm.size, seen.shape[1]]),
    )


def seen_directly(
    values: FloatArray,
    tilt_deg: tuple[float, float],
    seed: int,
    name: str = "direct",
    glass_mm: float = 0.0,
) -> SetPhases:
    """The screen 900 mm before the camera, by rays that meet a plane, its pixels behind glass."""
    rng, bench = np.random.default_rng((seed, 2)), bench_at(STATED, values)
    facing = Rotation.from_euler("XYZ", [*tilt_deg, 40.0], degrees=True).as_matrix() @ np.diag(
        [1.0, -1.0, -1.0]
    )
    there, axes = bench.geometry, (bench.geometry.rotation.T @ facing).T
    origin = there.pinhole_mm + there.rotation.T @ np.array([*rng.normal(0, 20, 2), 900.0])
    column, row = rng.uniform(0, 2447, 1200), rng.uniform(0, 2047, 1200)
    start, along = axes @ (there.pinhole_mm - origin), axes @ there.rays(column, row)
    seen = (start[:, None] - start[2] / along[2] * along)[:2]
    lean = np.arcsin(np.linalg.norm(along[:2], axis=0) / np.linalg.norm(along, axis=0) / 1.5)
    seen = seen + glass_mm * np.tan(lean) * along[:2] / np.linalg.norm(along[:2], axis=0)
    inside = (np.abs(seen) < 199).all(axis=0)
    sigma = PIXEL_SIGMA_MM * np.sqrt(1200 / (2448 * 2048))
    screen_mm = seen[:, inside] / bench.pitch + rng.normal(0, sigma, (2, np.count_nonzero(inside)))
    place = column[inside], row[inside], screen_mm
    screen = screen_seen(STATED, *place)
    return SetPhases(
        name,
        *place,
        np.full(screen_mm.shape[1], sigma),
        np.nan,
        artefact=screen,
        moved_screens=(MovedScreen.unknown_place(),),
    )


def assert_true(solution: Solution, values: FloatArray, truth: Truth, index: int) -> None:
    """Nothing is found wrong, the film of 37 mm is within the claim, and so are all parameters."""
    assert not any(finding.fatal for finding in check_solution(solution))
    claim = propagate_to_figure(solution, index, 475.0)
    only = replace(solution.problem, sets=(solution.problem.sets[index],))
    # `calibration_truth` counts the film of 37 mm as set 2
    sag_um, figure_um = calibrated_errors_um(
        replace(solution, problem=replace(only, sets=only.sets * 3)), truth, 2
    )
    assert abs(sag_um) < 3 * claim.sag_um
    assert figure_um < 3 * claim.figure_rms_um
    errors = (solution.values - values)[FREE] / solution.sigmas[FREE]
    assert np.abs(errors).max() < 4


@pytest.mark.parametrize(
    "seed", [2, *(pytest.param(k, marks=pytest.mark.campaign) for k in range(3, 9))]
)
def test_a_moved_screen_and_the_screen_itself_sharpen_the_sag_within_its_error_bar(
    seed: int,
) -> None:
    values, truth, problem = bench_of(seed)
    far = tuple(with_moved_screen(values, truth, phases, seed) for phases in problem.sets)
    direct = seen_directly(values, (0.0, 25.0), seed), seen_directly(values, (25.0, 0.0), seed + 50)
    sag_um = {}
    rows = {
        "film": problem.sets,
        "far": far,
        "direct": (*direct, *problem.sets),
        "both": direct + far,
    }
    for name, sets in rows.items():
        solution = solve_calibration(replace(problem, sets=sets))
        assert_true(solution, values, truth, len(sets) - 1)
        sag_um[name] = propagate_to_figure(solution, len(sets) - 1, 475.0).sag_um
    assert sag_um["film"] > 14
    assert sag_um["far"] < 0.85 * sag_um["film"]
    assert sag_um["direct"] < 0.5 * sag_um["film"]
    assert sag_um["both"] < 5  # the goal
    focal = NAMES.index("focal_relative")
    assert solution.sigmas[focal] < 1e-5


@pytest.mark.parametrize(
    "seed", [3, *(pytest.param(k, marks=pytest.mark.campaign) for k in range(4, 9))]
)
def test_the_cover_glass_is_not_taken_for_another_screen(seed: int) -> None:
    """A millimetre of glass was taken for another lens, or another screen."""
    values, truth, problem = bench_of(seed)
    glass_mm = float(np.random.default_rng(seed).uniform(0.5, 2.0))
    tilts = ((0.0, 25.0), seed), ((25.0, 0.0), seed + 50)
    direct = tuple(seen_directly(values, *each, glass_mm=glass_mm) for each in tilts)
    solution = solve_calibration(replace(problem, sets=(*direct, *problem.sets)))
    assert_true(solution, values, truth, 3)
    assert [state.moved_screens[0][-2] for state in solution.states[:2]] == pytest.approx(
        [glass_mm] * 2, rel=0.3
    )


@pytest.mark.parametrize(
    "seed", [9, *(pytest.param(k, marks=pytest.mark.campaign) for k in range(10, 16))]
)
def test_advised_screens_keep_their_promise(seed: int) -> None:
    values, truth, problem = bench_of(seed)
    alone = solve_calibration(problem)
    first, second = advise_screen_sets(alone, 1)
    assert (first.sets, second.sets) == ("screen", "screen_moved")
    assert second.sag_um < first.sag_um < 0.6 * propagate_to_figure(alone, 1, 475.0).sag_um
    direct = seen_directly(values, (0.0, 25.0), seed), seen_directly(values, (25.0, 0.0), seed + 50)
    obeyed = solve_calibration(replace(problem, sets=(*direct, *problem.sets)))
    assert propagate_to_figure(obeyed, 3, 475.0).sag_um == pytest.approx(first.sag_um, rel=0.2)
    (left,) = advise_screen_sets(obeyed, 3)
    assert left.sag_um == pytest.approx(second.sag_um, rel=0.2)
    far = with_moved_screen(values, truth, problem.sets[1], seed)
    both = solve_calibration(replace(problem, sets=(*direct, problem.sets[0], far)))
    assert_true(both, values, truth, 3)
    assert propagate_to_figure(both, 3, 475.0).sag_um == pytest.approx(second.sag_um, rel=0.2)
    assert advise_screen_sets(both, 3) == ()


def test_a_screen_at_another_place_than_stated_is_reported() -> None:
    values, truth, problem = bench_of(4)
    first, second = problem.sets
    moved = with_moved_screen(values, truth, second, 4, off_mm=3.0)
    solution = solve_calibration(
        replace(problem, sets=(seen_directly(values, (0.0, 25.0), 4), first, moved))
    )
    (finding,) = (each for each in check_solution(solution) if each.fatal)
    assert finding.description.startswith(
        "the screen was not where screen_moved states, beside set1"
    )


@pytest.mark.campaign
def test_a_screen_seen_through_another_lens_is_reported() -> None:
    values, _, problem = bench_of(5)
    other = values.copy()
    other[NAMES.index("focal_relative")] += 0.01
    known = seen_directly(values, (0.0, 25.0), 5), seen_directly(values, (25.0, 0.0), 6)
    wrong = seen_directly(other, (-20.0, 10.0), 7, "later")
    message = [
        each.description
        for each in check_solution(
            solve_calibration(replace(problem, sets=(*known, *problem.sets, wrong)))
        )
        if each.fatal
    ]
    assert message == [
        "later disagrees with all the others: it shows another lens, another screen, or it "
        "was out of focus"
    ]


def test_a_picture_without_a_plane_of_fringes_is_refused() -> None:
    rng = np.random.default_rng(1)
    column, row = rng.uniform(0, 2447, 300), rng.uniform(0, 2047, 300)
    with pytest.raises(ValueError, match="not a plane with fringes"):
        screen_seen(STATED, column, row, rng.uniform(-200, 200, (2, 300)))
    with pytest.raises(ValueError, match="no screen is seen"):
        screen_seen(STATED, column[:5], row[:5], np.zeros((2, 5)))


def test_derivatives_of_moved_and_seen_screens_are_those_of_the_rays() -> None:
    rng = np.random.default_rng(3)
    column, row = rng.uniform(700, 1700, 40), rng.uniform(600, 1400, 40)
    dark, ones = np.zeros((2, 40)), np.ones(40)
    film = SetPhases(
        "a",
        column,
        row,
        dark,
        ones,
        0.0,
        moved_screens=(MovedScreen.unknown_place(),),
        screen=np.repeat([0, 1], 20),
    )
    values = SIGMAS * rng.normal(size=len(NAMES))
    direct = replace(film, screen=None, artefact=seen_directly(values, (10.0, 25.0), 3).artefact)
    surface = Surface.hencky_bowl(37.0, 500.0)

    def predicted(at: FloatArray, moved: FloatArray, phases: SetPhases) -> FloatArray:
        return -residual_mm(bench_at(STATED, at), phases, surface, 0.1, [moved])

    for phases in (film, direct):
        move = np.array([3.0, -2.0, -250.0, 0.7, -1.0, 2.0, 0.0, 0.0])

        places = screen_views(
            bench_at(STATED, values), pose_derivatives(STATED, values), phases, [move]
        )
        *_, (_, bench, turns, last) = places
        (chunk,) = linearise_points(bench, turns, phases.subset(last), surface, 0.1)
        for k, step in enumerate(1e-4 * np.eye(6)):
            whole = np.append(step, [0.0, 0.0])
            by = (
                predicted(values, move + whole, phases) - predicted(values, move - whole, phases)
            ) / 2e-4
            assert chunk.derivatives[:, COLUMNS + k] == pytest.approx(
                by[:, last], rel=1e-5, abs=1e-6
            )
        for k in range(OPTICAL):
            step = np.zeros(len(NAMES))
            step[k] = 1e-3 * usual_sigma(NAMES[k])
            by = (
                predicted(values + step, move, phases) - predicted(values - step, move, phases)
            ) / (2 * step[k])
            assert chunk.derivatives[:, LOCAL + k] == pytest.approx(
                by[:, last], rel=1e-4, abs=1e-5 * np.abs(by).max() + 1e-7
            )


def test_means_of_many_points_do_not_mix_the_places_of_the_screen() -> None:
    values, truth, problem = bench_of(6)
    moved = with_moved_screen(values, truth, problem.sets[1], 6)
    solution = solve_calibration(replace(problem, sets=(problem.sets[0], moved)))
    few = average_points(solution.bench, moved, solution.states[1], 300)
    assert few.screen is not None
    assert 150 < np.count_nonzero(few.screen == 0) < 450
    assert 150 < np.count_nonzero(few.screen == 1) < 450
    again = solve_calibration(replace(problem, sets=(problem.sets[0], few)), start=solution)
    assert np.abs((again.values - solution.values)[FREE] / solution.sigmas[FREE]).max() < 1


def test_the_start_of_a_seen_screen_does_not_matter() -> None:
    values, _, problem = bench_of(7)
    direct = seen_directly(values, (0.0, 25.0), 7)
    screen = direct.artefact
    turned = Rotation.from_rotvec([0.02, 0.01, -0.03]).as_matrix()
    other = replace(
        screen, origin_mm=screen.origin_mm + np.array([5.0, -3.0, 10.0]), axes=turned @ screen.axes
    )
    first, second = (
        solve_calibration(replace(problem, sets=(replace(direct, artefact=each), *problem.sets)))
        for each in (screen, other)
    )
    assert np.abs((first.values - second.values)[FREE] / first.sigmas[FREE]).max() < 0.05
