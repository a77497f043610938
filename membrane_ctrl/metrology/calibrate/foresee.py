"""What sets that are still to be taken will determine: the covariance at the stated bench, linear and without noise.

A Hencky bowl at each depth is followed to the screen, and the problem is solved from there; its solution is the bowl
itself, and its covariance is what sets like these claim: within a tenth of what those of a rippled film do
(docs/calibration.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config import OpticsConfig
from membrane_ctrl.metrology.calibrate.parameters import Bench
from membrane_ctrl.metrology.calibrate.propagate import Propagated, propagate
from membrane_ctrl.metrology.calibrate.residuals import SetPhases, place_rays, residual_mm
from membrane_ctrl.metrology.calibrate.separable import Witness
from membrane_ctrl.metrology.calibrate.solve import Problem, solve
from membrane_ctrl.metrology.covariance import pixel_sigma_adu
from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.metrology.phase import equal_shifts, phase_sigma_rad
from membrane_ctrl.metrology.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.unwrap import mm_per_rad

_ACROSS = 48  # rays along the picture's longer side; twice as many change no claim by a fiftieth

FloatArray = NDArray[np.float64]


def foresee(
    optics: OpticsConfig,
    sigmas: FloatArray,
    sags_mm: Sequence[float],
    swing_adu: float,
    laser_sigma_um: float,
) -> Propagated:
    """Standard deviations of a figure that is measured with the geometry of such sets.

    Parameters
    ----------
    optics : OpticsConfig
        The stated bench.
    sigmas : (len(NAMES),) array
        Of the hand's measurements; 0 holds a parameter.
    sags_mm : sequence of float
        Of the sets.
    swing_adu : float
        Amplitude of the fringes in the picture.
    laser_sigma_um : float
        Of a set's mean reading.

    Raises
    ------
    ValueError
        If no ray of such a set ends on the pattern.
    """
    geometry, middle_mm = Geometry.from_config(optics), sags_mm[len(sags_mm) // 2]
    sets = [_set(geometry, optics, sag_mm, sag_mm - middle_mm, swing_adu) for sag_mm in sags_mm]
    problem = Problem(geometry, tuple(sets), sigmas, Witness(0.0, laser_sigma_um), optics.mirror.radius_mm)
    return propagate(solve(problem), len(sets) // 2, optics.mirror.analysis_radius_mm)


def _set(geometry: Geometry, optics: OpticsConfig, sag_mm: float, moved_mm: float, swing_adu: float) -> SetPhases:
    """The rays of a coarse grid, each with the noise of the pixels that it stands for."""
    camera, mirror, pattern = optics.camera, optics.mirror, optics.pattern
    every_px = max(camera.width_px, camera.height_px) / _ACROSS
    phase_rad = phase_sigma_rad(equal_shifts(pattern.steps), pixel_sigma_adu(camera.noise_adu), swing_adu)
    sigma_mm = phase_rad * mm_per_rad(pattern) / every_px
    column, row = _towards_mirror(geometry, optics, every_px, sag_mm)
    blind = f"at a sag of {sag_mm:.1f} mm the camera as stated sees no fringes in the mirror"
    if column.size == 0:
        raise ValueError(blind)
    dark = SetPhases(
        f"{sag_mm:.2f} mm", column, row, np.zeros((2, column.size)), np.full(column.size, sigma_mm), 1e3 * moved_mm
    )
    bench, surface = Bench(geometry), Surface.hencky_bowl(sag_mm, mirror.radius_mm)
    points = place_rays(bench, dark, surface, -moved_mm)
    x_mm, y_mm, _z = geometry.pinhole_mm[:, None] + points.t_mm * points.rays
    screen_mm = -residual_mm(bench, dark, surface, -moved_mm)
    inside = np.hypot(x_mm, y_mm) < mirror.analysis_radius_mm
    seen = inside & (np.abs(screen_mm) < pattern.periods * pattern.period_mm / 2).all(axis=0)
    if np.count_nonzero(seen) < PARAMETERS:
        raise ValueError(blind)
    return SetPhases(
        dark.name, column[seen], row[seen], screen_mm[:, seen], dark.sigma_mm[seen], dark.displacement_um
    )


def _towards_mirror(
    geometry: Geometry, optics: OpticsConfig, every_px: float, sag_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Columns and rows whose rays meet the plane half way up the bowl inside its ring; others may miss the film."""
    camera = optics.camera
    grid = np.meshgrid(np.arange(0, camera.width_px, every_px), np.arange(0, camera.height_px, every_px))
    column, row = (axis.ravel() for axis in grid)
    rays = geometry.rays(column, row)
    x_mm, y_mm, _z = geometry.pinhole_mm[:, None] + (sag_mm / 2 - geometry.pinhole_mm[2]) / rays[2] * rays
    near = np.hypot(x_mm, y_mm) < optics.mirror.radius_mm
    return column[near], row[near]
