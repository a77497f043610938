"""Uncertainty and stability at full size: the paper's figures, and the cost of all its sets."""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.measure.measurement import Figures
from membrane_ctrl.metrology.phase.phase_steps import equal_shifts, phase_sigma_rad
from membrane_ctrl.metrology.phase.screen_scale import mm_per_rad
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction.slope_noise import pixel_sigma_adu, slope_per_screen
from membrane_ctrl.metrology.uncertainty.geometry_spread import PAPER_SPREAD
from membrane_ctrl.metrology.uncertainty.height_map import HeightMap
from membrane_ctrl.metrology.uncertainty.linear_covariance import linear_covariance
from membrane_ctrl.metrology.uncertainty.monte_carlo import run_trials, trial_covariance
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_run
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec
from tests.support.figures import Figure, at_most

OPTICS = OpticsConfig()
MEASURED, PAPERS_SETS, TRIALS = 5, 451, 100  # sets measured here, sets and trials of the paper
SLOW_UM_PER_S = 0.3  # the film's drift: 1.2 µm from set to set
GRID = HeightMap.over_disc(OPTICS.mirror.analysis_radius_mm, OPTICS.mirror.radius_mm)


def run() -> list[Figure]:
    """Full-size sets written to disk, read and measured as `stability` does, and their trials."""
    with tempfile.TemporaryDirectory() as folder:
        spec = SimulationSpec(
            OPTICS, typical_film(37.1, 500.0, 1), motion=Motion(drift_um_per_s=SLOW_UM_PER_S)
        )
        simulate_run(Path(folder), spec, MEASURED + 1)
        figures = Figures()
        second = figures.measure_folder(Path(folder) / "0001")  # reads the reference as well
        swing_adu = second.figure.quality.modulation_share * (2**OPTICS.camera.bits - 1)
        run_trials([second.make_trial_bench()], PAPER_SPREAD, 1, range(2))  # compiles
        begin = time.perf_counter()
        benches = [
            figures.measure_folder(Path(folder) / f"{k + 1:04d}").make_trial_bench()
            for k in range(MEASURED)
        ]
        set_s = (time.perf_counter() - begin) / MEASURED
    begin = time.perf_counter()
    trials = run_trials(benches, PAPER_SPREAD, 1, range(TRIALS))
    trials_s = (time.perf_counter() - begin) / MEASURED
    begin = time.perf_counter()
    linear = linear_covariance([benches[0]], PAPER_SPREAD)
    linear_ms = 1e3 * (time.perf_counter() - begin)
    whole_min = PAPERS_SETS * (set_s + trials_s) / 60
    return [
        at_most("a set of 8 frames, files to figure", set_s, "s"),
        at_most("100 trials of a set, one process", trials_s, "s"),
        at_most(f"451 sets x 100 trials, extrapolated from {MEASURED} sets", whole_min, "min"),
        at_most("linear covariance with the geometry's Jacobian", linear_ms, "ms", 25),
        *_papers(benches, trials, linear, swing_adu),
    ]


def _papers(
    benches: list[TrialBench], trials: np.ndarray, linear: np.ndarray, swing_adu: float
) -> list[Figure]:
    """The paper's figures beside ours (docs/measurements/uncertainty.md explains the
    differences)."""
    many = run_trials(benches[:1], PAPER_SPREAD, 2, range(1000))[:, 0]
    absolute = 1e3 * GRID.sigma(trial_covariance(many))
    pair = 1e3 * GRID.sigma(trial_covariance(trials[:, -1] - trials[:, 0]))
    by_hand = 1e3 * GRID.sigma(linear)
    return [
        Figure("mean RMSE of the height, 1000 trials", float(absolute.mean()), "um", "paper", 24.8),
        Figure("largest RMSE of the height", float(absolute.max()), "um", "paper, about", 50.0),
        Figure("mean RMSE of the change between two sets", float(pair.mean()), "um", "paper", 4.5),
        Figure(
            "the same, phase referred to one pixel",
            _one_pixel_um(benches[0].surface.sag_mm, swing_adu),
            "um",
            "paper",
            4.5,
        ),
        Figure(
            "linear covariance, mean 1 sigma",
            float(by_hand.mean()),
            "um",
            "trials",
            float(absolute.mean()),
        ),
    ]


def _one_pixel_um(sag_mm: float, swing_adu: float) -> float:
    """Mean RMSE of a pair if both phases are counted from one pixel at O'.

    Its noise then shifts the whole phase map: a tilt of the mirror about its vertex, sigma r at
    radius r, with r on average 2/3 of the radius; sqrt(2) for two sets.
    """
    sigma = pixel_sigma_adu(OPTICS.camera.noise_adu)
    shift_mm = mm_per_rad(OPTICS.pattern) * phase_sigma_rad(
        equal_shifts(OPTICS.pattern.steps), sigma, swing_adu
    )
    gain = slope_per_screen(Geometry.from_config(OPTICS), OPTICS.mirror.radius_mm, sag_mm)
    slope = shift_mm * math.sqrt(float(gain.sum()) / 2)
    return 1e3 * math.sqrt(2) * slope * OPTICS.mirror.analysis_radius_mm * 2 / 3
