"""Forecast of what sets that are not taken yet will determine: the covariance at the stated bench.

Rays are traced from a bowl at each depth to the screen, and the problem is solved from there,
linear and without noise. Its solution is the bowl itself, and its covariance is within a tenth of
that of sets of a mounted film (docs/how-to/calibration.md). The bowl has the figure of a film that
is clamped by hand: a smooth one would give sigmas that differ by a fifth.
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
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.model.arrays import FloatArray

# Figure of a film that is clamped by hand: astigmatism, coma and trefoil, and 10 µm RMS over Noll
# 11 and all terms above.
_MOUNTED_MM = np.zeros(PARAMETERS)
_MOUNTED_MM[[3, 5, 7]] = (0.3, 0.1, 0.05)
_HIGHER = np.arange(9, PARAMETERS - 1)
_MOUNTED_MM[_HIGHER] = 0.01 / np.sqrt(_HIGHER.size) * (-1.0) ** np.arange(_HIGHER.size)
# Rays along the picture's longer side; twice as many change a sigma by less than a fiftieth.
_ACROSS = 48


def forecast_figure(
    optics: OpticsConfig,
    sigmas: FloatArray,
    sags_mm: Sequence[float],
    swing_adu: float,
    laser_sigma_um: float,
) -> Propagated:
    """Forecast the uncertainty of a figure that is measured with the geometry of such sets.

    Parameters
    ----------
    optics : OpticsConfig
        The stated bench.
    sigmas : (len(NAMES),) array
        Standard uncertainties of the hand measurements.
    sags_mm : sequence of float
        Sag of each set.
    swing_adu : float
        Amplitude of the fringes.
    laser_sigma_um : float
        Standard uncertainty of a set's mean laser reading.

    Returns
    -------
    Propagated

    Raises
    ------
    ValueError
        If no ray of such a set ends on the pattern.
    """
    geometry = Geometry.from_config(optics)
    middle = len(sags_mm) // 2
    sets = [
        _make_set(geometry, optics, sag_mm, sag_mm - sags_mm[middle], swing_adu)
        for sag_mm in sags_mm
    ]
    references = set_state.References(0.0, laser_sigma_um)
    problem = Problem(geometry, tuple(sets), sigmas, references, optics.mirror.radius_mm)
    solution = solve_calibration(problem)
    return propagate_to_figure(solution, middle, optics.mirror.analysis_radius_mm)


def _make_set(
    geometry: Geometry, optics: OpticsConfig, sag_mm: float, moved_mm: float, swing_adu: float
) -> set_phases.SetPhases:
    """The set of a bowl, as the rays of a coarse grid see it.

    Each ray has the noise of the pixels that it represents. `moved_mm` is the bowl's depth beyond
    that of the middle set. Raises ValueError if too few rays end on the pattern.
    """
    camera = optics.camera
    mirror = optics.mirror
    pattern = optics.pattern
    every_px = max(camera.width_px, camera.height_px) / _ACROSS
    phase_rad = phase_steps.phase_sigma_rad(
        phase_steps.equal_shifts(pattern.steps),
        slope_noise.pixel_sigma_adu(camera.noise_adu),
        swing_adu,
    )
    sigma_mm = phase_rad * screen_scale.mm_per_rad(pattern) / every_px
    column, row = _list_pixels(geometry, optics, every_px, sag_mm)
    no_fringes = f"at a sag of {sag_mm:.1f} mm the camera as stated sees no fringes in the mirror"
    if column.size == 0:
        raise ValueError(no_fringes)
    empty = set_phases.SetPhases(
        f"{sag_mm:.2f} mm",
        column,
        row,
        np.zeros((2, column.size)),
        np.full(column.size, sigma_mm),
        1e3 * moved_mm,
    )

    # Rays to the bowl, and on to the screen: the prediction is the negative residual of 0.
    bench = bench_poses.BenchGeometry(geometry)
    bowl_mm = Surface.hencky_bowl(sag_mm, mirror.radius_mm).parameters
    surface = Surface.from_parameters(bowl_mm + _MOUNTED_MM, mirror.radius_mm)
    points = forward_model.place_rays(bench, empty, surface, -moved_mm)
    x_mm, y_mm, _z = geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    screen_mm = -forward_model.residual_mm(bench, empty, surface, -moved_mm)

    # Those from inside the mirror to the pattern.
    half_side_mm = pattern.periods * pattern.period_mm / 2
    is_inside = np.hypot(x_mm, y_mm) < mirror.analysis_radius_mm
    is_seen = is_inside & (np.abs(screen_mm) < half_side_mm).all(axis=0)
    if np.count_nonzero(is_seen) < PARAMETERS:
        raise ValueError(no_fringes)
    return replace(empty, screen_mm=screen_mm).subset(is_seen)


def _list_pixels(
    geometry: Geometry, optics: OpticsConfig, every_px: float, sag_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Columns and rows (n,) of a grid whose rays may meet the film: those that meet the plane half
    way up the bowl inside its ring.
    """
    camera = optics.camera
    columns = np.arange(0, camera.width_px, every_px)
    rows = np.arange(0, camera.height_px, every_px)
    column, row = (axis.ravel() for axis in np.meshgrid(columns, rows))
    rays = geometry.rays(column, row)
    t_mm = (sag_mm / 2 - geometry.pinhole_mm[2]) / rays[2]
    x_mm, y_mm, _z = geometry.pinhole_mm[:, None] + t_mm * rays
    near = np.hypot(x_mm, y_mm) < optics.mirror.radius_mm
    return column[near], row[near]
