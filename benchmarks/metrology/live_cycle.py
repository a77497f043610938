"""The live cycle at full size: time against copying the frames and against the paper's method, and
its accuracy.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from benchmarks.metrology import reference_pmd
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape
from tests.support.figures import Figure, at_least, at_most

OPTICS = OpticsConfig()
FILM = FilmShape(
    37.1, 500.0, "hencky", (0, 0, 0, 0, 800, -500, 300, 0, 400, 0, 0, 0, 50, *[0] * 23)
)
MOVED_UM = (1.0, -0.5, 2.0, 0.0)


def run() -> list[Figure]:
    """All figures; nearly all of the time is the reference's."""
    renderer = OpticsRenderer(OPTICS, FILM, seed=1)
    live = LiveReconstructor(OPTICS)
    full = [
        renderer.render_picture(pattern, 0.0).copy() for pattern in full_sequence(OPTICS.pattern)
    ]
    patterns = fringe_sequence(OPTICS.pattern)
    cycles = [
        [renderer.render_picture(pattern, d).copy() for pattern in patterns] for d in MOVED_UM
    ]
    times, still = 0.1 * np.arange(18), np.zeros(18)

    live.measure_full(full, times, still)  # compiles
    full_ms = _median_ms(lambda: live.measure_full(full, times, still), 3)
    copy_ms = _copy_ms(cycles[0])
    durations, errors = [], []
    for k in range(24):
        d = MOVED_UM[k % len(MOVED_UM)]
        begin = time.perf_counter()
        estimate = live.measure_fringes(cycles[k % len(cycles)], times[:8], np.full(8, d))
        durations.append(1e3 * (time.perf_counter() - begin))
        errors.append(_rms_um(live, estimate.coeffs_um, estimate.hencky_um, d))
    live_ms = statistics.median(durations[4:])
    reference_s, reference_um = _reference(live, cycles[3])
    terms_alone = f"{ZERNIKE_TERMS} terms alone"
    speed = 1e3 * reference_s / live_ms
    return [
        at_most("8 frames of 2448 x 2048 to figure with covariance", live_ms, "ms", 25),
        at_most("worst of 20 cycles", max(durations[4:]), "ms", 150),
        at_most(
            "cycle over copying its 8 frames", live_ms / copy_ms, "x", 3.5, "copy, ms", copy_ms
        ),
        at_least(
            "faster than the paper's method in NumPy", speed, "x", 500, "its time, s", reference_s
        ),
        at_most("full cycle, 18 frames", full_ms, "ms", 150),
        at_most("full cycle over copying 8 frames", full_ms / copy_ms, "x", 30),
        at_most(
            "error of the figure, RMS", 1e3 * max(errors), "nm", 10, terms_alone, 1e3 * reference_um
        ),
    ]


def _median_ms(action: Callable[[], object], times: int) -> float:
    durations = []
    for _ in range(times):
        begin = time.perf_counter()
        action()
        durations.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(durations)


def _copy_ms(frames: list[np.ndarray]) -> float:
    """Copying the frames into memory that is already there."""
    there = [np.empty_like(frame) for frame in frames]

    def copy() -> None:
        for target, frame in zip(there, frames, strict=True):
            np.copyto(target, frame)

    copy()
    return _median_ms(copy, 20)


def _rms_um(
    live: LiveReconstructor, coeffs_um: np.ndarray, hencky_um: float, displacement_um: float
) -> float:
    x, y, h = live.height_map(coeffs_um, hencky_um, 128)
    truth = FILM.height_mm(*np.meshgrid(x, y), displacement_um)
    return float(np.sqrt(np.nanmean((1e3 * (h - truth)) ** 2)))


def _reference(live: LiveReconstructor, frames: list[np.ndarray]) -> tuple[float, float]:
    """Seconds of the paper's method on the same 8 frames, and its error in µm.

    Fringe orders are those of the known film: the paper takes them from its Gray codes, whose time
    is left out.
    """
    geometry = Geometry.from_config(OPTICS)
    columns, rows = np.meshgrid(
        np.arange(OPTICS.camera.width_px), np.arange(OPTICS.camera.height_px)
    )
    rays = geometry.rays(columns.ravel(), rows.ravel())
    expected = _expected_screen(geometry, rays)
    inside = np.isfinite(expected[0])
    rays, expected = rays[:, inside], expected[:, inside]
    period = OPTICS.pattern.period_mm
    begin = time.perf_counter()
    wrapped = reference_pmd.wrapped_phases(frames).reshape(2, -1)[:, inside]
    # phi = 2 pi s / T - pi with s from the low edge; at O' that is pi (periods - 1)
    screen = (wrapped - np.pi * (OPTICS.pattern.periods - 1)) * period / (2 * np.pi)
    screen += period * np.rint((expected - screen) / period)
    coeffs = reference_pmd.reconstruct(geometry, rays, screen, OPTICS.mirror.radius_mm)
    seconds = time.perf_counter() - begin
    return seconds, _rms_um(live, 1e3 * coeffs, 0.0, 0.0)


def _expected_screen(geometry: Geometry, rays: np.ndarray) -> np.ndarray:
    """Screen points (2, n) of the true film at displacement 0; NaN outside the analysis radius."""
    # Rays that meet the plane z = 0 within the analysis radius
    pinhole = geometry.pinhole_mm
    reach = -pinhole[2] / rays[2]
    x = pinhole[0] + reach * rays[0]
    y = pinhole[1] + reach * rays[1]
    inside = np.hypot(x, y) < OPTICS.mirror.analysis_radius_mm
    rays = rays[:, inside]
    reach = reach[inside]
    # Where they meet the film, by fixed-point iteration
    for _ in range(6):
        x = pinhole[0] + reach * rays[0]
        y = pinhole[1] + reach * rays[1]
        reach = (FILM.height_mm(x, y, 0.0) - pinhole[2]) / rays[2]
    point = pinhole[:, None] + reach * rays
    # The film's normal, by central differences, and the reflected rays
    x, y, _ = point
    step = 0.1
    rise_x = FILM.height_mm(x + step, y, 0.0) - FILM.height_mm(x - step, y, 0.0)
    rise_y = FILM.height_mm(x, y + step, 0.0) - FILM.height_mm(x, y - step, 0.0)
    normal = np.stack([-rise_x / (2 * step), -rise_y / (2 * step), np.ones_like(rise_x)])
    projection = np.sum(rays * normal, axis=0) / np.sum(normal * normal, axis=0)
    reflected = rays - 2 * projection * normal
    # Where those meet the screen's plane
    screen_normal = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    from_origin = point - geometry.screen_origin_mm[:, None]
    from_origin = (
        from_origin - (screen_normal @ from_origin) / (screen_normal @ reflected) * reflected
    )
    screen = np.full((2, inside.size), np.nan)
    screen[0, inside] = geometry.screen_s_x @ from_origin
    screen[1, inside] = geometry.screen_s_y @ from_origin
    return screen
