"""When to calibrate again: what the fit leaves now, against what it left when the geometry was calibrated.

A geometry that has become wrong bends the fringes in a way that no surface can explain: the slopes' residual grows.
One bad cycle is no drift (a door, a hand before the screen); the median of many is. A live cycle bins otherwise than
the sets of a calibration and sees other light, so that the camera's noise is taken out of the one residual and put
into the other: what is compared is the film and the geometry.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.metrology.covariance import slope_per_screen
from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.metrology.surface import Surface

CYCLES = 60  # two minutes of cycles
GROWN = 1.25  # times what is expected: 0.75 of it more, added in squares
FINE = 1.1  # times what is expected: a warning ends here


def noise_urad(geometry: Geometry, surface: Surface, screen_sigma_mm: float) -> float:
    """RMS of the slopes of points whose screen coordinates have this noise."""
    gain = slope_per_screen(geometry, surface.radius_mm, surface.sag_mm)
    return 1e6 * screen_sigma_mm * float(np.sqrt(gain.sum() / 2))


@dataclass
class DriftMonitor:
    """Watches the live residual.

    Parameters
    ----------
    calibrated_urad, calibrated_noise_urad : float
        `slope_residual_urad` and `slope_noise_urad` of the geometry's `[calibration]`.

    Attributes
    ----------
    says : str
        Why it is time to calibrate again; empty while it is not.
    """

    calibrated_urad: float
    calibrated_noise_urad: float
    says: str = ""
    _seen: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=CYCLES))

    def add(self, residual_urad: float, live_noise_urad: float) -> None:
        """Take one cycle's residual and the camera's share of it; cycles without a figure (NaN) do not count."""
        if np.isfinite(residual_urad) and np.isfinite(live_noise_urad):
            self._seen.append((residual_urad, live_noise_urad))
        if len(self._seen) < CYCLES:
            return
        now_urad, live_urad = (float(v) for v in np.median(np.array(self._seen), axis=0))
        model_urad = np.sqrt(max(0.0, self.calibrated_urad**2 - self.calibrated_noise_urad**2))
        ratio = now_urad / float(np.hypot(model_urad, live_urad))
        if ratio < FINE:
            self.says = ""
        elif ratio > GROWN and not self.says:
            self.says = (
                f"calibrate again: the fit leaves {now_urad:.2f} urad of slope, "
                f"the calibrated geometry promises {now_urad / ratio:.2f}"
            )
