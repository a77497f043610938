"""The geometry of a live cycle: which one it is, and whether it still fits what the cycles see."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.calibration.geometry_in_force import InForce
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.metrology.calibrate.drift import DriftMonitor, RingMonitor, noise_urad
from membrane_ctrl.metrology.covariance import pixel_sigma_adu
from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.metrology.phase import equal_shifts, phase_sigma_rad
from membrane_ctrl.metrology.surface import Surface
from membrane_ctrl.metrology.unwrap import mm_per_rad
from membrane_ctrl.tick import Event


def geometry_event(geometry: InForce) -> Event:
    """For the record of the run."""
    return {"kind": "geometry", **geometry.origin.table(), "message": geometry.note}


class LiveDrift:
    """Compares residual and ring of each cycle with the calibrated ones; without a calibration it says nothing.

    Parameters
    ----------
    geometry : InForce
        What the cycles measure with.
    bin_px : int
        Side of their bins.
    """

    def __init__(self, geometry: InForce, bin_px: int) -> None:
        optics = geometry.optics
        self._geometry, self._radius_mm = Geometry.from_config(optics), optics.mirror.radius_mm
        shifts = equal_shifts(optics.pattern.steps)
        sigma_rad = phase_sigma_rad(shifts, pixel_sigma_adu(optics.camera.noise_adu), 1.0)
        self._sigma_mm_adu = mm_per_rad(optics.pattern) * sigma_rad / bin_px  # over the modulation
        known = geometry.calibration
        self._monitors: tuple[DriftMonitor, RingMonitor] | None = None
        if known is not None:
            residual = DriftMonitor(known.slope_residual_urad, known.slope_noise_urad)
            self._monitors = residual, RingMonitor(np.array(known.ring_um))
        self._said = False

    def noise_urad(self, estimate: ShapeEstimate) -> float:
        """What the camera's noise is in a cycle's residual."""
        return noise_urad(
            self._geometry, self._surface(estimate), self._sigma_mm_adu / estimate.modulation_median_adu
        )

    def after(self, estimate: ShapeEstimate) -> Event | None:
        """A notice when it is time to calibrate again, and when it no longer is."""
        if self._monitors is None or estimate.verdict == "rejected":
            return None
        residual, ring = self._monitors
        residual.add(estimate.slope_residual_urad, self.noise_urad(estimate))
        ring.add(self._surface(estimate))
        says = ring.says or residual.says
        if bool(says) == self._said:
            return None
        self._said = not self._said
        kind = "maintenance" if self._said else "maintenance_over"
        return {"kind": kind, "name": "calibrate", "message": says or "the geometry fits again"}

    def _surface(self, estimate: ShapeEstimate) -> Surface:
        return Surface(estimate.coeffs_um / 1e3, estimate.hencky_um / 1e3, self._radius_mm)
