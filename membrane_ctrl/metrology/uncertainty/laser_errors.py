"""What the laser's noise, or its absence, leaves unknown: the vertex, and motion from x to y."""

import math

import numpy as np

from membrane_ctrl.metrology.figure.set_motion import X_TO_Y, motion_share
from membrane_ctrl.metrology.reconstruction import film_motion
from membrane_ctrl.model.arrays import FloatArray

# 1 sigma of the film's place without a laser, in a hold, or of a mirror at rest for minutes.
_UNKNOWN_UM = 20.0


def vertex_um(readings_um: FloatArray, laser_noise_um: float) -> float:
    """Return 1 sigma of the vertex' place.

    Parameters
    ----------
    readings_um : (n,) array
        The laser's readings at the frames; NaN without a laser.
    laser_noise_um : float
        Noise of a reading.
    """
    if not np.isfinite(readings_um).all():
        return _UNKNOWN_UM
    return laser_noise_um / math.sqrt(readings_um.size)


def left_by_laser_um(readings_um: FloatArray, within_um: float, laser_noise_um: float) -> float:
    """1 sigma of the motion from x to y that remains in the phases.

    Corrected motion leaves the laser's noise. Motion that is not corrected is at most what the
    laser measured, and hardly more than that of a film that moves so little from frame to frame.
    Without readings only the latter is known.

    Parameters
    ----------
    readings_um : (2 N,) array
        The laser's readings at the frames, x first; NaN without.
    within_um : float
        RMS motion among the frames of an axis.
    laser_noise_um : float
        Noise of a reading.
    """
    # Noise of the difference of two means of N readings: sigma sqrt(2 / N).
    noise_um = laser_noise_um * math.sqrt(4 / readings_um.size)
    if film_motion.is_worth_correcting(readings_um, laser_noise_um):
        return noise_um
    if not np.isfinite(readings_um).all():
        return X_TO_Y * within_um
    x_um, y_um = np.split(readings_um, 2)
    seen_um = float(np.subtract(x_um.mean(), y_um.mean()))
    share = motion_share(within_um, noise_um)
    return math.hypot(share * seen_um, math.sqrt(share) * noise_um)
