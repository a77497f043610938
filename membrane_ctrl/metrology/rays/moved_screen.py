"""What is known of a screen that was moved for a set."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.bench_poses import SCREEN_MOVE
from membrane_ctrl.model.arrays import FloatArray

# Unknowns of a screen elsewhere: its move, by how much the film was deeper then, and deeper in x
# than in y.
MOVED = SCREEN_MOVE + 2
STILL_UM = 1e-3  # 1 sigma of the motion of a film that does not move


@dataclass(frozen=True)
class MovedScreen:
    """What is known, besides the fringes, of the same film seen with the screen put elsewhere.

    Attributes
    ----------
    shift_mm : tuple[float, float, float]
        Shift of the screen along s_x, s_y and towards the mirror.
    shift_sigma_mm : float
        Standard uncertainty of the shift's length.
    turn_sigma_deg : float
        Standard uncertainty of the shift's direction, and of the screen's turns.
    deeper_um : float
        Additional depth of the film then, according to the laser.
    motion_um : float
        Additional depth of the film in the x frames over the y frames.
    motion_sigma_um : float
    glass_sigma_mm : float
        Standard uncertainty of the glass over a screen that is seen directly.
    """

    shift_mm: tuple[float, float, float]
    shift_sigma_mm: float
    turn_sigma_deg: float
    deeper_um: float
    motion_um: float
    motion_sigma_um: float
    glass_sigma_mm: float = 0.0

    def make_prior(self, laser_sigma_um: float) -> FloatArray:
        """Values and sigmas (2, MOVED), mm and degrees, of the unknowns of a screen elsewhere.

        `laser_sigma_um` is the standard uncertainty of a set's mean laser reading.
        """
        film_mm = 1e-3 * np.array([self.deeper_um, self.motion_um])
        values = np.concatenate([self.shift_mm, np.zeros(3), film_mm])

        # The shift: a rail is as parallel to the screen's normal as the screen is to itself after
        # the move, so that the direction's error adds to the components across the shift.
        squares_mm2 = np.square(self.shift_mm)
        across_mm = np.sqrt(np.sum(squares_mm2) - squares_mm2) * np.radians(self.turn_sigma_deg)
        shift_sigmas_mm = np.hypot(self.shift_sigma_mm, across_mm)

        # The film: two laser readings, or the glass over a screen that is seen directly.
        deeper_sigma_mm = self.glass_sigma_mm or 1e-3 * np.sqrt(2) * laser_sigma_um
        motion_sigma_mm = 1e-3 * max(self.motion_sigma_um, STILL_UM)
        film_sigmas_mm = np.array([deeper_sigma_mm, motion_sigma_mm])
        turn_sigmas_deg = np.full(3, self.turn_sigma_deg)
        return np.stack(
            [values, np.concatenate([shift_sigmas_mm, turn_sigmas_deg, film_sigmas_mm])]
        )

    @classmethod
    def unknown_place(cls) -> "MovedScreen":
        """A screen that is seen directly: nothing is known of its place, and its pixels may lie
        behind some mm of glass.
        """
        return cls((0.0, 0.0, 0.0), 1e3, 1e2, 0.0, 0.0, 0.0, glass_sigma_mm=3.0)
