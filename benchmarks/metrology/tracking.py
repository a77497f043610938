"""Tracking at full size: figures per second of one core, and the error against the frames' own
bound.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.measure.measurement import Figures
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.scene_from_reference import make_scene
from membrane_ctrl.metrology.tracking.tracker import Tracker
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import SimulationSpec
from tests.support.figures import Figure, at_least, at_most

OPTICS = OpticsConfig()
FILM = typical_film(37.1, 500.0, seed=1)
STEPS = np.array([(2 * math.pi * k / 5, 4 * math.pi * k / 5) for k in range(5)])
FRAMES = 24


def run() -> list[Figure]:
    """All figures, of the twin's frames in memory; the film moves by tenths of a micrometre."""
    with tempfile.TemporaryDirectory() as folder:
        simulate_set(Path(folder) / "full", SimulationSpec(OPTICS, FILM))
        reference = Figures().measure_folder(Path(folder) / "full")
    scene = make_scene(reference.head.optics, reference.checked, reference.figure, 12.455)
    camera = OPTICS.camera
    tracker = Tracker(scene, (camera.height_px, camera.width_px), 255, camera.noise_adu)
    renderer = OpticsRenderer(OPTICS, FILM, seed=2)
    shown = [Pattern("crossed", "", 32, float(x), shift_y_rad=float(y)) for x, y in STEPS]
    tracker.measure_steps(
        [renderer.render_picture(p, 0.0) for p in shown],
        STEPS,
        np.arange(5) / 20,
        np.full(5, math.nan),
    )
    moved_um = 0.2 * np.sin(np.arange(FRAMES))
    frames = [renderer.render_picture(shown[0], float(um)) for um in moved_um]
    tracker.track_frame(renderer.render_picture(shown[0], 0.0), (0.0, 0.0), 0.5)
    begin, busy = time.perf_counter(), time.process_time()
    found = [tracker.track_frame(frame, (0.0, 0.0), 1 + k / 20) for k, frame in enumerate(frames)]
    passed_s, busy_s = time.perf_counter() - begin, time.process_time() - busy
    coeffs = np.array([f.coeffs_um[1:] for f in found])
    bowl = Surface.hencky_bowl(1.0, FILM.radius_mm).coeffs_mm[1:]
    error_um = coeffs - np.outer(moved_um, bowl)
    noise_um = float(np.sqrt(np.mean(np.var(error_um[:, 2:], axis=0, ddof=1)) * (PARAMETERS - 3)))
    bound_um = _bound_um(scene, camera.noise_adu)
    sigma = np.array([f.sigma_um[3:] for f in found]).mean(axis=0)
    ratio = float(np.mean(error_um[:, 2:].std(axis=0, ddof=1) / sigma))
    rate, by_clock = FRAMES / busy_s, FRAMES / passed_s
    name = f"noise of terms 4 to {ZERNIKE_TERMS}, RMS"
    return [
        at_least(
            "figures of 2448 x 2048 per second of one core",
            rate,
            "1/s",
            50,
            "by the clock",
            by_clock,
        ),
        at_most(name, 1e3 * noise_um, "nm", 1.3e3 * bound_um, "bound", 1e3 * bound_um),
        at_most("error / sigma, mean of the terms", ratio, "", 1.3),
    ]


def _bound_um(scene: CrossedScene, noise_adu: float) -> float:
    """The least RMS error of the terms from 4 that frames of this noise allow, their light
    refitted.
    """
    once = scene.taper > 0  # the others repeat a bin
    # The light of a bin is level + swing_x cos(phase_x) + swing_y cos(phase_y)
    phases = scene.phase_rad(scene.surface)
    jacobian = scene.jacobian(scene.surface)
    level, swing_x, swing_y = scene.light_adu
    cos_x, cos_y = np.cos(phases)
    sin_x, sin_y = np.sin(phases)
    # Its derivatives by the surface, and by the slowly varying light
    by_shape: FloatArray = -swing_x * sin_x * jacobian[0] - swing_y * sin_y * jacobian[1]
    waves = (level, swing_x * cos_x, swing_y * cos_y)
    by_light = [scene.basis * wave for wave in waves]
    columns = np.concatenate([by_shape, *by_light])[:, once]
    # The Cramér-Rao bound
    sigma_adu = math.hypot(noise_adu, math.sqrt(1 / 12)) / scene.bin_px
    covariance = sigma_adu**2 * np.linalg.inv(columns @ columns.T)
    of_terms = covariance[2 : PARAMETERS - 1, 2 : PARAMETERS - 1]
    return 1e3 * float(np.sqrt(np.trace(of_terms)))
