"""The shape loop on the simulated bench, in virtual time, with shape estimates made from the truth
and noise.

`run()` gives the figures, `python -m benchmarks.control.shape_loop` prints them.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.config.schema import TwinConfig
from tests.studies.shape_loop import LOOP, ON_S, SHAPE, track


def run(duration_s: float = 600.0) -> dict[str, dict[str, float]]:
    """Movement of the true sag over the run (10 s means) with the laser drifting 2 µm/min, and the
    trim's noise.
    """
    figures = {}
    drifting = TwinConfig(laser_drift_um_per_min=2.0, start_error_um=0.0)
    for name, noise_um, enabled in (
        ("on, 0.1 µm", 0.1, True),
        ("on, 0.3 µm", 0.3, True),
        ("off", 0.1, False),
    ):
        shape = SHAPE.model_copy(update={"enabled": enabled})
        run_ = track(drifting, duration_s, noise_um, shape)
        means_um = (
            run_.true_um[run_.time_s >= ON_S].reshape(-1, round(10 * LOOP.rate_hz)).mean(axis=1)
        )
        still = track(TwinConfig(start_error_um=0.0), duration_s, noise_um, shape)
        figures[name] = {
            "sag_moved_um": float(np.ptp(means_um)),
            "trim_noise_um": float(still.trim_um[still.time_s > 0.4 * duration_s].std()),
            "true_std_um": float(still.true_um[still.time_s > 0.4 * duration_s].std()),
        }
    return figures


if __name__ == "__main__":
    for case, values in run().items():
        print(case, {key: round(value, 3) for key, value in values.items()})
