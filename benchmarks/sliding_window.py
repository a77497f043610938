"""The sliding window at full size: one new frame in memory to the figure with its covariance."""

from __future__ import annotations

import statistics
import time

import numpy as np

from benchmarks.figures import Figure, at_most
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.phase import fringe_sequence, full_sequence
from membrane_ctrl.metrology.sliding import SlidingWindow
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape

OPTICS = OpticsConfig()
FILM = FilmShape(37.1, 500.0, "hencky", (0, 0, 0, 0, 800, -500, 300, 0, 400, *[0] * 27))
FRAME_S, FRAMES, SHOWN = 0.1, 48, 8


def _where_um(time_s: float) -> float:
    """A swing of 5 um at 0.3 Hz."""
    return float(5 * np.sin(2 * np.pi * 0.3 * time_s))


def run() -> list[Figure]:
    """Time of a frame over some windows of a moving film, and the error of the figure in them."""
    renderer, window = OpticsRenderer(OPTICS, FILM, seed=1), SlidingWindow(OPTICS)
    full = [renderer.render(pattern, 0.0).copy() for pattern in full_sequence(OPTICS.pattern)]
    patterns = fringe_sequence(OPTICS.pattern)
    window.full(full, np.full(18, -FRAME_S), np.zeros(18))
    durations, errors = [], []
    for k in range(FRAMES):
        step, time_s = k % SHOWN, FRAME_S * k
        frame = renderer.render(patterns[step], _where_um(time_s)).copy()
        begin = time.perf_counter()
        estimate = window.frame(frame, step, time_s, _where_um(time_s))
        durations.append(1e3 * (time.perf_counter() - begin))
        if k >= SHOWN:
            x, y, h = window.height_map(estimate.coeffs_um, estimate.hencky_um, 96)
            truth = FILM.height_mm(*np.meshgrid(x, y), estimate.displacement_um)
            errors.append(1e3 * float(np.sqrt(np.nanmean((h - truth) ** 2))))
    return [
        at_most(
            "a new frame of 2448 x 2048 to figure with covariance", statistics.median(durations[SHOWN:]), "ms", 10
        ),
        at_most("worst of 40 frames", max(durations[SHOWN:]), "ms"),
        at_most("error of the figure, RMS, film swinging 5 um at 0.3 Hz", max(errors), "um", 0.5),
    ]
