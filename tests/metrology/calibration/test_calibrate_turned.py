"""Calibration with sets of a mirror that was turned about its axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.metrology.calibration.bump_within_set import find_bump_within_set
from membrane_ctrl.metrology.calibration.figure_uncertainty import (
    propagate_to_figure,
    seat_sigmas,
)
from membrane_ctrl.metrology.calibration.film_waves import solve_any_film
from membrane_ctrl.metrology.calibration.model_tests import leave_set_out
from membrane_ctrl.metrology.calibration.set_state import COMMON, FORM_PLACE, References, SetState
from membrane_ctrl.metrology.calibration.solver import solve_calibration
from membrane_ctrl.metrology.calibration.turned_rows import form_rows
from membrane_ctrl.metrology.calibration.verdict import check_before_solving
from membrane_ctrl.metrology.film import film_form
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, prior_sigmas, usual_sigma
from membrane_ctrl.metrology.rays.forward_model import LOCAL, SEAT
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.rays.turned_mirror import TurnedMirror
from membrane_ctrl.model.zernike_terms import NOLL_INDICES
from tests.support.calibration_truth import Truth, calibrated_errors_um
from tests.support.foreign_film_sets import TurnedSet, make_foreign_film
from tests.worlds.second_optics import Material, Mirror, Ring, Seat, drawn_mirror, drawn_seat
from tests.worlds.second_optics.mirror import zernike

EVERY = prior_sigmas({name: usual_sigma(name) for name in NAMES})
SAGS_MM = (33.0, 37.0, 41.0)
RING = Ring({2: (5e-4, 2e-4), 3: (0.0, 2e-4), 4: (1e-4, 0.0)})
EVEN = Mirror(37.0, material=Material(poisson=0.33), ring=RING)
# waves of some 30 µm: those beyond the fit's terms are then below the noise
SMOOTH = Mirror(37.0, material=Material(poisson=0.33), ring=Ring({2: (6e-5, 2e-5), 3: (0.0, 3e-5)}))


def drawn_bench(rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    values = 0.7 * EVERY * rng.normal(size=len(NAMES))
    values[NAMES.index("bow_mm")] = 0.0
    return np.asarray(values)


def turned_truth(
    seed: int, stated_deg: float, mirror: Mirror = EVEN, other: Mirror | None = None
) -> Truth:
    """Three sets of an even film, and one of a mirror turned by 120 degrees."""
    rng = np.random.default_rng(seed)
    values = drawn_bench(rng)
    turned = TurnedSet((other or mirror).seated(drawn_seat(rng, 120.0)), TurnedMirror(stated_deg))
    return make_foreign_film(mirror, values, seed, 500, sags_mm=SAGS_MM, turned=[turned])


def test_terms_of_a_turned_surface_are_those_of_the_turned_film() -> None:
    """Against the second world's terms: f(theta) becomes f(theta - angle)."""
    rng, angle = np.random.default_rng(1), 0.7
    terms = [place + 2 for place in film_form.TURNING]
    assert set(NOLL_INDICES) - set(terms) == {1, 2, 3, 4, 11, 22}
    own = rng.normal(size=len(terms))
    rho, theta = np.sqrt(rng.random(200)), 2 * np.pi * rng.random(200)
    turned = film_form.turn_matrix(angle) @ own
    seen = sum(c * zernike(j, rho, theta) for c, j in zip(turned, terms, strict=True))
    there = sum(c * zernike(j, rho, theta - angle) for c, j in zip(own, terms, strict=True))
    assert seen == pytest.approx(there, abs=1e-12)
    step = 1e-6
    difference = film_form.turn_matrix(angle + step) - film_form.turn_matrix(angle - step)
    assert film_form.turn_derivative(angle) == pytest.approx(difference / (2 * step), abs=1e-8)


def test_derivatives_of_the_turned_figure_agree_with_differences() -> None:
    rng = np.random.default_rng(2)
    parameters = rng.normal(0, 0.1, PARAMETERS)
    parameters[2] = 10.0
    state = SetState(Surface.from_parameters(parameters, 500.0), 0.0, seat=(0.3, -0.2, 0.003))
    common = rng.normal(0, 0.1, COMMON)
    references = References(0.0, form_sag_mm=30.0)
    turned = TurnedMirror(120.0)
    rows = form_rows(turned, state, common, references)
    for k, step in ((0, 1e-4), (1, 1e-4), (2, 1e-6)):
        seat = list(state.seat)
        seat[k] += step
        moved = form_rows(turned, replace(state, seat=tuple(seat)), common, references)
        by_seat = -(moved[:, -1] - rows[:, -1]) / step
        assert rows[:, SEAT.start + k] == pytest.approx(by_seat, rel=1e-2, abs=1e-2)
    for k in (FORM_PLACE.start, FORM_PLACE.stop - 1):
        there = common.copy()
        there[k] += 1e-3
        moved = form_rows(turned, state, there, references)
        by_form = -(moved[:, -1] - rows[:, -1]) / 1e-3
        assert rows[:, LOCAL + k] == pytest.approx(by_form, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(1, 8))]
)
def test_turned_sets_of_an_orthotropic_film_sharpen_what_is_not_round(seed: int) -> None:
    """Moduli 2 to 12 % apart; a hand seats the mirror. The claims are true."""
    rng = np.random.default_rng(seed)
    values = drawn_bench(rng)
    mirror = drawn_mirror(rng, orthotropic=True, sag_mm=37.0)
    turned = [
        TurnedSet(mirror.seated(drawn_seat(rng, angle)), TurnedMirror(angle))
        for angle in (120.0, 240.0)
    ]
    truth = make_foreign_film(mirror, values, seed, 600, sags_mm=SAGS_MM, turned=turned)
    solution, findings = solve_any_film(truth.problem(EVERY))
    assert not [finding.description for finding in findings if finding.fatal]
    claim = propagate_to_figure(solution, 1, 475.0)
    # `calibration_truth` counts the film of 37 mm as set 2
    middle = replace(solution.problem, sets=(solution.problem.sets[1],) * 3)
    sag_um, figure_um = calibrated_errors_um(replace(solution, problem=middle), truth)
    assert abs(sag_um) < 3 * claim.sag_um
    assert figure_um < 3 * claim.figure_rms_um
    assert np.abs((solution.values - values) / solution.sigmas).max() < 4.0
    for index, each in enumerate(turned, start=3):
        seat, sigmas = solution.states[index].seat, seat_sigmas(solution, index)
        assert each.mirror.seat is not None
        assert each.stated is not None
        more_rad = each.mirror.seat.angle_rad - np.radians(each.stated.angle_deg)
        true = np.array([*each.mirror.seat.shift_mm, more_rad])
        assert np.abs((np.array(seat) - true) / sigmas).max() < 4.0
        assert sigmas[2] < np.radians(0.2)
    without = leave_set_out(leave_set_out(solution, 4), 3)
    alone = propagate_to_figure(without, 1, 475.0)
    gained = claim.zernike_um[4:10] / alone.zernike_um[4:10]
    assert np.all(gained < 1.0)
    assert np.min(gained[:2]) < 0.9  # one of the two astigmatisms is the weak one
    assert claim.sag_um < alone.sag_um


@pytest.mark.parametrize("stated_deg", [-120.0, 60.0, 100.0])
def test_a_mirror_that_was_turned_otherwise_is_named_before_anything_is_solved(
    stated_deg: float,
) -> None:
    (finding,) = check_before_solving(turned_truth(3, stated_deg).problem(EVERY))
    assert finding.fatal
    found_deg = float(finding.description.split("turned by ")[1].split()[0])
    assert found_deg == pytest.approx(120.0, abs=5.0)
    assert f"mirror_turned states {stated_deg:g}" in finding.description


def test_a_mirror_that_was_turned_a_little_otherwise_is_named_with_its_angle() -> None:
    """25 sigma of the stated angle. With waves of 30 µm, 15 sigma change nothing significantly."""
    problem = turned_truth(3, 115.0, SMOOTH).problem(EVERY)
    assert check_before_solving(problem) == ()
    (finding,) = (each for each in solve_any_film(problem)[1] if each.fatal)
    assert finding.description.startswith("set3: the film's figure is turned by 1")
    found_deg = float(finding.description.split("turned by ")[1].split()[0])
    assert found_deg == pytest.approx(120.0, abs=1.0)


def test_a_ring_that_bends_in_its_seat_is_no_wrong_angle() -> None:
    """The waves of the turned ring are 15 µm larger: no angle explains that."""
    bent = replace(SMOOTH, ring=Ring({**SMOOTH.ring.height, 2: (9e-5, 2e-5)}))
    problem = turned_truth(4, 120.0, SMOOTH, bent).problem(EVERY)
    (finding,) = (each for each in solve_any_film(problem)[1] if each.fatal)
    assert finding.description.startswith("set3: the film's figure did not turn with the mirror")
    assert "cause unknown" in finding.description


@pytest.mark.campaign  # the finding: test_a_ring_that_bends_in_its_seat_...
def test_the_figure_of_another_film_is_no_set_of_another_bench() -> None:
    """The turned ring has waves of 0.5 mm: without that figure the sets agree."""
    problem = turned_truth(3, 120.0, SMOOTH, EVEN).problem(EVERY)
    (finding,) = (each for each in solve_any_film(problem)[1] if each.fatal)
    assert finding.description.startswith("set3: the film's figure did not turn with the mirror")


def test_a_camera_that_was_bumped_is_no_unturned_figure() -> None:
    """Freeing the figure would explain a bump as well, with ten times as many numbers."""
    values = drawn_bench(np.random.default_rng(3))
    bumped = values.copy()
    bumped[NAMES.index("camera_yaw_deg")] += 0.05
    turned = [TurnedSet(SMOOTH.seated(Seat(np.radians(120.0))), TurnedMirror(120.0))]
    truth = make_foreign_film(SMOOTH, values, 3, 500, sags_mm=SAGS_MM, turned=turned)
    other = make_foreign_film(SMOOTH, bumped, 3, 500, sags_mm=SAGS_MM, turned=turned)
    problem = truth.problem(EVERY, (*truth.sets[:3], other.sets[3]))
    (finding,) = (each for each in solve_any_film(problem)[1] if each.fatal)
    assert "the film's figure" not in finding.description


def mixed_set(x: SetPhases, y: SetPhases) -> SetPhases:
    """The x fringes of one set and the y fringes of another, in the bins that both have."""
    of_x_set, of_y_set = (each.row_px * 1e4 + each.column_px for each in (x, y))
    _, of_x, of_y = np.intersect1d(of_x_set, of_y_set, return_indices=True)
    return replace(
        x,
        column_px=x.column_px[of_x],
        row_px=x.row_px[of_x],
        sigma_mm=x.sigma_mm[of_x],
        screen_mm=np.stack([x.screen_mm[0][of_x], y.screen_mm[1][of_y]]),
    )


def bumped_truths(yaw_deg: float) -> tuple[Truth, Truth]:
    """Three sets and one of a turned mirror, and the same after the camera turned."""
    values = drawn_bench(np.random.default_rng(3))
    bumped = values.copy()
    bumped[NAMES.index("camera_yaw_deg")] += yaw_deg
    turned = [TurnedSet(SMOOTH.seated(Seat(np.radians(120.0))), TurnedMirror(120.0))]
    before, after = (
        make_foreign_film(SMOOTH, each, 3, 500, sags_mm=SAGS_MM, turned=turned)
        for each in (values, bumped)
    )
    return before, after


@pytest.mark.fast_cases("3-0.02", "1-0.001")
@pytest.mark.parametrize(("index", "yaw_deg"), [(3, 0.02), (3, 0.001), (1, 0.001)])
def test_a_bump_in_the_middle_of_a_set_is_found_with_its_angle(index: int, yaw_deg: float) -> None:
    """17 and 350 µrad, of a turned mirror and of one that stands as usual."""
    before, after = bumped_truths(yaw_deg)
    sets = list(before.sets)
    sets[index] = mixed_set(before.sets[index], after.sets[index])
    found = find_bump_within_set(before.problem(EVERY, tuple(sets)))
    assert found is not None
    assert found.index == index
    assert found.turned_deg == pytest.approx((yaw_deg, 0.0, 0.0), abs=2e-4)


def test_neither_good_sets_nor_a_bump_before_a_set_are_one_in_its_middle() -> None:
    before, after = bumped_truths(0.02)
    assert find_bump_within_set(before.problem(EVERY)) is None
    sets = (*before.sets[:3], after.sets[3])
    assert find_bump_within_set(before.problem(EVERY, sets)) is None


@pytest.mark.campaign
def test_a_bump_in_the_middle_of_a_set_is_named() -> None:
    """The sets seemed to contradict each other, without a cause."""
    before, after = bumped_truths(0.02)
    sets = (*before.sets[:3], mixed_set(before.sets[3], after.sets[3]))
    (finding,) = (each for each in solve_any_film(before.problem(EVERY, sets))[1] if each.fatal)
    assert finding.description.startswith("the camera moved while set3 was taken")
    assert finding.sets == (3,)


def test_a_set_of_the_mirror_as_it_stands_is_needed() -> None:
    truth = turned_truth(5, 120.0)
    with pytest.raises(ValueError, match="a set of the mirror as it stands is needed"):
        solve_calibration(truth.problem(EVERY, truth.sets[3:]))


def test_a_seat_without_a_turn_leaves_the_second_world_unchanged() -> None:
    x_mm, y_mm = np.array([100.0, -300.0]), np.array([50.0, 200.0])
    seated = EVEN.seated(Seat(0.0)).height_mm(x_mm, y_mm, 0.0)
    assert seated == pytest.approx(EVEN.height_mm(x_mm, y_mm, 0.0), abs=1e-6)
    quarter = EVEN.seated(Seat(np.pi / 2)).height_mm(-y_mm, x_mm, 0.0)
    assert quarter == pytest.approx(EVEN.height_mm(x_mm, y_mm, 0.0), abs=1e-6)
