"""The film in a mirror that was turned about its axis and seated by hand."""

from dataclasses import asdict, dataclass, replace
from math import cos, radians, sin
from typing import Any

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.film_shape import MAX_FILM_TERMS, FilmShape
from membrane_ctrl.sim.optics.zernike_polynomials import zernike_polynomial

# What a hand leaves, 1 sigma.
_ANGLE_SIGMA_DEG = 0.2  # marks on the ring
_SHIFT_SIGMA_MM = 0.3  # stops for its edge
_RAISED_SIGMA_MM = 0.1  # its three feet
_TILT_SIGMA_RAD = 3e-4
_RINGS = 40  # rings of points at which the shifted film is fitted
_SPOKES = 80  # points of each


@dataclass(frozen=True, slots=True)
class MirrorSeat:
    """Place of the mirror, relative to its usual one.

    Attributes
    ----------
    angle_deg : float
        Turn about its axis, counter-clockwise as the camera sees the mirror.
    shift_mm : (float, float)
        Place of its axis along x and y.
    raised_mm : float
        Height of the ring towards the camera. The laser still finds the film's centre where it
        reads it, so the film is deeper by as much.
    tilt : (float, float)
        Slopes added along x and y.
    """

    angle_deg: float
    shift_mm: tuple[float, float] = (0.0, 0.0)
    raised_mm: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def drawn(cls, angle_deg: float, seed: int) -> "MirrorSeat":
        """Draw how a hand seats a mirror that it has turned.

        Parameters
        ----------
        angle_deg : float
            The intended turn, counter-clockwise as the camera sees the mirror.
        seed : int
            The same seed gives the same seat.
        """
        rng = np.random.default_rng((120, seed))
        shift_x, shift_y = (_SHIFT_SIGMA_MM * rng.standard_normal(2)).tolist()
        tilt_x, tilt_y = (_TILT_SIGMA_RAD * rng.standard_normal(2)).tolist()
        return cls(
            angle_deg + _ANGLE_SIGMA_DEG * float(rng.standard_normal()),
            (shift_x, shift_y),
            _RAISED_SIGMA_MM * float(rng.standard_normal()),
            (tilt_x, tilt_y),
        )

    def as_table(self) -> dict[str, Any]:
        """For the set's truth."""
        return asdict(self)


def turn_film(film: FilmShape, seat: MirrorSeat, displacement_um: float) -> FilmShape:
    """Return the film as the bench sees it in the turned mirror.

    The film is evaluated at points of the mirror's own frame. Its difference from the bowl that
    stands as usual is fitted with `MAX_FILM_TERMS` Zernike terms: nanometres are left.

    Raises ValueError for a film with ripples, wrinkles or bumps, which no such terms represent.

    Parameters
    ----------
    film : FilmShape
        In the mirror's own frame; without ripples, wrinkles and bumps.
    seat : MirrorSeat
        How the mirror was turned, shifted and tilted.
    displacement_um : float
        About which it is evaluated.
    """
    if film.ripples or film.wrinkles or film.bumps:
        raise ValueError("a turned mirror: only for a film without ripples, wrinkles and bumps")
    deeper = replace(film, sag_mm=film.sag_mm + seat.raised_mm)

    # Points of the unit disc: rings of equal area, spokes.
    ring_radii = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    angles = 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    rho, theta = np.meshgrid(ring_radii, angles)
    x = (rho * np.cos(theta)).ravel()
    y = (rho * np.sin(theta)).ravel()
    x_mm = film.radius_mm * x
    y_mm = film.radius_mm * y

    # The film there, in the mirror's own frame and tilted, and the bowl in its usual place.
    mirror_x_mm, mirror_y_mm = _in_mirror(seat, x_mm, y_mm)
    turned_mm = deeper.height_mm(mirror_x_mm, mirror_y_mm, displacement_um)
    turned_mm += seat.tilt[0] * x_mm + seat.tilt[1] * y_mm
    bowl_mm = replace(deeper, zernike_um=()).height_mm(x_mm, y_mm, displacement_um)

    # Their difference as Zernike terms.
    terms = [zernike_polynomial(row) for row in np.eye(MAX_FILM_TERMS)]
    design = np.stack([np.polynomial.polynomial.polyval2d(x, y, term) for term in terms], axis=1)
    coeffs_um = 1e3 * np.linalg.lstsq(design, turned_mm - bowl_mm, rcond=None)[0]
    return replace(deeper, zernike_um=tuple(coeffs_um.tolist()))


def _in_mirror(
    seat: MirrorSeat, x_mm: FloatArray, y_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Places of the bench in the axes of the turned mirror."""
    from_axis_x = x_mm - seat.shift_mm[0]
    from_axis_y = y_mm - seat.shift_mm[1]
    cosine = cos(radians(seat.angle_deg))
    sine = sin(radians(seat.angle_deg))
    return cosine * from_axis_x + sine * from_axis_y, cosine * from_axis_y - sine * from_axis_x
