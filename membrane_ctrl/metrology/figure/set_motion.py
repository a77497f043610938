"""The film's motion during a set, by laser and fringes, and the phase steps corrected for it."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import phase_change
from membrane_ctrl.metrology.reconstruction import film_motion
from membrane_ctrl.model.arrays import FloatArray

LASER_NOISE_UM = 1.0  # repeatability of the bench's laser
# RMS motion that is corrected: less is hardly seen, and leaves 0.06 µm in the figure.
_STILL_UM = 0.2
SEEN_BY_LASER = 2.0  # sigmas beyond which the laser's reading of a motion counts by itself
# Expected motion from x to y over the RMS motion among the frames of an axis. Of four steps it is
# 3.3 for a random walk and 7.2 for a drift.
X_TO_Y = 5.0


def motion_share(within_um: float, noise_um: float) -> float:
    """Return the share of the laser's reading of the motion from x to y that is motion; the rest is
    noise.

    Parameters
    ----------
    within_um : float
        RMS motion within an axis.
    noise_um : float
        Noise of the reading.

    Returns
    -------
    float
        From 0 to 1: a Wiener filter whose expected motion is `X_TO_Y` times that within an axis.
    """
    expected_um2 = (X_TO_Y * within_um) ** 2
    return expected_um2 / (expected_um2 + noise_um**2)


@dataclass(frozen=True)
class FilmMotion:
    """Motion of the film during a set, from laser and fringes.

    Attributes
    ----------
    motion_um : two (N,) arrays
        Displacement at the used sinusoids of x and of y, about the mean of both; phases are
        corrected for it.
    x_to_y_sigma_um : float
        Standard uncertainty of the mean of x less that of y; NaN without a laser.
    noise_um : float
        Standard uncertainty of the fringes' part in each of these displacements.
    """

    motion_um: tuple[FloatArray, FloatArray]
    x_to_y_sigma_um: float
    noise_um: float

    @classmethod
    def from_set(cls, checked: Checked) -> "FilmMotion":
        """The motion during a checked set.

        The fringes show the motion from frame to frame of one axis to 0.1 µm, where the laser's
        noise is 1 µm. A difference between the axes becomes a figure to the fringes: there the
        laser counts, to the extent to which a film that moves so much from frame to frame moves
        from one axis to the other. The fringes' positions are partly noise: only the scatter beyond
        it is motion.
        """
        x, y = checked.view.used
        frames = len(x) + len(y)

        # Motion within the axes, and the share of its square that is not noise. The means of both
        # axes are removed: two degrees of freedom less.
        within_x_um, within_y_um = (
            part - part.mean() for part in np.split(checked.film_um, [len(x)])
        )
        within_um2 = float(np.var(np.concatenate([within_x_um, within_y_um])))
        noise_um2 = checked.film_noise_um**2 * (1 - 2 / frames)
        moving = max(1 - noise_um2 / max(within_um2, 1e-12), 0.0)

        # Motion from x to y according to the laser, and the least and the largest share of it that
        # may be motion.
        readings_um = checked.stack.displacement_um
        x_to_y_um = float(readings_um[x].mean() - readings_um[y].mean())
        laser_um = LASER_NOISE_UM * math.sqrt(1 / len(x) + 1 / len(y))
        least = motion_share(math.sqrt(moving * within_um2), laser_um)
        most = motion_share(math.sqrt(within_um2), laser_um)

        # A film at rest within both axes may still step between them. Beyond 2 sigma of the laser
        # that step is measured, however little the film moves from frame to frame.
        beyond_noise = 1 - (SEEN_BY_LASER * laser_um) ** 2 / max(x_to_y_um**2, 1e-12)
        if beyond_noise > 0:
            most = 1.0
        share = max(least, beyond_noise)

        # The displacement of each axis. The figure belongs to the mean of all readings, also where
        # a frame is left out.
        about_um = readings_um[[*x, *y]].mean() - checked.stack.mean_reading_um
        side_of_axis = np.array([len(y), -len(x)]) / frames
        mean_x_um, mean_y_um = np.nan_to_num(about_um + share * x_to_y_um * side_of_axis)
        motion_um = (moving * within_x_um + mean_x_um, moving * within_y_um + mean_y_um)

        # Its uncertainty: the laser's noise in the largest share, and the difference of the shares.
        sigma_um = math.hypot(math.sqrt(most) * laser_um, (most - share) * x_to_y_um)
        return cls(motion_um, sigma_um, checked.film_noise_um)

    @property
    def moved_um(self) -> float:
        """RMS motion."""
        return float(np.std(np.concatenate(self.motion_um)))

    @property
    def is_worth_correcting(self) -> bool:
        """Whether the film moved."""
        return self.moved_um > _STILL_UM


def combine_axis_steps(
    checked: Checked, axis: int, motion_um: FloatArray | None
) -> phase_change.StepCombination:
    """Combination of the phase steps of an axis, for means over pixels instead of sums.

    Parameters
    ----------
    checked : Checked
        The set, whose usable frames are combined.
    axis : int
        0 for x, 1 for y.
    motion_um : (N,) array or None
        Displacement of the film at these frames; None: it is not corrected.
    """
    used = checked.view.used[axis]
    shifts = checked.stack.shifts_rad(used)
    return film_motion.combine_steps(checked.stack.weights(used), shifts, 1, motion_um)
