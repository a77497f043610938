"""A calibration that does not trust the film: any film gives the same bench, or is refused by its
name.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.metrology.calibration.advice import advise_number
from membrane_ctrl.metrology.calibration.figure_uncertainty import propagate_to_figure
from membrane_ctrl.metrology.calibration.film_waves import solve_any_film
from membrane_ctrl.metrology.calibration.rim_equations import Rim
from membrane_ctrl.metrology.calibration.robust_weights import RobustWeights, reduce_weights
from membrane_ctrl.metrology.calibration.set_state import FilmModel
from membrane_ctrl.metrology.calibration.solver import Solution, solve_calibration
from membrane_ctrl.metrology.calibration.verdict import check_solution
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.film.hencky_bowl import excess_rms
from membrane_ctrl.metrology.film.terms_beyond_fit import film_round_terms_mm
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, prior_sigmas, usual_sigma
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import project_points
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface_basis import (
    evaluate_basis,
    evaluate_beyond_basis,
    evaluate_round_basis,
)
from tests.support.calibration_truth import SAGS_MM, STATED, Truth, calibrated_errors_um, make
from tests.support.foreign_film_sets import make_foreign_film
from tests.support.metrology_truth import hencky_depth
from tests.worlds.second_optics import Material, Mirror, Ring, drawn_mirror

SIGMAS = prior_sigmas()
VALUES = 0.7 * SIGMAS * np.random.default_rng(8).normal(size=len(NAMES))


def solved(truth: Truth, film: FilmModel, rim: Rim | None = None) -> Solution:
    problem = truth.problem(SIGMAS)
    return solve_calibration(
        replace(problem, references=replace(problem.references, film=film), rim=rim)
    )


@pytest.mark.campaign
def test_a_film_that_is_not_henckys_is_refused_and_the_advice_holds() -> None:
    truth = make(VALUES, 4, points=600, prestrain=1e-3, poisson=0.35)
    (finding,) = check_solution(solved(truth, "hencky"))
    assert finding.fatal
    assert finding.description.endswith("use --film free")
    obeyed = solved(truth, "free")
    assert check_solution(obeyed) == ()
    sag_um, figure_um = calibrated_errors_um(obeyed, truth)
    claim = propagate_to_figure(obeyed, 2, 475.0)
    assert abs(sag_um) < 3 * claim.sag_um < 20
    assert figure_um < 3 * claim.figure_rms_um


@pytest.mark.campaign
def test_the_terms_beyond_follow_the_excess_of_any_film_of_the_law() -> None:
    """Against an integrated differential equation."""
    for strain, poisson in ((0.0, 0.3), (0.07, 0.36), (0.014, 0.42)):
        # Legendre terms of unit RMS over the disc, by quadrature
        x, weight = np.polynomial.legendre.leggauss(60)
        depth = 37.0 * hencky_depth(np.sqrt((x + 1) / 2), strain, poisson)
        terms = [
            np.sum(weight / 2 * depth * np.sqrt(2 * k + 1) * np.polynomial.Legendre.basis(k)(x))
            for k in (4, 5, 6, 7)
        ]
        law = FilmLaw(0.0, 0.3, 1.0, 500.0).with_sag(37.0)
        assert excess_rms() > 0
        assert law.sag_mm == pytest.approx(37.0)
        hencky = np.array([2150.47, 206.34, 21.05, 2.24])  # nm at 37 mm
        excess_mm = terms[0] / (1e-6 * hencky[0]) * 37.0 * excess_rms()
        expected = np.array(terms[1:]) - terms[0] * hencky[1:] / hencky[0]
        assert film_round_terms_mm(excess_mm, 37.0) == pytest.approx(expected, abs=2e-8), (
            strain,
            poisson,
        )


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(1, 6))]
)
def test_an_orthotropic_film_in_an_uneven_ring_is_accepted_with_true_bars(seed: int) -> None:
    """Moduli 2 to 12 % apart, a ring 0.2 mm out of flat; everything of the bench is off."""
    every = prior_sigmas({name: usual_sigma(name) for name in NAMES})
    rng = np.random.default_rng(seed)
    values = 0.7 * every * rng.normal(size=len(NAMES))
    values[NAMES.index("bow_mm")] = 0.0
    truth = make_foreign_film(drawn_mirror(rng, orthotropic=True, sag_mm=37.0), values, seed, 800)
    solution, findings = solve_any_film(truth.problem(every))
    (note,) = findings
    assert not note.fatal
    assert "the film has waves beyond the fitted terms" in note.description
    sag_um, figure_um = calibrated_errors_um(solution, truth)
    claim = propagate_to_figure(solution, 2, 475.0)
    assert abs(sag_um) < 3 * claim.sag_um < 3 * 25
    assert figure_um < 3 * claim.figure_rms_um < 3 * 7
    assert np.abs((solution.values - values) / solution.sigmas).max() < 4.0


def test_the_waves_are_those_of_the_film() -> None:
    """The terms of the calibration's surface leave nanoradians of a film of the second world."""
    mirror = Mirror(
        37.0,
        material=Material(ratio=0.88, poisson=0.35, shear=0.36, direction_rad=0.4),
        ring=Ring({2: (4e-4, 0.0), 3: (0.0, 2e-4)}),
    )
    radius, angle = np.meshgrid(0.95 * np.sqrt((np.arange(24) + 0.5) / 24), np.arange(96) / 96)
    x = (radius * np.cos(2 * np.pi * angle)).ravel()
    y = (radius * np.sin(2 * np.pi * angle)).ravel()
    height_mm = mirror.height_mm(500 * x, 500 * y, 0.0)
    own = evaluate_basis(x, y)[0]
    left_um = []
    for beyond in (evaluate_round_basis(x, y)[0], evaluate_beyond_basis(x, y)[0]):
        terms = np.vstack([own, beyond]).T
        left = height_mm - terms @ np.linalg.lstsq(terms, height_mm, rcond=None)[0]
        left_um.append(1e3 * float(np.std(left)))
    assert left_um[0] > 0.1
    assert left_um[1] < 2e-3


def test_a_mount_that_creeps_is_reported() -> None:
    moved = {k: VALUES + 0.1 * k * (np.array(NAMES) == "screen_x_mm") for k in range(len(SAGS_MM))}
    truth = make(VALUES, 5, points=600, bumped=moved)
    (finding,) = solve_any_film(truth.problem(SIGMAS))[1]  # waves do not explain it better
    assert finding.fatal
    assert finding.description.startswith("camera or screen crept from set0 to set4")


def test_the_rim_determines_the_size_and_better_measurements_are_advised() -> None:
    truth = make(VALUES, 6, points=600)
    theta = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    x, y = 500.0 * np.cos(theta), 500.0 * np.sin(theta)
    edges = project_points(
        bench_at(STATED, VALUES).geometry, np.stack([x, y, truth.film.height_mm(x, y)])
    )
    with_rim, without = solved(truth, "free", Rim(edges, 500.0, 0.02)), solved(truth, "free")
    claims = [propagate_to_figure(solution, 2, 475.0).sag_um for solution in (with_rim, without)]
    assert claims[0] < 0.95 * claims[1]
    assert abs(calibrated_errors_um(with_rim, truth)[0]) < 3 * claims[0]
    best = advise_number(without, 2)
    assert best is not None
    better = SIGMAS.copy()
    better[NAMES.index(best.name)] = best.sigma
    obeyed = solve_calibration(truth.problem(better))
    assert propagate_to_figure(obeyed, 2, 475.0).sag_um == pytest.approx(best.sag_um, rel=0.05)


def test_residuals_common_to_neighbours_lower_the_weights_and_noise_does_not() -> None:
    rng = np.random.default_rng(1)
    column, row = rng.uniform(0, 1000, (2, 3000))
    phases = SetPhases("a", column, row, np.zeros((2, 3000)), np.ones(3000), 0.0)
    noise = rng.normal(size=(3, 2, 3000))
    pattern = np.sin(column / 90) * np.cos(row / 70)
    for shared, least, most in ((0.0, 1.0, 1.2), (0.8, 1.5, 12.0)):
        left = list(noise + shared * pattern)
        found = reduce_weights([phases] * 3, left, [RobustWeights.unweighted(phases)] * 3)
        assert all(least <= trust.variance <= most for trust in found), shared


@pytest.mark.campaign
def test_a_film_that_moved_from_the_x_to_the_y_frames_is_found_to_have_moved() -> None:
    """x of a bowl that is deeper, y of one that is less deep, unseen by the laser."""
    moved_um = np.array([0.9, -0.6, 0.0, 1.2, -0.8])
    there, back = (
        make(VALUES, 9, points=500, sags_mm=tuple(SAGS_MM + s * moved_um / 2e3)) for s in (1, -1)
    )
    sets = []
    for x, y, still in zip(there.sets, back.sets, make(VALUES, 9, points=500).sets, strict=True):
        size = min(x.column_px.size, y.column_px.size)
        assert np.array_equal(x.column_px[:size], y.column_px[:size])
        both = replace(
            x.subset(slice(size)), displacement_um=still.displacement_um, motion_sigma_um=1.0
        )
        sets.append(
            replace(both, screen_mm=np.stack([x.screen_mm[0, :size], y.screen_mm[1, :size]]))
        )
    solution = solve_calibration(there.problem(SIGMAS, tuple(sets)))
    assert check_solution(solution) == ()
    assert [1e3 * state.motion_mm for state in solution.states] == pytest.approx(moved_um, abs=0.3)
