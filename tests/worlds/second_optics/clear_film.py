"""A clear film in front of the mirror: a film of the second world, upside down, with gas behind it.

A ray is followed face by face. The inner face is the set of points one thickness behind the outer
one: its normal is that of the outer face at the foot of the perpendicular.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics.bench import Bench
from tests.worlds.second_optics.mirror import Mirror
from tests.worlds.second_optics.rays import Seen, meet_film, meet_screen

FloatArray = NDArray[np.float64]
STILL = np.zeros((3, 1))
REFLECTANCE_OF_MIRROR = 0.88


@dataclass(frozen=True)
class ClearFilm:
    """A clear film that bulges towards the camera.

    Attributes
    ----------
    film : Mirror
        The film as a bowl of its own: its sag is the bulge.
    tilt : (float, float)
        Slopes by which it leans along x and y.
    gas_excess : float
        Index of the gas inside less that of the air.
    """

    film: Mirror = field(default_factory=lambda: Mirror(sag_mm=63.4))
    tilt: tuple[float, float] = (0.0, 0.0)
    thickness_mm: float = 0.010
    index: float = 1.6
    gas_excess: float = 7.2e-6

    @property
    def reflectance(self) -> float:
        """Both faces, incoherent, at right angles."""
        r = ((self.index - 1) / (self.index + 1)) ** 2
        return 2 * r / (1 + r)

    def meet(
        self, start: FloatArray, rays: FloatArray, rim_mm: float, bulged_um: float
    ) -> tuple[FloatArray, FloatArray]:
        """Points (3, n) of the film on lines, and its unit normals there, towards the camera."""
        origin, axes = self._own_frame(rim_mm)
        own_start = axes @ (start - origin)
        own_rays = axes @ rays
        material, path = meet_film(self.film, own_start, own_rays, STILL, bulged_um)
        _, along_x, along_y = self.film.position_mm(material[0], material[1], bulged_um)
        normal = axes.T @ np.cross(along_x, along_y, axis=0)
        normal *= np.sign(normal[2]) / np.linalg.norm(normal, axis=0)
        return start + path * rays, normal

    def _own_frame(self, rim_mm: float) -> tuple[FloatArray, FloatArray]:
        """Place of its vertex, and its own axes as rows: z points at the mirror."""
        z = np.array([self.tilt[0], self.tilt[1], -1.0])
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        axes = np.stack([x, np.cross(z, x), z])
        return np.array([[0.0], [0.0], [rim_mm]]) - self.film.sag_mm * z[:, None], axes

    def cross(
        self,
        start: FloatArray,
        rays: FloatArray,
        rim_mm: float,
        bulged_um: float,
        inwards: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """Where rays leave the film on its other side, and their directions there."""
        gas = 1 + self.gas_excess
        point, normal = self.meet(start, rays, rim_mm, bulged_um)
        if not inwards:  # the inner face comes first
            inner = point
            for _ in range(3):
                back = self.thickness_mm / np.sum(rays * normal, axis=0)
                inner = point - back * rays
                _, normal = self.meet(inner, normal, rim_mm, bulged_um)
            inside = bend(rays, normal, gas / self.index)
            outer, normal = self.meet(inner, inside, rim_mm, bulged_um)
            return outer, bend(inside, normal, self.index)
        inside = bend(rays, normal, 1 / self.index)
        inner = point
        for _ in range(3):
            depth = self.thickness_mm / -np.sum(inside * normal, axis=0)
            inner = point + depth * inside
            _, normal = self.meet(inner, normal, rim_mm, bulged_um)
        return inner, bend(inside, normal, self.index / gas)


def bend(rays: FloatArray, normal: FloatArray, ratio: float) -> FloatArray:
    """Refract unit vectors at unit normals; `ratio` is the index before over that behind.

    Beyond the ring, where the film is only continued, a ray may find no way: it goes along the
    face.
    """
    facing = -np.sign(np.sum(rays * normal, axis=0)) * normal
    cosine = -np.sum(rays * facing, axis=0)
    behind = np.sqrt(np.maximum(1 - ratio**2 * (1 - cosine**2), 0.0))
    return np.asarray(ratio * rays + (ratio * cosine - behind) * facing)


def trace_cushion(
    bench: Bench,
    mirror: Mirror,
    clear: ClearFilm,
    column: FloatArray,
    row: FloatArray,
    displacement_um: float,
) -> Seen:
    """The mirror seen through the clear film, without bending by the air."""
    start, rays = _camera_rays(bench, column, row)
    rim_mm, bulged_um = mirror.sag_mm, _bulged_um(mirror, clear, displacement_um)
    inside, ray = clear.cross(start, rays, rim_mm, bulged_um, inwards=True)
    film, place, leaving = _reflect(mirror, inside, ray, displacement_um)
    outside, leaving = clear.cross(place, leaving, rim_mm, bulged_um, inwards=False)
    screen_mm, tilt = meet_screen(bench, outside, leaving, STILL)
    return Seen(film, screen_mm, tilt)


def trace_reflections(
    bench: Bench,
    mirror: Mirror,
    clear: ClearFilm,
    column: FloatArray,
    row: FloatArray,
    displacement_um: float,
) -> list[tuple[float, Seen]]:
    """Both images of the screen by the clear film, each with its light over a bare mirror's."""
    start, rays = _camera_rays(bench, column, row)
    rim_mm, bulged_um = mirror.sag_mm, _bulged_um(mirror, clear, displacement_um)
    point, normal = clear.meet(start, rays, rim_mm, bulged_um)
    mirrored = rays - 2 * np.sum(rays * normal, axis=0) * normal
    first = Seen(point[:2] / mirror.radius_mm, *meet_screen(bench, point, mirrored, STILL))
    _, place, up = _reflect(mirror, start, rays, displacement_um)
    under, normal = clear.meet(place, up, rim_mm, bulged_um)
    down = up - 2 * np.sum(up * normal, axis=0) * normal
    film, place, up = _reflect(mirror, under, down, displacement_um)
    second = Seen(film, *meet_screen(bench, place, up, STILL))
    r, rho = clear.reflectance, REFLECTANCE_OF_MIRROR
    return [(r / rho, first), ((1 - r) ** 2 * rho * r, second)]


def _camera_rays(
    bench: Bench, column: FloatArray, row: FloatArray
) -> tuple[FloatArray, FloatArray]:
    rays = bench.directions(column, row)
    return np.repeat(bench.camera.place_mm[:, None], rays.shape[1], axis=1), rays


def _bulged_um(mirror: Mirror, clear: ClearFilm, displacement_um: float) -> float:
    return displacement_um * clear.film.sag_mm / mirror.sag_mm


def _reflect(
    mirror: Mirror, start: FloatArray, rays: FloatArray, displacement_um: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    film, path = meet_film(mirror, start, rays, STILL, displacement_um)
    _, along_x, along_y = mirror.position_mm(film[0], film[1], displacement_um)
    normal = np.cross(along_x, along_y, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    return film, start + path * rays, rays - 2 * np.sum(rays * normal, axis=0) * normal
