"""Calibration with a flat or a sphere in the mirror's place,
whose rays are traced in closed form.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from membrane_ctrl.metrology.calibration.artefact_advice import advise_sphere
from membrane_ctrl.metrology.calibration.figure_uncertainty import propagate_to_figure
from membrane_ctrl.metrology.calibration.rim_equations import Rim
from membrane_ctrl.metrology.calibration.solver import Problem, Solution, solve_calibration
from membrane_ctrl.metrology.calibration.verdict import check_before_solving, check_solution
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, prior_sigmas, usual_sigma
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import project_points
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.bench_poses import CameraPose, ScreenPose
from membrane_ctrl.sim.optics.simulation_spec import make_artefact_shape
from membrane_ctrl.sim.optics.trace import trace_rays
from tests.support.calibration_truth import (
    PIXEL_SIGMA_MM,
    STATED,
    FloatArray,
    Truth,
    calibrated_errors_um,
    make,
)

SIGMAS = prior_sigmas({name: usual_sigma(name) for name in NAMES})
SAGS_MM = (33.0, 35.0, 37.0)
PIXELS = 2448 * 2048


def drawn(seed: int) -> FloatArray:
    """By how much everything is stated wrong; the twin's trace of the film has a flat screen."""
    values = SIGMAS * np.random.default_rng(seed).normal(size=len(NAMES))
    values[NAMES.index("bow_mm")] = 0.0
    return values


def bench_of(
    values: FloatArray, seed: int, sags_mm: tuple[float, ...] = SAGS_MM
) -> tuple[Truth, Problem]:
    """Sets of a stretched film, with the rim's edge."""
    truth = make(values, seed, points=700, sags_mm=sags_mm, prestrain=3e-4, poisson=0.36)
    pitch = 1 + values[NAMES.index("pitch_relative")]  # the trace ends in true millimetres
    sets = tuple(replace(phases, screen_mm=phases.screen_mm / pitch) for phases in truth.sets)
    theta = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    x, y = 500.0 * np.cos(theta), 500.0 * np.sin(theta)
    edges = project_points(
        bench_at(STATED, values).geometry, np.stack([x, y, truth.film.height_mm(x, y)])
    )
    return truth, replace(truth.problem(SIGMAS, sets), rim=Rim(edges, 500.0, 0.2))


def looked_at(
    values: FloatArray, artefact: Artefact, curvature: float, vertex_mm: float, seed: int
) -> SetPhases:
    """What the camera sees in a sphere, or a flat, that leans by hand: rays meet it by a quadratic
    equation.
    """
    rng, bench = np.random.default_rng(seed), bench_at(STATED, values)
    column, row = rng.uniform(0, 2447, 60_000), rng.uniform(0, 2047, 60_000)
    d, start = bench.geometry.rays(column, row), bench.geometry.pinhole_mm
    vertex, up = (
        np.array([0.0, 0.0, vertex_mm]),
        Rotation.from_rotvec([*rng.normal(0, 2e-3, 2), 0.0]).as_matrix()[2],
    )
    # c |P - V|^2 = 2 up (P - V) along P = start + t d; one root lies ahead
    from_vertex = (start - vertex)[:, None]
    half = curvature * np.sum(from_vertex * d, axis=0) - up @ d
    rest = curvature * np.sum(from_vertex**2) - 2 * float(up @ (start - vertex))
    t = -rest / (half + np.sqrt(half**2 - curvature * rest))
    place = start[:, None] + t * d
    normal = up[:, None] - curvature * (place - vertex[:, None])
    away = d - 2 * np.sum(d * normal, axis=0) / np.sum(normal**2, axis=0) * normal
    axes = bench.geometry.screen_axes
    q, out = axes @ (place - bench.geometry.screen_origin_mm[:, None]), axes @ away
    seen = (q - q[2] / out[2] * out)[:2]
    inside = np.flatnonzero(
        (np.hypot(*place[:2]) < 0.95 * artefact.radius_mm) & (np.abs(seen) < 199).all(axis=0)
    )
    few = inside[:700]
    sigma = np.full(few.size, PIXEL_SIGMA_MM * np.sqrt(few.size / (inside.size / 60_000 * PIXELS)))
    noisy = seen[:, few] / bench.pitch + rng.normal(0, sigma[0], (2, few.size))
    return SetPhases("known", column[few], row[few], noisy, sigma, np.nan, artefact=artefact)


def with_known(problem: Problem, *known: SetPhases) -> Solution:
    """The solution with artefacts, first in the list."""
    more = replace(problem, sets=(*known, *problem.sets))
    assert check_before_solving(more) == ()
    return solve_calibration(more)


def sphere(
    radius_mm: float, curvature_mm: float, relative: float, vertex_sigma_mm: float
) -> Artefact:
    """As a file states it."""
    return Artefact(
        1 / curvature_mm, relative / curvature_mm, 5e-5, 0.0, vertex_sigma_mm, radius_mm
    )


def middle_errors_um(solution: Solution, truth: Truth) -> tuple[float, float]:
    """Error of the sag and of the figure of the film at 37 mm, whose truth `calibration_truth`
    counts as set 2.
    """
    only = replace(solution.problem, sets=solution.problem.sets[-len(SAGS_MM) :])
    return calibrated_errors_um(replace(solution, problem=only), truth, 2)


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.campaign)])
def test_the_sphere_that_is_advised_gives_what_was_promised(seed: int) -> None:
    values = drawn(seed)
    truth, problem = bench_of(values, seed)
    alone = solve_calibration(problem)
    advice = advise_sphere(alone, 2)
    assert advice is not None
    assert {"a_mm", "b_mm"} <= set(advice.together)
    assert advice.sag_um < 7 < 12 < propagate_to_figure(alone, 2, 475.0).sag_um
    rng = np.random.default_rng(seed)
    relative = advice.curvature_radius_sigma_mm / advice.curvature_radius_mm
    stated = sphere(advice.radius_mm, advice.curvature_radius_mm, relative, advice.vertex_sigma_mm)
    curvature = stated.curvature_per_mm + stated.curvature_sigma_per_mm * rng.normal()
    obeyed = with_known(
        problem, looked_at(values, stated, curvature, advice.vertex_sigma_mm * rng.normal(), seed)
    )
    assert check_solution(obeyed) == ()
    claim = propagate_to_figure(obeyed, 3, 475.0)
    assert claim.sag_um == pytest.approx(advice.sag_um, rel=0.1)
    sag_um, figure_um = middle_errors_um(obeyed, truth)
    assert abs(sag_um) < 3 * claim.sag_um
    assert figure_um < 3 * claim.figure_rms_um
    free = obeyed.sigmas > 0
    free[NAMES.index("bow_mm")] = False
    assert np.abs((obeyed.values - values)[free] / obeyed.sigmas[free]).max() < 4
    assert advise_sphere(obeyed, 3) is None


@pytest.mark.campaign
def test_a_sphere_that_is_not_as_stated_is_refused_by_its_name() -> None:
    values = drawn(4)
    _, problem = bench_of(values, 4)
    stated = sphere(200.0, 3400.0, 1e-4, 0.05)
    (finding,) = check_solution(with_known(problem, looked_at(values, stated, 1 / 3460.0, 0.0, 4)))
    assert finding.fatal
    assert finding.description == (
        "known disagrees with all the others: it is not the sphere that its file states, it "
        "stood elsewhere, or it "
        "was out of focus"
    )


@pytest.mark.campaign
def test_one_set_of_the_film_is_enough_beside_a_sphere_and_a_flat_is_true_but_adds_little() -> None:
    values = drawn(5)
    truth, problem = bench_of(values, 5)
    stated, flat = sphere(480.0, 3400.0, 1e-4, 0.05), Artefact(0.0, 0.0, 5e-5, 0.0, 0.05, 95.0)
    seen = looked_at(values, stated, stated.curvature_per_mm, 0.0, 5)
    one = with_known(replace(problem, sets=problem.sets[2:]), seen)
    claims = {
        "sphere": propagate_to_figure(one, 1, 475.0).sag_um,
        "film": propagate_to_figure(solve_calibration(problem), 2, 475.0).sag_um,
    }
    beside = with_known(problem, looked_at(values, flat, 0.0, 0.0, 6))
    claims["flat"] = propagate_to_figure(beside, 3, 475.0).sag_um
    assert check_solution(one) == check_solution(beside) == ()
    assert claims["sphere"] < 7
    assert 0.8 * claims["film"] < claims["flat"] < claims["film"]
    assert abs(middle_errors_um(beside, truth)[0]) < 3 * claims["flat"]


def test_terms_of_a_leaning_sphere() -> None:
    """Against the sphere itself, turned about its vertex."""
    lean, curvature_mm = Rotation.from_rotvec([3e-3, -5e-3, 0.0]), 3000.0
    known = Artefact(1 / curvature_mm, 1e-8, 1e-5, 0.0, 0.1, 400.0)
    rho, theta = np.meshgrid(np.linspace(0, 410, 30), np.linspace(0, 6, 30))
    flat = np.stack([(rho * np.cos(theta)).ravel(), (rho * np.sin(theta)).ravel()])
    cap = np.vstack([flat, curvature_mm - np.sqrt(curvature_mm**2 - np.sum(flat**2, axis=0))])
    x, y, z = lean.apply(cap.T).T
    up = lean.as_matrix()[:, 2]
    terms = known.terms_mm(-up[0] / up[2], -up[1] / up[2])
    surface = replace(
        Surface.from_parameters(terms[:ZERNIKE_TERMS], 400.0),
        beyond_mm=tuple(terms[ZERNIKE_TERMS:].tolist()),
    )
    inside = np.hypot(x, y) < 400
    assert surface.height(x, y)[inside] == pytest.approx(z[inside], abs=1e-6)
    # a change of the curvature by a sigma deepens the bowl by that much, and form is white
    spread = known.covariance_mm2()
    assert np.sqrt(spread[2, 2]) == pytest.approx(1e-8 * 400**2 / 2 / np.sqrt(12), rel=0.02)
    assert np.sqrt(spread[10, 10]) == pytest.approx(1e-5, rel=0.01)


def test_a_sphere_with_its_stated_form_error_is_accepted() -> None:
    """Its terms are drawn from the sigma; the twin traces the rays."""
    values, rng = drawn(7), np.random.default_rng(7)
    truth, problem = bench_of(values, 7)
    stated, geometry = sphere(250.0, 3400.0, 1e-4, 0.05), bench_at(STATED, values).geometry
    form_um = 1e3 * stated.form_sigma_mm * rng.normal(size=ZERNIKE_TERMS)
    shape = make_artefact_shape(3400.0, 250.0, *rng.uniform(-2e-3, 2e-3, 2), form_um)
    column, row = rng.uniform(0, 2447, 20_000), rng.uniform(0, 2047, 20_000)
    camera = CameraPose(geometry.pinhole_mm, geometry.rotation)
    screen = ScreenPose(geometry.screen_origin_mm, geometry.screen_s_x, geometry.screen_s_y)
    met = trace_rays(camera, geometry.rays(column, row).T, shape.terms, shape.sag_mm, 0.0, screen)
    inside = np.flatnonzero(np.hypot(met.x_mm, met.y_mm) < 237.0)
    sigma = np.full(inside.size, PIXEL_SIGMA_MM / np.sqrt(PIXELS / 20_000))
    seen = np.stack([met.s_x_mm, met.s_y_mm])[:, inside] / bench_at(STATED, values).pitch
    known = SetPhases("known", column[inside], row[inside], seen, sigma, np.nan, artefact=stated)
    solution = with_known(problem, known)
    assert check_solution(solution) == ()
    assert (
        abs(middle_errors_um(solution, truth)[0])
        < 3 * propagate_to_figure(solution, 3, 475.0).sag_um
        < 18
    )
