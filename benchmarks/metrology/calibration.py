"""The mirror calibrates its optics: accuracy over seeds, truth of the covariance, bow.

Accuracy: five sets a seed, rendered and decoded as `calibrate` does, at a quarter of the camera's
resolution with the noise of the sixteen pixels that each large one stands for (16-bit frames). The
true bench is drawn from the parameters' sigmas: the paper's 2 mm, 2 mm and 0.3 degrees, 0.5 degrees
of screen tilt, and the same for the other eight.
Covariance: a hundred seeds of traced points with the information of all pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.calibration.set_points import phases_of
from membrane_ctrl.config.optics import (
    CameraConfig,
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.metrology.calibration.model_tests import find_suspects
from membrane_ctrl.metrology.calibration.set_state import References
from membrane_ctrl.metrology.calibration.solver import (
    Problem,
    Solution,
    first_states,
    fit_on,
    solve_calibration,
)
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.bench_parameters import ALL, NAMES, prior_sigmas
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry, bench_at
from membrane_ctrl.metrology.rays.forward_model import residual_mm
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.sim.optics.bench_poses import CameraPose, ScreenError, ScreenPose
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.pattern_levels import pattern_sequence
from membrane_ctrl.sim.optics.trace import trace_rays
from tests.support.figures import Figure, at_least, at_most

FloatArray = NDArray[np.float64]

STATED = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9, reference_displacement_um=0.0)
MOVED_UM = (-4000.0, -2000.0, 0.0, 2000.0, 4000.0)
SEEDS = 20
BOWED_SEEDS = 5
COVARIANCE_SEEDS = 100
POINTS = 1500
_PIXELS = 2.16e6  # of the paper's camera inside 475 mm
_PIXEL_NOISE_ADU = math.hypot(0.4, math.sqrt(1 / 12))


def run() -> list[Figure]:
    """All figures."""
    return [*_accuracy(), *_bowed(), *_covariance()]


def _camera(shrink: int) -> CameraConfig:
    """Large pixels, 16 bit, with the noise of the mean of the pixels that each stands for."""
    return CameraConfig(
        width_px=2448 // shrink,
        height_px=2048 // shrink,
        pixel_um=3.45 * shrink,
        bits=16,
        noise_adu=256 * _PIXEL_NOISE_ADU / shrink,
    )


def _off(seed: int) -> FloatArray:
    own = prior_sigmas()
    return own * np.random.default_rng(1000 + seed).normal(size=own.size)


def _rendered(
    seed: int, bow_mm: float = 0.0, shrink: int = 4
) -> tuple[FilmShape, tuple[SetPhases, ...]]:
    """Five sets of one seed's bench, decoded as the stated bench would."""
    values, camera = _off(seed), _camera(shrink)
    film = typical_film(37.1, 500.0, seed)
    stated = OpticsConfig(geometry=STATED, camera=camera)
    true = OpticsConfig(
        geometry=_config(bench_at(Geometry.from_config(stated), values).geometry), camera=camera
    )
    rng = np.random.default_rng(seed)
    shown = pattern_sequence("full", true.pattern)
    sets = []
    for k, moved_um in enumerate(MOVED_UM):
        # one renderer a set: its noise must be its own
        renderer = OpticsRenderer(
            true, film, screen_error=ScreenError(bow_mm=bow_mm), seed=100 * seed + k
        )
        frames = np.stack([renderer.render_picture(pattern, moved_um) for pattern in shown])
        reading_um = moved_um / (1 + values[NAMES.index("laser_relative")]) + rng.normal(0, 1.0)
        stack = FrameStack(frames, tuple(shown), np.full(len(shown), reading_um), {})
        sets.append(phases_of(f"{k}", check_set(stack, stated), stated))
    return film, tuple(sets)


def _config(geometry: Geometry) -> GeometryConfig:
    """Poses for the twin."""
    camera = CameraPoseConfig(
        position_mm=tuple(geometry.pinhole_mm),
        rotation=tuple(tuple(row) for row in geometry.rotation),
    )
    screen = ScreenPoseConfig(
        origin_mm=tuple(geometry.screen_origin_mm),
        s_x=tuple(geometry.screen_s_x),
        s_y=tuple(geometry.screen_s_y),
    )
    return GeometryConfig(camera=camera, screen=screen, reference_displacement_um=0.0)


def _problem(sets: tuple[SetPhases, ...], free: dict[str, float] | None = None) -> Problem:
    stated = Geometry.from_config(OpticsConfig(geometry=STATED, camera=_camera(4)))
    return Problem(stated, sets, prior_sigmas(free), References(0.0), 500.0)


def _plain(problem: Problem) -> Problem:
    """a, b and alpha alone, without ring and laser scale; the rest counts as noise."""
    held = {p.name: 0.0 for p in ALL if p.name not in ("a_mm", "b_mm", "alpha_deg")}
    sets = []
    for phases, state in zip(problem.sets, first_states(problem), strict=True):
        left = np.std(
            residual_mm(BenchGeometry(problem.stated), phases, state.surface, state.vertex_z_mm)
        )
        few = phases.thin_to(5000)
        sets.append(
            SetPhases(
                few.name,
                few.column_px,
                few.row_px,
                few.screen_mm,
                np.full(few.sigma_mm.size, left),
                few.displacement_um,
            )
        )
    return Problem(
        problem.stated,
        tuple(sets),
        prior_sigmas(held),
        References(0.0, 1.0, 1e6),
        problem.radius_mm,
    )


def errors_um(surface: Surface, film: FilmShape, moved_um: float) -> tuple[float, float]:
    """Of the sag at 475 mm, and RMS of the figure inside it without the best plane."""
    # Figure: the error on a grid, without the best plane
    y, x = np.mgrid[-475:476:25, -475:476:25].astype(float)
    inside = np.hypot(x, y) <= 475
    x = x[inside]
    y = y[inside]
    error_mm = surface.height(x, y) - film.height_mm(x, y, moved_um)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    coeffs, *_ = np.linalg.lstsq(plane, error_mm, rcond=None)
    figure_mm = error_mm - plane @ coeffs
    # Sag: the mean error on a circle
    theta = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    rim_x = 475 * np.cos(theta)
    rim_y = 475 * np.sin(theta)
    sag_mm = np.mean(surface.height(rim_x, rim_y) - film.height_mm(rim_x, rim_y, moved_um))
    return 1e3 * float(sag_mm), 1e3 * float(figure_mm.std())


def _measured(solution: Solution, film: FilmShape) -> tuple[float, float]:
    """The middle set as `measure` would with the calibrated geometry."""
    phases = solution.problem.sets[2]
    surface = fit_on(solution.bench, phases, 500.0, -1e-3 * phases.displacement_um).surface
    return errors_um(surface, film, MOVED_UM[2])


def _rms(values: list[tuple[float, float]], which: int) -> float:
    return float(np.sqrt(np.mean(np.square([value[which] for value in values]))))


def _accuracy() -> list[Figure]:
    none, plain, full = [], [], []
    for seed in range(SEEDS):
        film, sets = _rendered(seed)
        problem = _problem(sets)
        stated = fit_on(
            BenchGeometry(problem.stated), sets[2], 500.0, -1e-3 * sets[2].displacement_um
        ).surface
        none.append(errors_um(stated, film, MOVED_UM[2]))
        plain.append(_measured(solve_calibration(_plain(problem)), film))
        full.append(_measured(solve_calibration(problem), film))
    where = f"({SEEDS} seeds, a quarter of the resolution)"
    rows = [
        at_most(
            f"sag error, RMS {where}", _rms(full, 0), "um", 5.0, "no calibration", _rms(none, 0)
        )
    ]
    rows.append(
        at_most(
            "figure error, RMS, tilt removed",
            _rms(full, 1),
            "um",
            5.0,
            "no calibration",
            _rms(none, 1),
        )
    )
    rows.append(at_most("sag error, worst seed", max(abs(s) for s, _ in full), "um"))
    rows.append(at_most("figure error, worst seed", max(f for _, f in full), "um"))
    rows.append(
        at_most(
            "plain a, b, alpha: sag error",
            _rms(plain, 0),
            "um",
            None,
            "no calibration",
            _rms(none, 0),
        )
    )
    rows.append(
        at_most(
            "plain a, b, alpha: figure error",
            _rms(plain, 1),
            "um",
            None,
            "no calibration",
            _rms(none, 1),
        )
    )
    return rows


def _bowed() -> list[Figure]:
    held, freed, reported = [], [], 0
    for seed in range(BOWED_SEEDS):
        film, sets = _rendered(seed, bow_mm=1.0)
        solution = solve_calibration(_problem(sets))
        held.append(_measured(solution, film))
        reported += bool(find_suspects(solution)) and find_suspects(solution)[0].name == "bow_mm"
        solution = solve_calibration(_problem(sets, {"bow_mm": 1.5}))
        freed.append(errors_um(solution.states[2].surface, film, MOVED_UM[2]))
    return [
        at_least("screen bowed by 1 mm: named", reported / BOWED_SEEDS, "share", 1.0),
        at_most(
            "... figure error with the bow freed",
            _rms(freed, 1),
            "um",
            8.0,
            "bow held",
            _rms(held, 1),
        ),
        at_most(
            "... sag error with the bow freed",
            _rms(freed, 0),
            "um",
            None,
            "bow held",
            _rms(held, 0),
        ),
    ]


def _covariance() -> list[Figure]:
    """Error over claimed sigma, RMS over the seeds: the least and the largest of the parameters."""
    own = prior_sigmas()
    free = own > 0
    ratios = []
    for seed in range(COVARIANCE_SEEDS):
        values = _off(seed)
        solution = solve_calibration(_problem(_traced(values, seed)))
        ratios.append((solution.values - values)[free] / solution.sigmas[free])
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    names = solution.free_names
    return [
        at_least(f"error / sigma, least ({names[int(rms.argmin())]})", float(rms.min()), "", 0.8),
        at_most(f"error / sigma, largest ({names[int(rms.argmax())]})", float(rms.max()), "", 1.3),
    ]


def _traced(values: FloatArray, seed: int) -> tuple[SetPhases, ...]:
    film = typical_film(37.1, 500.0, seed)
    geometry = bench_at(_problem(()).stated, values).geometry
    camera = CameraPose(geometry.pinhole_mm, geometry.rotation)
    screen = ScreenPose(geometry.screen_origin_mm, geometry.screen_s_x, geometry.screen_s_y)
    rng = np.random.default_rng(seed)
    width, height = _camera(4).width_px, _camera(4).height_px
    sigma_mm = (
        49.82 / (2 * np.pi) * math.sqrt(2 / 4) * _PIXEL_NOISE_ADU / 80 * math.sqrt(POINTS / _PIXELS)
    )
    sets = []
    for k, moved_um in enumerate(MOVED_UM):
        count = int(POINTS / 0.43)  # share of the picture that sees the mirror
        column, row = rng.uniform(0, width - 1, count), rng.uniform(0, height - 1, count)
        rays = geometry.rays(column, row).T
        met = trace_rays(
            camera, rays, film.terms, film.sag_at_mm(moved_um), -1e-3 * moved_um, screen
        )
        inside = (met.x_mm**2 + met.y_mm**2 < 475.0**2) & np.isfinite(met.s_x_mm)
        seen = np.stack([met.s_x_mm, met.s_y_mm])[:, inside]
        seen = seen + rng.normal(0, sigma_mm, seen.shape)
        reading_um = moved_um / (1 + values[NAMES.index("laser_relative")]) + rng.normal(0, 1.0)
        sigma = np.full(seen.shape[1], sigma_mm)
        sets.append(SetPhases(f"{k}", column[inside], row[inside], seen, sigma, reading_um))
    return tuple(sets)
