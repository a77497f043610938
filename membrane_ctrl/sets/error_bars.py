"""How well a measured height is known: noise of the pixels, and what is known of the geometry, without any trials.

Both are linear (`metrology.uncertainty`): a few dozen solutions of thinned points, 50 ms. The Monte Carlo of the
`uncertainty` command agrees within 10 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.calibration.geometry_spread_file import spread_of
from membrane_ctrl.metrology.covariance import parameter_covariance, pixel_sigma_adu, slope_per_screen
from membrane_ctrl.metrology.monte_carlo import TRIAL_POINTS, TrialBench
from membrane_ctrl.metrology.phase import phase_sigma_rad
from membrane_ctrl.metrology.surface import PARAMETERS, sag_gradient
from membrane_ctrl.metrology.uncertainty import HeightMap, geometry_covariance, geometry_jacobian
from membrane_ctrl.metrology.unwrap import mm_per_rad
from membrane_ctrl.sets.measurement import Measurement

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorBars:
    """Covariances (36, 36) in mm^2 of the fit's parameters.

    Attributes
    ----------
    noise : array
        From the pixels' noise, or the scatter of the slopes if that is larger.
    geometry : array
        From the geometry's spread; zeros if the poses are taken as exact.
    source : str
        Where that spread is stated.
    grid : HeightMap
        Where `maps_um` has its points.
    """

    noise: FloatArray
    geometry: FloatArray
    source: str
    grid: HeightMap

    @property
    def sag_um(self) -> tuple[float, float]:
        """1 sigma of the sag: noise, geometry."""
        gradient = sag_gradient()
        of_noise, of_geometry = (1e3 * float(np.sqrt(gradient @ c @ gradient)) for c in (self.noise, self.geometry))
        return of_noise, of_geometry

    def maps_um(self) -> tuple[FloatArray, FloatArray]:
        """1 sigma (n, n) of the height on `grid.axis_mm`: noise, geometry; NaN outside the analysis radius."""
        of_noise, of_geometry = (self.grid.picture(1e3 * self.grid.sigma(c)) for c in (self.noise, self.geometry))
        return of_noise, of_geometry


def error_bars(measurement: Measurement, geometry: Path | None) -> ErrorBars | None:
    """Error bars of a measurement; None if it has no figure.

    Parameters
    ----------
    geometry : Path, optional
        The file that the geometry is from, with its covariance.

    Raises
    ------
    InputError
        If that covariance is none, or of the other form of geometry.
    """
    full, checked, optics = measurement.full, measurement.checked, measurement.head.optics
    if full is None or checked is None:
        return None
    swing = full.quality.modulation_share * (2**optics.camera.bits - 1)
    pixel = pixel_sigma_adu(optics.camera.noise_adu)
    shifts = [checked.stack.shifts_rad(used) for used in checked.view.used]
    sigma_mm = mm_per_rad(optics.pattern) * np.array([phase_sigma_rad(d, pixel, swing) for d in shifts])
    gain = slope_per_screen(checked.tracer.geometry, full.surface.radius_mm, full.surface.sag_mm)
    spread, source = spread_of(optics.geometry, geometry)
    try:
        of_geometry = geometry_covariance(geometry_jacobian(_bench(measurement), spread), spread)
    except ArithmeticError:
        of_geometry, source = np.full((PARAMETERS, PARAMETERS), np.nan), f"{source}: too wide to be a spread"
    grid = HeightMap.over(optics.mirror.analysis_radius_mm, optics.mirror.radius_mm)
    return ErrorBars(parameter_covariance(full.fit, gain @ sigma_mm**2), of_geometry, source, grid)


def _bench(measurement: Measurement) -> TrialBench:
    """The bins' points on their surface."""
    checked = measurement.checked
    if checked is None:
        raise ValueError("a set without a figure has no error bars")
    row, column = np.divmod(checked.state.index, checked.phase_rad.shape[2])
    side, exact = checked.binned.bin_px, np.zeros((2, row.size))
    place_px = side * np.stack([column, row]) + (side - 1) / 2
    surface, points = checked.state.surface, checked.state.points
    return TrialBench.of_points(
        measurement.head.optics, checked.tracer, surface, points, place_px, exact, TRIAL_POINTS
    )
