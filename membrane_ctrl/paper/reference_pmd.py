"""The paper's own equations from phase to slope (its equations 3 to 14), one scalar formula each.

They serve as a reference only: `measure` traces the rays of both axes together
(`metrology.rays`). Nothing here is shared with that code.

Frame: the vertex is the origin, x horizontal, y up, z out of the reflecting side. The camera's
pinhole F is at a (cos alpha, 0, sin alpha), the screen's centre O' at b (-cos alpha, 0, sin alpha);
the screen is perpendicular to O O'. `screen_mm` is O'A, positive where it grows away from the
camera.

Three places of the paper need a reading, and a ray trace decides between them:

- The slope tan(theta) of equation 12 is -dh/dx, if h is the height along z and phase counts as
  O'A does. `compute_slope` returns +dh/dx.
- The y axis "follows the same principle". Its projection, parallel to the yz plane, contains the
  camera at the height a sin(alpha), so that its angle is 90 degrees and a is a sin(alpha). The
  screen is inclined to that plane: each of its points stands at a height of its own, which
  follows from the x phase, and b is that height. With these two the equations are exact
  (`YReading.HEIGHT_OF_POINT`); the other readings are approximations.
- Equation 14 takes delta theta from two arccosines, which are never negative. The camera is on
  the same side of all normals in x, but not in y: the angles need signs, here those of
  `_signed_angle`.

With these readings all equations are exact for a known surface; the paper takes height
and normal from its last iteration.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from membrane_ctrl.model.arrays import FloatArray


class YReading(StrEnum):
    """What the distances and the angle of the y equations are."""

    HEIGHT_OF_POINT = "90 degrees, a sin(alpha), and the height of each point of the screen"
    HEIGHT_OF_CENTRE = "90 degrees, a sin(alpha) and b sin(alpha)"
    CHIEF_RAY = "90 degrees, a and b along the chief ray"


@dataclass(frozen=True, slots=True)
class PaperGeometry:
    """The three numbers that the paper measures, or those of a projection.

    Attributes
    ----------
    a_mm : float
        Distance from the vertex to the pinhole.
    b_mm : float or (n,) array
        Distance from the vertex to the screen's centre; in a projection, one for each point.
    alpha_rad : float
        Angle of either line above the mirror's plane.
    """

    a_mm: float
    b_mm: FloatArray | float
    alpha_rad: float

    @property
    def pinhole_mm(self) -> FloatArray:
        """F (3,)."""
        return self.a_mm * np.array([math.cos(self.alpha_rad), 0.0, math.sin(self.alpha_rad)])

    def project_onto_yz(self, screen_x_mm: FloatArray, reading: YReading) -> "PaperGeometry":
        """Return the bench as the equations of y see it.

        Parameters
        ----------
        screen_x_mm : (n,) array
            Where the points see the screen, along x.
        reading : YReading
            How the paper's text is read.
        """
        if reading is YReading.CHIEF_RAY:
            return PaperGeometry(self.a_mm, self.b_mm, math.pi / 2)
        sine = math.sin(self.alpha_rad)
        above_mm = self.b_mm * sine
        if reading is YReading.HEIGHT_OF_POINT:
            above_mm = above_mm - screen_x_mm * math.cos(self.alpha_rad)
        return PaperGeometry(self.a_mm * sine, above_mm, math.pi / 2)


@dataclass(frozen=True, slots=True)
class Reflection:
    """Unit vectors at points of the surface.

    Attributes
    ----------
    normal, incident, reflected : (n, 3) arrays
        The surface's normal, the ray towards the surface, and the one that leaves it.
    """

    normal: FloatArray
    incident: FloatArray
    reflected: FloatArray


def compute_slope(
    geometry: PaperGeometry,
    across_mm: FloatArray,
    height_mm: FloatArray,
    screen_mm: FloatArray,
    correction_rad: FloatArray | float = 0.0,
) -> FloatArray:
    """Slope (n,) of the surface in x: the paper's equations 3 to 13.

    Parameters
    ----------
    geometry : PaperGeometry
        a, b and alpha.
    across_mm : (n,) array
        x_0 of the points.
    height_mm : (n,) array
        h of the points.
    screen_mm : (n,) array
        O'A, which is T / (2 pi) times the phase (equation 3).
    correction_rad : (n,) array
        delta theta (equation 14).

    Returns
    -------
    (n,) array
        dh/dx.
    """
    path = _Path.of(geometry, across_mm, height_mm)
    # eq. 8: AE, the displacement by the slope
    tilted_mm = -screen_mm + path.level_mm
    # eq. 12, with the angle APE = 2 theta + delta theta
    turned_rad = np.arctan(
        tilted_mm
        * np.cos(path.off_axis_rad)
        / (path.reach_mm - tilted_mm * np.sin(path.off_axis_rad))
    )
    theta_rad = (turned_rad - correction_rad) / 2.0
    return np.asarray(-np.tan(theta_rad))


def predict_screen(
    geometry: PaperGeometry, across_mm: FloatArray, height_mm: FloatArray, slope: FloatArray
) -> FloatArray:
    """The point of the screen that a point of the mirror sees: the inverse of `compute_slope`
    (equation 11).

    Parameters
    ----------
    geometry : PaperGeometry
        The paper's a, b and alpha.
    across_mm, height_mm : (n,) arrays
        x_0 and h of the points.
    slope : (n,) array
        Slope of the mirror there.

    Returns
    -------
    (n,) array
        O'A, mm.
    """
    # Equation 11 gives AE from the angle 2 theta, equation 8 then O'A.
    path = _Path.of(geometry, across_mm, height_mm)
    tangent = np.tan(-2.0 * np.arctan(slope))
    tilted_mm = path.reach_mm * tangent
    tilted_mm /= tangent * np.sin(path.off_axis_rad) + np.cos(path.off_axis_rad)
    return np.asarray(path.level_mm - tilted_mm)


@dataclass(frozen=True, slots=True)
class _Path:
    """The path by a point of a level surface.

    Attributes
    ----------
    off_axis_rad : (n,) array
        alpha - mu: angle of the ray to the chief ray.
    level_mm : (n,) array
        O'E: what a level surface would show.
    reach_mm : (n,) array
        PE: from the point to there.
    """

    off_axis_rad: FloatArray
    level_mm: FloatArray
    reach_mm: FloatArray

    @classmethod
    def of(cls, geometry: PaperGeometry, across_mm: FloatArray, height_mm: FloatArray) -> "_Path":
        """Equations 4 to 7 and 13 of points at x_0 and h."""
        a_mm = geometry.a_mm
        b_mm = geometry.b_mm
        alpha = geometry.alpha_rad
        # eq. 5: mu, the ray's angle above the x axis
        mu = np.arctan2(a_mm * math.sin(alpha) - height_mm, a_mm * math.cos(alpha) - across_mm)
        # eq. 4 and 6: O'B and EB, displacements on the screen by the place and by the height of P
        place_mm = (a_mm + b_mm) * np.tan(alpha - mu)
        raised_mm = 2.0 * height_mm * np.cos(mu) / np.cos(alpha - mu)
        # eq. 13
        reach_mm = (
            height_mm * np.cos(2.0 * mu) / np.sin(mu)
            + (a_mm + b_mm) / np.cos(alpha - mu)
            - a_mm * math.sin(alpha) / np.sin(mu)
            - height_mm * np.sin(2.0 * mu) / (np.tan(math.pi / 2 - alpha + mu) * np.sin(mu))
        )
        return cls(alpha - mu, place_mm - raised_mm, reach_mm)


def compute_projection_correction(rays: Reflection, axis: int) -> FloatArray:
    """Compute delta theta of equation 14.

    Incident and reflected ray make the same angle with the normal. Projected onto a plane that the
    rays are skew to, they do not: delta theta is the difference.

    Parameters
    ----------
    rays : Reflection
        Unit vectors at n points of the last surface.
    axis : int
        0 projects onto the xz plane, 1 onto the yz plane.

    Returns
    -------
    (n,) array
        Angle of the arriving ray less that of the leaving one, rad.
    """
    # Normal and rays in the plane; the incident ray is turned round to leave the point.
    in_plane = [axis, 2]
    normal = rays.normal[:, in_plane]
    arriving_rad = _signed_angle(normal, -rays.incident[:, in_plane])
    leaving_rad = -_signed_angle(normal, rays.reflected[:, in_plane])
    return arriving_rad - leaving_rad


def _signed_angle(normal: FloatArray, ray: FloatArray) -> FloatArray:
    """Angle (n,) from a normal to a ray, both (n, 2), rad; positive towards the positive axis."""
    along = np.sum(normal * ray, axis=1)
    across = ray[:, 0] * normal[:, 1] - ray[:, 1] * normal[:, 0]
    return np.asarray(np.arctan2(across, along))


def compute_slopes(
    geometry: PaperGeometry,
    points_mm: FloatArray,
    screen_mm: FloatArray,
    rays: Reflection | None,
    reading: YReading = YReading.HEIGHT_OF_POINT,
    y_geometry: PaperGeometry | None = None,
) -> FloatArray:
    """Return the slopes in x and y of points that see the screen, by the paper's equations.

    Parameters
    ----------
    geometry : PaperGeometry
    points_mm : (3, n) array
        x, y and height of the points.
    screen_mm : (2, n) array
        What they see, in coordinates of the screen.
    rays : Reflection or None
        Rays for the correction of the projection; None: not corrected.
    reading : YReading
        How the y equations are read.
    y_geometry : PaperGeometry, optional
        Of the y equations, if it is not that of x: an error that acts in one axis only.

    Returns
    -------
    (2, n) array
    """
    x_mm, y_mm, height_mm = points_mm
    screen_x_mm, screen_y_mm = screen_mm
    correction_x_rad: FloatArray | float = 0.0
    correction_y_rad: FloatArray | float = 0.0
    if rays is not None:
        correction_x_rad = compute_projection_correction(rays, 0)
        correction_y_rad = compute_projection_correction(rays, 1)
    slope_x = compute_slope(geometry, x_mm, height_mm, screen_x_mm, correction_x_rad)

    # The y equations see the bench in the plane that the reading of the text means.
    upright = (y_geometry or geometry).project_onto_yz(screen_x_mm, reading)
    # O'A of the equations grows towards negative x; the screen's y coordinate grows with y.
    slope_y = compute_slope(upright, y_mm, height_mm, -screen_y_mm, correction_y_rad)
    return np.stack([slope_x, slope_y])
