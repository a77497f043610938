"""The surfaces of the bench as triangles: vertices, unit normals, faces.

A renderer in single precision starts a reflected ray a little above the surface, along its normal,
so that the ray does not meet the same surface again. This moves the ray sideways by twice the
height times the tangent of the angle of incidence, 10 µm on the screen. A mirror whose vertices lie
half of that height deeper sends the ray along the right line (`deeper_by_half_the_offset`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics import Mirror

FloatArray = NDArray[np.float64]
Positions = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]

RINGS = 260  # of vertices: 1.9 mm apart on a radius of 500 mm,
SPOKES = 1080  # and 2.9 mm apart at the edge: a chord is 0.3 µm below the bowl
RAY_OFFSET = 1500 * 2.0**-24  # of 1 + the largest coordinate: where Mitsuba starts a ray


@dataclass(frozen=True)
class Surface:
    """Triangles of a smooth surface.

    Attributes
    ----------
    vertices_mm, normals : (n, 3) arrays
    faces : (m, 3) array of int
        Indices of vertices, counter-clockwise seen from where the normals point.
    """

    vertices_mm: FloatArray
    normals: FloatArray
    faces: NDArray[np.int64]

    def deeper_by_half_the_offset(self) -> Surface:
        """The surface against its normals by half of the renderer's offset of a new ray."""
        offset_mm = RAY_OFFSET * (1 + np.abs(self.vertices_mm).max(axis=1))
        return replace(self, vertices_mm=self.vertices_mm - offset_mm[:, None] / 2 * self.normals)

    def write_ply(self, path: Path) -> None:
        """Write the surface as a binary PLY file, in single precision."""
        vertices = np.hstack([self.vertices_mm, self.normals]).astype("<f4")
        faces = np.empty(len(self.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
        faces["count"] = 3
        faces["corners"] = self.faces
        names = ("x", "y", "z", "nx", "ny", "nz")
        header = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(vertices)}",
            *(f"property float {name}" for name in names),
            f"element face {len(faces)}",
            "property list uchar int vertex_index",
            "end_header",
        ]
        text = "\n".join(header) + "\n"
        path.write_bytes(text.encode("ascii") + vertices.tobytes() + faces.tobytes())


def disc_surface(positions: Positions) -> Surface:
    """Triangulate a disc in polar coordinates.

    Parameters
    ----------
    positions
        From places x, y (n,) in radii to places (3, n) in mm and their derivatives by x and by y.
    """
    radius = np.arange(1, RINGS + 1) / RINGS
    angle = 2 * np.pi * np.arange(SPOKES) / SPOKES
    x = np.concatenate([[0.0], np.outer(radius, np.cos(angle)).ravel()])
    y = np.concatenate([[0.0], np.outer(radius, np.sin(angle)).ravel()])
    place_mm, along_x, along_y = positions(x, y)
    normals = np.cross(along_x, along_y, axis=0)
    normals /= np.linalg.norm(normals, axis=0)
    return Surface(place_mm.T, normals.T, _polar_faces())


def film_surface(mirror: Mirror, displacement_um: float) -> Surface:
    """The reflecting film; its normals point out of the reflective side."""
    return disc_surface(lambda x, y: mirror.position_mm(x, y, displacement_um))


def bulging_surface(film: Mirror, ring_mm: float, raised_mm: float = 0.0) -> Surface:
    """A film that bulges to the other side of a ring at height `ring_mm`; normals point out.

    The film's own frame has its centre at 0 and its ring at its sag; mirrored in the ring's plane
    the centre is at `ring_mm` + sag.
    """
    upside_down = np.array([[1.0], [1.0], [-1.0]])
    lift = np.array([[0.0], [0.0], [ring_mm + film.sag_mm + raised_mm]])

    def positions(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        place, along_x, along_y = film.position_mm(x, y, 0.0)
        return lift + upside_down * place, upside_down * along_x, upside_down * along_y

    return disc_surface(positions)


def sphere_surface(curvature_mm: float, radius_mm: float) -> Surface:
    """A spherical bowl: vertex at 0, radius of curvature, radius of its edge."""

    def positions(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        x_mm, y_mm = radius_mm * x, radius_mm * y
        below_mm = np.sqrt(curvature_mm**2 - x_mm**2 - y_mm**2)
        one, none = np.full_like(x, radius_mm), np.zeros_like(x)
        place = np.stack([x_mm, y_mm, curvature_mm - below_mm])
        along_x = np.stack([one, none, radius_mm * x_mm / below_mm])
        along_y = np.stack([none, one, radius_mm * y_mm / below_mm])
        return place, along_x, along_y

    return disc_surface(positions)


def ring_surface(inner_mm: float, outer_mm: float, height_mm: float) -> Surface:
    """A flat ring; its normals point up."""
    angle = 2 * np.pi * np.arange(SPOKES) / SPOKES
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(SPOKES)], axis=1)
    height = np.array([0.0, 0.0, height_mm])
    vertices = np.vstack([inner_mm * circle + height, outer_mm * circle + height])
    normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    return Surface(vertices, normals, _between_circles(0, SPOKES))


def _polar_faces() -> NDArray[np.int64]:
    """Triangles around the centre, then two for each cell between neighbouring circles."""
    here = 1 + np.arange(SPOKES)
    beside = 1 + (np.arange(SPOKES) + 1) % SPOKES
    faces = [np.stack([np.zeros(SPOKES, np.int64), here, beside], axis=1)]
    for ring in range(RINGS - 1):
        inner = 1 + ring * SPOKES
        faces.append(_between_circles(inner, inner + SPOKES))
    return np.concatenate(faces)


def _between_circles(inner: int, outer: int) -> NDArray[np.int64]:
    """Triangles between two circles whose vertices begin at these indices."""
    here = np.arange(SPOKES)
    beside = (here + 1) % SPOKES
    lower = np.stack([inner + here, outer + here, outer + beside], axis=1)
    upper = np.stack([inner + here, outer + beside, inner + beside], axis=1)
    return np.concatenate([lower, upper])
