"""A measurement as a Rerun recording: maps, coefficients, verdict, and the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from membrane_ctrl.sets.measurement import Measurement
from membrane_ctrl.sets.result_recording import log_pictures, result_recording


def log_measurement(path: Path, measurement: Measurement, pictures: Sequence[Path]) -> None:
    """Write a recording `path` (.rrd). Raises OSError if it cannot be written."""
    words = [f"verdict: {measurement.verdict} {measurement.reason}"]
    words += [f"{item['file']}: {item['reason']}" for item in measurement.flagged_files()]
    full = measurement.full
    with result_recording(path, "membrane_ctrl_measure") as recording:
        recording.log("measure/verdict", rr.TextDocument("\n".join(words)), static=True)
        if full is not None:
            coeffs_um = 1e3 * full.surface.coeffs_mm
            recording.log("measure/zernike_um", rr.BarChart(coeffs_um[1:], abscissa=np.arange(2, 37)), static=True)
            # row 0 of a picture is on top, that is at +y
            height = full.height_mm()[::-1].astype(np.float32)
            residual = (1e3 * full.residual_mm)[::-1].astype(np.float32)
            recording.log("measure/height_mm", rr.Tensor(height, dim_names=["y", "x"]), static=True)
            recording.log("measure/residual_um", rr.Tensor(residual, dim_names=["y", "x"]), static=True)
        log_pictures(recording, "measure/pictures", pictures)
