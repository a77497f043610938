"""Sets of phases from the twin's own trace: a bench whose parameters are off, a mounted film at
several sags.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.calibration.set_state import References
from membrane_ctrl.metrology.calibration.solver import Problem, Solution, first_states, fit_on
from membrane_ctrl.metrology.rays.bench_parameters import ALL, NAMES, prior_sigmas
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry, bench_at
from membrane_ctrl.metrology.rays.forward_model import residual_mm
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.sim.optics.bench_poses import CameraPose, ScreenPose
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.trace import trace_rays
from tests.worlds.second_optics import Mirror

FloatArray = NDArray[np.float64]

OPTICS = OpticsConfig()
STATED = Geometry.from_config(OPTICS)
SAGS_MM = (33.0, 35.0, 37.0, 39.0, 41.0)
NOMINAL_MM = 37.0
PIXELS = 2.16e6  # of the paper's camera inside 475 mm
# phase noise of a pixel: four steps, 0.4 ADU and rounding, a swing of 80 ADU
PIXEL_SIGMA_MM = 49.82 / (2 * np.pi) * np.sqrt(2 / 4) * np.hypot(0.4, np.sqrt(1 / 12)) / 80


@dataclass(frozen=True)
class Truth:
    """What the sets were made of."""

    values: FloatArray
    film: FilmShape | Mirror
    sets: tuple[SetPhases, ...]

    def problem(self, sigmas: FloatArray, sets: tuple[SetPhases, ...] | None = None) -> Problem:
        """To be solved."""
        return Problem(STATED, self.sets if sets is None else sets, sigmas, References(0.0), 500.0)


def plain(truth: Truth) -> Problem:
    """A fit of a, b and alpha alone, from what the fringes of single sets contradict: no ring, no
    laser's scale.
    """
    held = {p.name: 0.0 for p in ALL if p.name not in ("a_mm", "b_mm", "alpha_deg")}
    problem = truth.problem(prior_sigmas(held))
    # what three parameters cannot explain counts as noise, or the hand's measurements would count
    # for nothing
    left = [
        np.std(residual_mm(BenchGeometry(STATED), phases, state.surface, state.vertex_z_mm))
        for phases, state in zip(problem.sets, first_states(problem), strict=True)
    ]
    sets = [
        replace(p, sigma_mm=np.full_like(p.sigma_mm, own))
        for p, own in zip(problem.sets, left, strict=True)
    ]
    return replace(problem, sets=tuple(sets), references=References(0.0, 1.0, 1e6))


def make(
    values: FloatArray,
    seed: int,
    points: int = 3000,
    sags_mm: tuple[float, ...] = SAGS_MM,
    bow_mm: float = 0.0,
    bumped: dict[int, FloatArray] | None = None,
    prestrain: float = 0.0,
    poisson: float = 0.3,
) -> Truth:
    """Sets with as few points as that and the information of all pixels; `bumped` are other values
    for some sets.
    """
    film = typical_film(NOMINAL_MM, 500.0, seed, prestrain, poisson)
    rng = np.random.default_rng(seed)
    sigma_mm = PIXEL_SIGMA_MM * np.sqrt(points / PIXELS)
    sets = []
    for k, sag_mm in enumerate(sags_mm):
        own = (bumped or {}).get(k, values)
        moved_um = 1e3 * (sag_mm - NOMINAL_MM)
        column, row = (
            rng.uniform(0, 2447, int(points / 0.43)),
            rng.uniform(0, 2047, int(points / 0.43)),
        )
        seen, inside = _traced(bench_at(STATED, own), film, moved_um, column, row, bow_mm)
        seen = seen + rng.normal(0, sigma_mm, seen.shape)
        reading_um = moved_um / (1 + own[NAMES.index("laser_relative")]) + rng.normal(0, 1.0)
        sigmas_mm = np.full(seen.shape[1], sigma_mm)
        sets.append(SetPhases(f"set{k}", column[inside], row[inside], seen, sigmas_mm, reading_um))
    return Truth(values, film, tuple(sets))


def _traced(
    bench: BenchGeometry,
    film: FilmShape,
    moved_um: float,
    column: FloatArray,
    row: FloatArray,
    bow_mm: float,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    geometry = bench.geometry
    camera = CameraPose(geometry.pinhole_mm, geometry.rotation)
    screen = ScreenPose(
        geometry.screen_origin_mm, geometry.screen_s_x, geometry.screen_s_y, bow_mm / 200.0**2
    )
    rays = geometry.rays(column, row).T
    met = trace_rays(
        camera, rays, film.terms_at(moved_um), film.sag_at_mm(moved_um), -1e-3 * moved_um, screen
    )
    inside = (met.x_mm**2 + met.y_mm**2 < 475.0**2) & np.isfinite(met.s_x_mm)
    return np.stack([met.s_x_mm, met.s_y_mm])[:, inside], inside


def errors_um(surface: Surface, truth: Truth, index: int) -> tuple[float, float]:
    """Error of the sag at 475 mm, and of the figure (best plane removed) inside, RMS."""
    moved_um = 1e3 * (SAGS_MM[index] - NOMINAL_MM)
    y, x = np.mgrid[-475:476:25, -475:476:25].astype(float)
    inside = np.hypot(x, y) <= 475
    x, y = x[inside], y[inside]
    error = surface.height(x, y) - truth.film.height_mm(x, y, moved_um)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    figure = error - plane @ np.linalg.lstsq(plane, error, rcond=None)[0]
    theta = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    rim = 475 * np.cos(theta), 475 * np.sin(theta)
    sag = np.mean(surface.height(*rim) - truth.film.height_mm(*rim, moved_um))
    return 1e3 * float(sag), 1e3 * float(figure.std())


def calibrated_errors_um(solution: Solution, truth: Truth, index: int = 2) -> tuple[float, float]:
    """Of a set measured with the calibrated geometry, the vertex where the laser says, as `measure`
    does.
    """
    phases = solution.problem.sets[index]
    vertex_z_mm = -1e-3 * (phases.displacement_um - solution.problem.references.reference_um)
    return errors_um(fit_on(solution.bench, phases, 500.0, vertex_z_mm).surface, truth, index)


def stated_errors_um(truth: Truth, index: int = 2) -> tuple[float, float]:
    """Of a set measured with the stated geometry."""
    phases = truth.sets[index]
    return errors_um(
        fit_on(BenchGeometry(STATED), phases, 500.0, -1e-3 * phases.displacement_um).surface,
        truth,
        index,
    )
