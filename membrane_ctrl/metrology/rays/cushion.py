"""A cushion: a mirror behind a clear film that bulges towards the camera, with gas between them.

World: z points from the mirror to the camera. The mirror is a bowl; the front film is a bowl upside
down above it. A surface z = f(x, y) has the normal N = (-f_x, -f_y, 1). A ray is a point p and a
unit vector d:

    where they meet: z - f(x, y) = 0 at p + t d, by Newton's steps                          (1)
        t -= (z - f) / (d_z - f_x d_x - f_y d_y)
    mirror: d' = d - 2 (d N) N / (N N)                                                      (2)
    Snell, with N N = 1: n' d' = w + sign(a) sqrt(n'^2 - w w) N,  w = n d - a N,  a = n (d N)   (3)

In (3) w is the part of n d along the face, which is the same on both sides. The film is a sheet of
even thickness T: a ray crosses it within T / |d N| and leaves by a face whose normal is that of the
place beside, so that a curved film is a weak lens although its faces are parallel.

The film also reflects: the camera sees the screen a second time in its outside, and a third time by
mirror, film and mirror. With the reflectance of a face R1 = ((n - 1) / (n + 1))^2 both faces have

    R = 2 R1 / (1 + R1)                                                                     (4)

Derivation: section 13 of docs/explanation/metrology.md.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.optics import MirrorConfig
from membrane_ctrl.metrology.rays.gas_index import compute_gas_excess
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray

_NEWTON_STEPS = 7  # from a plane half the bulge away to rounding
# Errors of form of the front film, in the order of `Cushion.errors`: height of its vertex by a
# deeper bowl in mm, slopes along x and y in mrad, saddles x^2 - y^2 and 2 x y in mm on the rim, and
# height of the whole film in mm: another law of the film has another curvature at the same bulge.
FRONT_ERRORS = 6


@dataclass(frozen=True)
class Cushion:
    """The front film and its gas.

    Attributes
    ----------
    radius_mm : float
        Radius of both rims.
    sag_mm : float
        Depth of the mirror at which the film bulges as stated.
    bulge_mm : float
        Height of the film's vertex above its rim.
    rim_gap_mm : float
        Height of its rim above the mirror's.
    thickness_mm, film_index : float
        Of the film.
    gas_excess : float
        Index of the gas inside less that of the air.
    errors : (FRONT_ERRORS,) tuple
        Errors of form, 0 for the stated film.
    """

    radius_mm: float
    sag_mm: float
    bulge_mm: float
    rim_gap_mm: float
    thickness_mm: float
    film_index: float
    gas_excess: float
    errors: tuple[float, ...] = (0.0,) * FRONT_ERRORS

    @classmethod
    def from_config(cls, mirror: MirrorConfig) -> "Cushion | None":
        """The cushion of a configuration; None for a single film."""
        front = mirror.front_film
        if front is None:
            return None
        return cls(
            radius_mm=mirror.radius_mm,
            sag_mm=mirror.sag_mm,
            bulge_mm=front.bulge_mm,
            rim_gap_mm=front.rim_gap_mm,
            thickness_mm=1e-3 * front.thickness_um,
            film_index=front.index,
            gas_excess=compute_gas_excess(front, mirror.pressure_pa),
        )

    @property
    def reflectance(self) -> float:
        """Of the film's two faces together, at right angles, without interference: (4)."""
        of_face = ((self.film_index - 1) / (self.film_index + 1)) ** 2
        return 2 * of_face / (1 + of_face)

    def front_height(self, rim_z_mm: float, place: FloatArray) -> tuple[FloatArray, ...]:
        """The film's outer face: a Hencky bowl upside down, with its errors of form.

        Parameters
        ----------
        rim_z_mm : float
            World z of the mirror's rim.
        place : (2, n) array
            x and y in world, mm.

        Returns
        -------
        z_mm, slope_x, slope_y : (n,) arrays
            World z over the places, and its slopes.
        """
        raised_mm, tilt_x_mrad, tilt_y_mrad, saddle_mm, diagonal_mm, lifted_mm = self.errors
        x_mm, y_mm = place

        # The bowl upside down: its depth below the film's vertex.
        bowl = Surface.hencky_bowl(self.bulge_mm + raised_mm, self.radius_mm)
        top_mm = rim_z_mm + self.rim_gap_mm + self.bulge_mm + raised_mm + lifted_mm
        below_top_mm = bowl.height(x_mm, y_mm)
        bowl_slope_x, bowl_slope_y = bowl.slopes(x_mm, y_mm)

        # Errors of form: tilts, and two saddles that are turned by 45 degrees against each other.
        tilt_x = 1e-3 * tilt_x_mrad
        tilt_y = 1e-3 * tilt_y_mrad
        x, y = place / self.radius_mm
        error_mm = tilt_x * x_mm + tilt_y * y_mm
        error_mm = error_mm + saddle_mm * (x * x - y * y) + 2 * diagonal_mm * x * y
        error_slope_x = tilt_x + 2 * (saddle_mm * x + diagonal_mm * y) / self.radius_mm
        error_slope_y = tilt_y + 2 * (diagonal_mm * x - saddle_mm * y) / self.radius_mm
        return (
            top_mm - below_top_mm + error_mm,
            error_slope_x - bowl_slope_x,
            error_slope_y - bowl_slope_y,
        )


@dataclass(frozen=True)
class CushionBench:
    """A cushion before a screen's plane: traces rays of the camera.

    Attributes
    ----------
    cushion : Cushion
    mirror : Surface
        The mirror's film.
    vertex_z_mm : float
        Height of its vertex in world.
    screen_origin_mm : (3,) array
        O' in world.
    screen_axes : (3, 3) array
        s_x, s_y and normal of the screen, as rows.
    """

    cushion: Cushion
    mirror: Surface
    vertex_z_mm: float
    screen_origin_mm: FloatArray
    screen_axes: FloatArray

    @property
    def _rim_z_mm(self) -> float:
        return self.vertex_z_mm + self.mirror.sag_mm

    def trace_alone(self, start: FloatArray, rays: FloatArray) -> FloatArray:
        """Trace rays by the mirror without a film in front.

        Parameters
        ----------
        start : (3, n) array
            Points of the rays in world, mm.
        rays : (3, n) array
            Unit vectors.

        Returns
        -------
        (2, n) array
            Screen points, mm.
        """
        point = self._meet_mirror(start, rays)
        return self._meet_screen(point, self._reflect_at_mirror(point, rays))

    def trace_through(self, start: FloatArray, rays: FloatArray) -> FloatArray:
        """Trace rays through the film to the mirror and back.

        Parameters
        ----------
        start : (3, n) array
            Points of the rays in world, mm.
        rays : (3, n) array
            Unit vectors.

        Returns
        -------
        (2, n) array
            Screen points, mm.
        """
        # In through the film, by the mirror, out through the film.
        inside, ray = self._pass_film(*self._meet_front(start, rays), rays, goes_in=True)
        point = self._meet_mirror(inside, ray)
        up = self._reflect_at_mirror(point, ray)
        outside, leaving = self._pass_film(*self._meet_front(point, up), up, goes_in=False)
        return self._meet_screen(outside, leaving)

    def trace_images(self, start: FloatArray, rays: FloatArray) -> FloatArray:
        """Trace rays to the two further images of the screen, without refraction, which moves them
        by micrometres.

        Parameters
        ----------
        start : (3, n) array
            Points of the rays in world, mm.
        rays : (3, n) array
            Unit vectors.

        Returns
        -------
        (2, 2, n) array
            Screen points, mm: of the image by the film's outside, and of that by mirror, film and
            mirror; NaN where the latter meets the mirror beyond its rim.
        """
        # First image: by the film's outside.
        outside, normal = self._meet_front(start, rays)
        by_outside = self._meet_screen(outside, _reflect(rays, normal))
        # Second image: by the mirror up to the film's inside, down again, and by the mirror a
        # second time.
        point = self._meet_mirror(start, rays)
        up = self._reflect_at_mirror(point, rays)
        under, normal = self._meet_front(point, up)
        down = _reflect(up, normal)
        again = self._meet_mirror(under, down)
        by_mirror = self._meet_screen(again, self._reflect_at_mirror(again, down))
        is_beyond = again[0] ** 2 + again[1] ** 2 > self.mirror.radius_mm**2
        by_mirror[:, is_beyond] = np.nan
        return np.stack([by_outside, by_mirror])

    def _meet_mirror(self, start: FloatArray, rays: FloatArray) -> FloatArray:
        """Points (3, n) of the mirror on rays that come down."""
        # (1) on z - vertex_z - h(x, y) = 0, from the plane of the rim.
        t = (self._rim_z_mm - start[2]) / rays[2]
        for _ in range(_NEWTON_STEPS):
            x, y, z = start + t * rays
            slope_x, slope_y = self.mirror.slopes(x, y)
            above = z - self.vertex_z_mm - self.mirror.height(x, y)
            t = t - above / (rays[2] - slope_x * rays[0] - slope_y * rays[1])
        return np.asarray(start + t * rays)

    def _reflect_at_mirror(self, point: FloatArray, rays: FloatArray) -> FloatArray:
        """Rays after the mirror at points (3, n)."""
        slope_x, slope_y = self.mirror.slopes(point[0], point[1])
        return _reflect(rays, np.stack([-slope_x, -slope_y, np.ones_like(slope_x)]))

    def _meet_front(self, start: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (3, n) of the front film on rays from either side, and its normals there."""
        # (1), from a plane half way up the bulge.
        middle_mm = self._rim_z_mm + self.cushion.rim_gap_mm + self.cushion.bulge_mm / 2
        t = (middle_mm - start[2]) / rays[2]
        for _ in range(_NEWTON_STEPS):
            place = start + t * rays
            z, slope_x, slope_y = self.cushion.front_height(self._rim_z_mm, place[:2])
            approach = rays[2] - slope_x * rays[0] - slope_y * rays[1]
            t = t - (place[2] - z) / approach

        # The points, and the normals (-f_x, -f_y, 1) there.
        place = start + t * rays
        _z, slope_x, slope_y = self.cushion.front_height(self._rim_z_mm, place[:2])
        return place, np.stack([-slope_x, -slope_y, np.ones_like(slope_x)])

    def _pass_film(
        self, point: FloatArray, normal: FloatArray, rays: FloatArray, goes_in: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Points and directions (3, n) behind the film, of rays that meet it.

        Parameters
        ----------
        point, normal : (3, n) arrays
            Where the rays meet the film, and its normals there, of any length.
        rays : (3, n) array
            Unit vectors.
        goes_in : bool
            From air to gas; otherwise from gas to air.
        """
        # 1. Into the film: (3) from the medium before it.
        gas_index = 1 + self.cushion.gas_excess
        index_before = gas_index
        index_behind = 1.0
        if goes_in:
            index_before = 1.0
            index_behind = gas_index
        first_normal = normal / np.linalg.norm(normal, axis=0)
        in_film = _refract(rays, first_normal, index_before, self.cushion.film_index)

        # 2. Through it: the path is longer than the thickness by 1 / cos of the angle.
        cosine = np.sum(in_film * first_normal, axis=0)
        path_mm = self.cushion.thickness_mm / np.abs(cosine)

        # 3. Out of it: the other face has the normal of the place beside, by as much as the ray has
        # moved along the film.
        along_film_mm = path_mm * (in_film - cosine * first_normal)
        beside_mm = point[:2] + along_film_mm[:2]
        _z, slope_x, slope_y = self.cushion.front_height(self._rim_z_mm, beside_mm)
        other_normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)])
        other_normal /= np.linalg.norm(other_normal, axis=0)
        leaving = _refract(in_film, other_normal, self.cushion.film_index, index_behind)
        return point + path_mm * in_film, leaving

    def _meet_screen(self, point: FloatArray, rays: FloatArray) -> FloatArray:
        """s_x and s_y (2, n) where rays cross the plane of the screen."""
        # In the screen's axes, the plane is where the third coordinate is 0.
        start_mm = self.screen_axes @ (point - self.screen_origin_mm[:, None])
        direction = self.screen_axes @ rays
        way_mm = -start_mm[2] / direction[2]
        return np.asarray(start_mm[:2] + way_mm * direction[:2])


def _reflect(rays: FloatArray, normal: FloatArray) -> FloatArray:
    """Rays after a mirror with these normals, of any length: (2)."""
    twice = 2 * np.sum(rays * normal, axis=0) / np.sum(normal * normal, axis=0)
    return np.asarray(rays - twice * normal)


def _refract(
    rays: FloatArray, normal: FloatArray, index_before: float, index_behind: float
) -> FloatArray:
    """Unit vectors behind a face with these unit normals: (3)."""
    wave = index_before * rays
    across_before = np.sum(wave * normal, axis=0)
    along_face = wave - across_before * normal
    across_behind = np.sqrt(index_behind**2 - np.sum(along_face * along_face, axis=0))
    wave_behind = along_face + np.sign(across_before) * across_behind * normal
    return np.asarray(wave_behind / index_behind)


def image_shares(cushion: Cushion, mirror_reflectance: float) -> tuple[float, float]:
    """Light of the two further images over that of the mirror seen through the film.

    The mirror is seen through the film twice, which leaves (1 - R)^2 rho of its light, with R the
    film's reflectance and rho the mirror's. The film's outside gives R; the path by mirror, film
    and mirror gives (1 - R)^2 rho R rho.

    Parameters
    ----------
    cushion : Cushion
        The film.
    mirror_reflectance : float
        rho.

    Returns
    -------
    outside, mirror : float
    """
    passed = (1 - cushion.reflectance) ** 2
    outside = cushion.reflectance / (passed * mirror_reflectance)
    return outside, mirror_reflectance * cushion.reflectance
