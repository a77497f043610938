"""A capture set's bins as screen points with their noise, for the calibration."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config import OpticsConfig
from membrane_ctrl.metrology.bins import BinGrid
from membrane_ctrl.metrology.calibrate.residuals import SetPhases
from membrane_ctrl.metrology.checked import Checked
from membrane_ctrl.metrology.covariance import pixel_sigma_adu
from membrane_ctrl.metrology.phase import phase_sigma_rad
from membrane_ctrl.metrology.unwrap import mm_per_rad


def phases_of(name: str, checked: Checked, optics: OpticsConfig) -> SetPhases:
    """The bins inside the analysis radius that the set's own fit kept.

    Parameters
    ----------
    optics : OpticsConfig
        Of the set: camera, pattern, and the stated geometry, which only chooses the bins and tells what averaging
        over a bin adds to a curved phase (some 1e-3 mm: no calibration changes it).
    """
    state, bin_px = checked.state, checked.binned.bin_px
    grid = BinGrid(checked.tracer.geometry, optics.camera, bin_px)
    scale = mm_per_rad(optics.pattern)
    phase = checked.phase_rad.reshape(2, -1)[:, state.index]
    swing = checked.view.swing_adu.reshape(2, -1)[:, state.index]
    pixel = pixel_sigma_adu(optics.camera.noise_adu)
    per_adu = [phase_sigma_rad(checked.stack.shifts_rad(used), pixel, 1.0) for used in checked.view.used]
    variance = np.mean(np.square(np.array(per_adu)[:, None] / swing), axis=0)
    return SetPhases(
        name=name,
        column_px=grid.column_px[state.index],
        row_px=grid.row_px[state.index],
        screen_mm=phase * scale - state.offset_mm,
        sigma_mm=np.sqrt(variance) * scale / bin_px,
        displacement_um=checked.stack.mean_reading_um,
    )
