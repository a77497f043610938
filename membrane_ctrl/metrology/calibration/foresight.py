"""What sets that are still to be taken will determine: the covariance at the stated bench.

Rays are followed from a bowl at each depth to the screen, and the problem is solved from there,
linear and without noise. Its solution is the bowl itself, and its covariance is within a tenth of
that claimed by sets of a mounted film (docs/how-to/calibration.md). The bowl has the figure of a
film that is clamped by hand: a smooth one would claim a fifth more.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.calibration import set_state
from membrane_ctrl.metrology.calibration.figure_uncertainty import Propagated, propagate_to_figure
from membrane_ctrl.metrology.calibration.solver import Problem, solve_calibration
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.rays import bench_poses, forward_model, set_phases
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import (
    PARAMETERS,
    Surface,
)
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.model.arrays import FloatArray

_MOUNTED_MM = np.zeros(PARAMETERS)
_MOUNTED_MM[[3, 5, 7]] = (
    0.3,
    0.1,
    0.05,
)  # astigmatism, coma, trefoil; and 10 µm RMS over the terms above
_HIGHER = np.arange(9, PARAMETERS - 1)  # Noll 11 and all terms above
_MOUNTED_MM[_HIGHER] = 0.01 / np.sqrt(_HIGHER.size) * (-1.0) ** np.arange(_HIGHER.size)
# rays along the picture's longer side; twice as many change a claim by less than a fiftieth
_ACROSS = 48


def forecast_figure(
    optics: OpticsConfig,
    sigmas: FloatArray,
    sags_mm: Sequence[float],
    swing_adu: float,
    laser_sigma_um: float,
) -> Propagated:
    """Standard deviations of a figure that is measured with the geometry of sets at these sags.

    `sigmas` (len(NAMES),) are those of the hand's measurements, `swing_adu` is the amplitude of the
    fringes and `laser_sigma_um` that of a set's mean reading. Raises ValueError if no ray of such a
    set ends on the pattern.
    """
    geometry, middle_mm = Geometry.from_config(optics), sags_mm[len(sags_mm) // 2]
    sets = [
        _make_set(geometry, optics, sag_mm, sag_mm - middle_mm, swing_adu) for sag_mm in sags_mm
    ]
    references = set_state.References(0.0, laser_sigma_um)
    problem = Problem(geometry, tuple(sets), sigmas, references, optics.mirror.radius_mm)
    return propagate_to_figure(
        solve_calibration(problem), len(sets) // 2, optics.mirror.analysis_radius_mm
    )


def _make_set(
    geometry: Geometry, optics: OpticsConfig, sag_mm: float, moved_mm: float, swing_adu: float
) -> set_phases.SetPhases:
    """The rays of a coarse grid, each with the noise of the pixels that it stands for."""
    camera, mirror, pattern = optics.camera, optics.mirror, optics.pattern
    every_px = max(camera.width_px, camera.height_px) / _ACROSS
    phase_rad = phase_steps.phase_sigma_rad(
        phase_steps.equal_shifts(pattern.steps),
        slope_noise.pixel_sigma_adu(camera.noise_adu),
        swing_adu,
    )
    sigma_mm = phase_rad * screen_scale.mm_per_rad(pattern) / every_px
    column, row = _towards_mirror(geometry, optics, every_px, sag_mm)
    blind = f"at a sag of {sag_mm:.1f} mm the camera as stated sees no fringes in the mirror"
    if column.size == 0:
        raise ValueError(blind)
    dark = set_phases.SetPhases(
        f"{sag_mm:.2f} mm",
        column,
        row,
        np.zeros((2, column.size)),
        np.full(column.size, sigma_mm),
        1e3 * moved_mm,
    )
    bowl = Surface.hencky_bowl(sag_mm, mirror.radius_mm).parameters
    bench, surface = (
        bench_poses.BenchGeometry(geometry),
        Surface.from_parameters(bowl + _MOUNTED_MM, mirror.radius_mm),
    )
    points = forward_model.place_rays(bench, dark, surface, -moved_mm)
    x_mm, y_mm, _z = geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    screen_mm = -forward_model.residual_mm(bench, dark, surface, -moved_mm)
    inside = np.hypot(x_mm, y_mm) < mirror.analysis_radius_mm
    seen = inside & (np.abs(screen_mm) < pattern.periods * pattern.period_mm / 2).all(axis=0)
    if np.count_nonzero(seen) < PARAMETERS:
        raise ValueError(blind)
    return replace(dark, screen_mm=screen_mm).subset(seen)


def _towards_mirror(
    geometry: Geometry, optics: OpticsConfig, every_px: float, sag_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Columns and rows whose rays meet the plane half way up the bowl inside its ring; others may
    miss the film.
    """
    camera = optics.camera
    grid = np.meshgrid(
        np.arange(0, camera.width_px, every_px), np.arange(0, camera.height_px, every_px)
    )
    column, row = (axis.ravel() for axis in grid)
    rays = geometry.rays(column, row)
    x_mm, y_mm, _z = (
        geometry.pinhole_mm[:, None] + (sag_mm / 2 - geometry.pinhole_mm[2]) / rays[2] * rays
    )
    near = np.hypot(x_mm, y_mm) < optics.mirror.radius_mm
    return column[near], row[near]
