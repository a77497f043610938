"""When to calibrate again: the live fit's residual against that of the calibration, and the ring.

A wrong geometry bends the fringes as no surface can (a camera that rolls), or as one can (a camera
that turns): the ring, which cannot have tilted, shows the latter. Only what noise leaves is
compared: live cycles have other bins and light. One bad cycle is no drift (a door, a hand before
the screen); the median of many is.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.rim_harmonics import rim_harmonics
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.slope_noise import slope_per_screen
from membrane_ctrl.model.arrays import FloatArray

CYCLES = 60  # of which the median is taken: two minutes
# Residual over the expected one at which a warning begins (75 % of it in addition, added in
# squares), and ends.
GROWN = 1.25
FINE = 1.1
# Motion of the ring at which a warning begins (the required accuracy), and ends. A camera turned by
# 0.02 degrees moves the ring by 5.6 µm and bends the figure by 4 µm.
RING_MOVED_UM = 5.0
RING_BACK_UM = 3.0


def noise_urad(geometry: Geometry, surface: Surface, screen_sigma_mm: float) -> float:
    """RMS of the slopes that noise of the screen coordinates makes.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    surface : Surface
        Its depth sets how a screen point turns into a slope.
    screen_sigma_mm : float
        Standard deviation of each screen coordinate.

    Returns
    -------
    float
        RMS over both slopes, µrad.
    """
    gain = slope_per_screen(geometry, surface.radius_mm, surface.sag_mm)
    return 1e6 * screen_sigma_mm * float(np.sqrt(gain.sum() / 2))


@dataclass
class DriftMonitor:
    """Monitors the live residual; `[calibration]` of the geometry has both arguments, as
    `slope_...`.
    """

    calibrated_urad: float
    calibrated_noise_urad: float
    description: str = ""  # why it is time to calibrate again; empty while it is not
    _seen: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=CYCLES))

    def add(self, residual_urad: float, live_noise_urad: float) -> None:
        """Add one cycle, and renew `description` once there are `CYCLES`.

        Parameters
        ----------
        residual_urad : float
            Slopes that the cycle's fit leaves, RMS; a cycle without a figure (NaN) does not count.
        live_noise_urad : float
            The part of it that is noise of the camera.
        """
        if np.isfinite(residual_urad) and np.isfinite(live_noise_urad):
            self._seen.append((residual_urad, live_noise_urad))
        if len(self._seen) < CYCLES:
            return
        # The residual that the calibration predicts here: what its model left, and this camera's
        # noise.
        now_urad, live_urad = (float(v) for v in np.median(np.array(self._seen), axis=0))
        model_urad = np.sqrt(max(0.0, self.calibrated_urad**2 - self.calibrated_noise_urad**2))
        ratio = now_urad / float(np.hypot(model_urad, live_urad))
        if ratio < FINE:
            self.description = ""
        elif ratio > GROWN and not self.description:
            self.description = (
                f"calibrate again: the fit leaves {now_urad:.2f} µrad of slope, "
                f"the calibrated geometry predicts {now_urad / ratio:.2f}"
            )


def ring_um(surface: Surface) -> FloatArray:
    """Harmonics (14,) of the rim's height without its mean: cosines 1 to 7, then sines."""
    return np.asarray(1e3 * (rim_harmonics() @ surface.parameters)[1:])


@dataclass
class RingMonitor:
    """Monitors the ring's position in the live cycles against `ring_um` (14,) of the geometry's
    `[calibration]`.
    """

    calibrated_um: FloatArray
    description: str = ""  # as for `DriftMonitor`
    _seen: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=CYCLES))

    def add(self, surface: Surface) -> None:
        """Take one cycle's surface."""
        self._seen.append(ring_um(surface))
        if len(self._seen) < CYCLES:
            return
        change = np.median(np.array(self._seen), axis=0) - self.calibrated_um
        moved_um = float(np.sqrt(np.sum(change**2) / 2))  # RMS around the rim
        if moved_um < RING_BACK_UM:
            self.description = ""
        elif moved_um > RING_MOVED_UM and not self.description:
            self.description = (
                f"calibrate again: the ring is seen {moved_um:.1f} µm RMS from where it was when "
                "the geometry was calibrated; camera or screen has moved"
            )
