"""How long a calibration takes from files to the geometry, in clock and CPU time.

A person waits for the clock time; on a busy machine only the CPU time can be compared.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from membrane_ctrl.calibration.calibrate_options import CalibrateOptions
from membrane_ctrl.calibration.sets import read_sets
from membrane_ctrl.calibration.stated_problem import problem_of
from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.metrology.calibration.solver import solve_calibration
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec
from tests.support.figures import Figure, at_most
from tests.support.peak_memory import peak_mb

STATED = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9, reference_displacement_um=0.0)


def run() -> list[Figure]:
    """Ten sets of a quarter of the resolution, and five full ones, read and solved."""
    rows = [*_time(4, 10, 10.0), *_time(1, 5, 60.0)]
    return [*rows, at_most("memory of the process", peak_mb(), "MB", 2000)]


def _time(shrink: int, count: int, limit_s: float) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        folders = [Path(folder) / f"{k}" for k in range(count)]
        camera = CameraConfig(
            width_px=2448 // shrink, height_px=2048 // shrink, pixel_um=3.45 * shrink
        )
        optics = OpticsConfig(geometry=STATED, camera=camera)
        film = typical_film(37.1, 500.0, 1)
        for k, path in enumerate(folders):
            motion = Motion(start_um=-4000.0 + 8000.0 * k / (count - 1))
            simulate_set(
                path, SimulationSpec(optics, film, motion=motion, laser_noise_um=1.0, seed=k)
            )
        seconds = processors = 0.0
        for _ in range(2):  # the first compiles
            begin, busy = time.perf_counter(), time.process_time()
            options = CalibrateOptions(folders, None, Path(), (), 1.0, False)
            solve_calibration(problem_of(read_sets(folders, None), {}, options))
            seconds, processors = time.perf_counter() - begin, time.process_time() - busy
    what = (
        f"{count} "
        f"{'full-resolution sets' if shrink == 1 else 'sets of a quarter of the resolution'}"
    )
    return [
        at_most(f"{what}, files to geometry", seconds, "s", limit_s),
        Figure(f"{what}, CPU time", processors, "s"),
    ]
