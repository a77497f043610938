"""When to calibrate again: what the fit leaves now, against what it left when the geometry was calibrated.

A geometry that has become wrong bends the fringes in a way that no surface can explain: the slopes' residual grows.
One bad cycle is no drift (a door, a hand before the screen); the median of many is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

CYCLES = 60  # two minutes of cycles
GROWN = 1.25  # times the calibrated residual: 0.75 of it more, added in squares


@dataclass
class DriftMonitor:
    """Watches the live residual.

    Parameters
    ----------
    calibrated_urad : float
        `slope_residual_urad` of the geometry's `[calibration]`.
    """

    calibrated_urad: float
    _seen: deque[float] = field(default_factory=lambda: deque(maxlen=CYCLES))

    def add(self, slope_residual_urad: float) -> str:
        """Take one cycle's residual; returns why it is time to calibrate again, or nothing."""
        if np.isfinite(slope_residual_urad):
            self._seen.append(slope_residual_urad)
        if len(self._seen) < CYCLES:
            return ""
        now = float(np.median(self._seen))
        if now < GROWN * self.calibrated_urad:
            return ""
        return (
            f"calibrate again: the fit leaves {now:.2f} urad of slope, when the geometry was calibrated "
            f"it left {self.calibrated_urad:.2f}"
        )
