"""What the laser's noise, or its absence, leaves unknown: the vertex, and motion from x to y."""

import math

import numpy as np

from membrane_ctrl.metrology.figure.set_motion import (
    X_TO_Y,
    motion_share,
)
from membrane_ctrl.metrology.reconstruction import film_motion
from membrane_ctrl.model.arrays import FloatArray

# of the film's place without a laser: a hold, or a mirror left alone for minutes
_UNKNOWN_UM = 20.0


def vertex_um(readings_um: FloatArray, laser_noise_um: float) -> float:
    """1 sigma of the vertex' place from the laser's noise, or without a laser."""
    known = np.isfinite(readings_um).all()
    return laser_noise_um / math.sqrt(readings_um.size) if known else _UNKNOWN_UM


def left_by_laser_um(readings_um: FloatArray, within_um: float, laser_noise_um: float) -> float:
    """Motion from x to y that is left in the phases, with `within_um` RMS among the frames of an
    axis.

    Corrected motion leaves the laser's noise. What is not corrected is at most what the laser saw,
    and hardly more than a film does that moves so little from frame to frame. Without readings that
    is all that is known.
    """
    noise_um = laser_noise_um * math.sqrt(4 / readings_um.size)
    if film_motion.worth_correcting(readings_um, laser_noise_um):
        return noise_um
    if not np.isfinite(readings_um).all():
        return X_TO_Y * within_um
    seen_um = float(np.subtract(*(part.mean() for part in np.split(readings_um, 2))))
    share = motion_share(within_um, noise_um)
    return math.hypot(share * seen_um, math.sqrt(share) * noise_um)
