"""Where the mirror stands: turned about its axis, and seated not quite as before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

USUAL_TURN_DEG, USUAL_SHIFT_MM, USUAL_RAISED_MM, USUAL_TILT_RAD = 0.2, 0.3, 0.1, 3e-4


@dataclass(frozen=True)
class Seat:
    """A rigid motion of the mirror; the laser still sees the film where it reads it.

    Attributes
    ----------
    angle_rad : float
        Turn about z, counter-clockwise for the camera.
    shift_mm : (float, float)
        Place of the mirror's axis.
    raised_mm : float
        Height of the ring over its usual height: the film is deeper by as much.
    tilt_rad : (float, float)
        Turns about x and y, about the film's centre.
    """

    angle_rad: float
    shift_mm: tuple[float, float] = (0.0, 0.0)
    raised_mm: float = 0.0
    tilt_rad: tuple[float, float] = (0.0, 0.0)

    def rotation(self) -> FloatArray:
        """Matrix (3, 3) from the mirror's axes to those of the world."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        cx, sx = np.cos(self.tilt_rad[0]), np.sin(self.tilt_rad[0])
        cy, sy = np.cos(self.tilt_rad[1]), np.sin(self.tilt_rad[1])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
        about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
        return np.asarray(about_x @ about_y @ turn)

    def places(self, film_mm: FloatArray, centre_z_mm: float) -> FloatArray:
        """Places (3, n) of points whose place is `film_mm` in the mirror that stands as usual."""
        centre = np.array([[0.0], [0.0], [centre_z_mm]])
        shift = np.array([[self.shift_mm[0]], [self.shift_mm[1]], [self.raised_mm]])
        return np.asarray(self.rotation() @ (film_mm - centre) + centre + shift)

    def unturned(self, xy: FloatArray) -> FloatArray:
        """Places (2, n) in the mirror's own axes, about."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        return np.stack([c * xy[0] + s * xy[1], c * xy[1] - s * xy[0]])


def drawn_seat(rng: np.random.Generator, angle_deg: float) -> Seat:
    """A mirror turned by hand about as stated."""
    turned_deg = angle_deg + USUAL_TURN_DEG * rng.standard_normal()
    shift = tuple((USUAL_SHIFT_MM * rng.standard_normal(2)).tolist())
    tilt = tuple((USUAL_TILT_RAD * rng.standard_normal(2)).tolist())
    raised_mm = USUAL_RAISED_MM * rng.standard_normal()
    return Seat(float(np.deg2rad(turned_deg)), shift, raised_mm, tilt)
