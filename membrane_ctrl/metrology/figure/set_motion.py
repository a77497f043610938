"""The film's motion during a set, by laser and fringes, and the phase steps corrected for it."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import (
    phase_change,
)
from membrane_ctrl.metrology.reconstruction import film_motion
from membrane_ctrl.model.arrays import FloatArray

LASER_NOISE_UM = 1.0  # repeatability of the bench's laser
# standard deviation of the film's place: less is hardly seen, and leaves 0.06 µm in the figure
_STILL_UM = 0.2
SEEN_BY_LASER = 2.0  # sigmas beyond which the laser's reading of a motion counts by itself
# motion from x to y over its RMS among the frames of an axis: 3.3 for a random walk, 7.2 for a
# drift, of four steps
X_TO_Y = 5.0


def motion_share(within_um: float, noise_um: float) -> float:
    """Share of what a laser tells of the motion from x to y that is motion, if it is so large
    within an axis.
    """
    return (X_TO_Y * within_um) ** 2 / ((X_TO_Y * within_um) ** 2 + noise_um**2)


@dataclass(frozen=True)
class FilmMotion:
    """Motion of the film during a set, from laser and fringes.

    Attributes
    ----------
    told_um : two (N,) arrays
        Displacement at the used sinusoids of x and of y, about the mean of both.
    x_to_y_sigma_um : float
        Standard uncertainty of the mean of x less that of y; NaN without a laser.
    noise_um : float
        Standard uncertainty of the fringes' part in each of these displacements.
    """

    told_um: tuple[FloatArray, FloatArray]
    x_to_y_sigma_um: float
    noise_um: float

    @classmethod
    def of(cls, checked: Checked) -> "FilmMotion":
        """Of a checked set.

        The fringes see the motion from frame to frame of one axis, to a tenth of a micrometre,
        where the laser's noise is one. Of a difference between the axes they make a figure: there
        the laser counts, as far as a film that moves so much from frame to frame moves from one
        axis to the other. What the fringes tell is in part
        noise: only what their scatter has beyond it is motion.
        """
        x, y = checked.view.used
        seen = [axis - axis.mean() for axis in np.split(checked.film_um, [len(x)])]
        within_um2 = float(np.var(np.concatenate(seen)))
        noise_um2 = checked.film_noise_um**2 * (
            1 - 2 / (len(x) + len(y))
        )  # the means of both axes are taken off
        moving = max(1 - noise_um2 / max(within_um2, 1e-12), 0.0)
        readings_um, laser_um = (
            checked.stack.displacement_um,
            LASER_NOISE_UM * math.sqrt(1 / len(x) + 1 / len(y)),
        )
        x_to_y_um = float(readings_um[x].mean() - readings_um[y].mean())
        least, most = (
            motion_share(math.sqrt(part * within_um2), laser_um) for part in (moving, 1.0)
        )
        # A film that rests within both axes may still step between them. Beyond 2 sigma of the
        # laser that step is measured, however little the film moves from frame to frame.
        beyond_noise = 1 - (SEEN_BY_LASER * laser_um) ** 2 / max(x_to_y_um**2, 1e-12)
        if beyond_noise > 0:
            most = 1.0
        share = max(least, beyond_noise)
        # the figure is that of all readings' mean, also where a frame is left out
        about_um = readings_um[[*x, *y]].mean() - checked.stack.mean_reading_um
        parts = np.nan_to_num(
            about_um + share * x_to_y_um * np.array([len(y), -len(x)]) / (len(x) + len(y))
        )
        told_um = (moving * seen[0] + parts[0], moving * seen[1] + parts[1])
        sigma_um = math.hypot(math.sqrt(most) * laser_um, (most - share) * x_to_y_um)
        return cls(told_um, sigma_um, checked.film_noise_um)

    @property
    def moved_um(self) -> float:
        """RMS motion."""
        return float(np.std(np.concatenate(self.told_um)))

    @property
    def worth_correcting(self) -> bool:
        """Whether the film moved."""
        return self.moved_um > _STILL_UM


def combine_axis_steps(
    checked: Checked, axis: int, motion_um: FloatArray | None
) -> phase_change.StepCombination:
    """How the means of the usable frames of an axis combine, whose film moved so."""
    used = checked.view.used[axis]
    shifts = checked.stack.shifts_rad(used)
    return film_motion.combine_steps(checked.stack.weights(used), shifts, 1, motion_um)
