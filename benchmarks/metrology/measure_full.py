"""The full measurement of a set at full size: every pixel, slopes, residual, zonal map; time,
memory, accuracy.
"""

from __future__ import annotations

import statistics
import time

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.pixel_figure import FullResult, measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.pattern_levels import pattern_sequence
from tests.support.figures import Figure, at_most
from tests.support.peak_memory import peak_mb

FILM = typical_film(37.1, 500.0, seed=1)


def run() -> list[Figure]:
    """All figures."""
    rows: list[Figure] = []
    for shrink in (4, 2, 1):  # cost must grow with the pixels, not faster
        result, seconds, peak_mb = _measured(shrink)
        millions = result.index.size / 1e6
        limit = 2.0 if shrink == 1 else None
        rows.append(at_most(f"{millions:.2f} M pixels, all stages", seconds, "s", limit))
        rows.append(at_most("... per million pixels", seconds / millions, "s"))
    rows.append(at_most("memory of the process", peak_mb, "MB", 1000))
    fit_um, map_um = _errors(result)
    rows.append(at_most("error of the fit, RMS, 0.4 ADU", 1e3 * fit_um, "nm", 10))
    rows.append(at_most("error of the zonal map, RMS", 1e3 * map_um, "nm", 100))
    return rows


def _measured(shrink: int) -> tuple[FullResult, float, float]:
    """Result, time of a run after one that compiles, and the process'
    largest memory so far in MB.
    """
    large = OpticsConfig().camera
    camera = large.model_copy(
        update={
            "width_px": large.width_px // shrink,
            "height_px": large.height_px // shrink,
            "pixel_um": large.pixel_um * shrink,
        }
    )
    optics = OpticsConfig(camera=camera)
    renderer = OpticsRenderer(optics, FILM, seed=1)
    shown = pattern_sequence("full", optics.pattern)
    frames = np.stack([renderer.render_picture(pattern, 0.0) for pattern in shown])
    stack = FrameStack(frames, tuple(shown), np.zeros(len(shown)), {})
    seconds = []
    for _ in range(3):  # one result at a time in memory
        begin = time.perf_counter()
        _measure(stack, optics)
        seconds.append(time.perf_counter() - begin)
    result = _measure(stack, optics)
    return result, statistics.median(seconds[1:]), peak_mb()


def _measure(stack: FrameStack, optics: OpticsConfig) -> FullResult:
    checked = check_set(stack, optics)
    return reconstruct_full(optics, checked, measure_pixels(optics, checked))


def _errors(result: FullResult) -> tuple[float, float]:
    """RMS error in µm of the fit and of the zonal map against the film itself."""
    x, y = np.meshgrid(result.grid.axis_mm, result.grid.axis_mm)
    seen = np.isfinite(result.residual_mm)
    truth = FILM.height_mm(x[seen], y[seen])
    fit = result.surface.height(x[seen], y[seen]) - truth
    zonal = result.height_mm()[seen] - truth
    return float(1e3 * np.std(fit)), float(1e3 * np.std(zonal))
