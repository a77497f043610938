"""Rays from the camera to the film and on to the screen.

A ray is a parabola, since the air bends it: P(t) = F + t d + t^2 b / 2. Newton's method finds the
material point and the path at which it meets the film, in three equations for three unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics.bench import Bench
from tests.worlds.second_optics.mirror import Mirror

FloatArray = NDArray[np.float64]

AIR_PER_MM = 0.925e-9  # curvature of a ray per K/m
GLASS_INDEX = 1.51
MET_MM = 1e-9


@dataclass(frozen=True)
class Seen:
    """What rays meet: material points in radii, places on the screen, angles at the screen.

    Attributes
    ----------
    film : (2, n) array
    screen_mm : (2, n) array
        In stated millimetres of the screen.
    tilt : (2, n) array
        Tangents of the viewing angle, along s_x and s_y.
    """

    film: FloatArray
    screen_mm: FloatArray
    tilt: FloatArray


def trace(
    bench: Bench, mirror: Mirror, column: FloatArray, row: FloatArray, displacement_um: float
) -> Seen:
    """Follow the rays of image points, (n,) each."""
    rays = bench.directions(column, row)
    start = bench.camera.place_mm[:, None]
    bend = np.array([[0.0], [-AIR_PER_MM * bench.air_k_per_m], [0.0]])
    film, path = meet_film(mirror, start, rays, bend, displacement_um)
    place, along_x, along_y = mirror.position_mm(film[0], film[1], displacement_um)
    normal = np.cross(along_x, along_y, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    arriving = rays + path * bend
    leaving = arriving - 2 * np.sum(arriving * normal, axis=0) * normal
    screen_mm, tilt = meet_screen(bench, place, leaving, bend)
    return Seen(film, screen_mm, tilt)


def trace_direct(bench: Bench, column: FloatArray, row: FloatArray) -> Seen:
    """Rays that meet the screen itself, without a mirror."""
    rays = bench.directions(column, row)
    start = np.repeat(bench.camera.place_mm[:, None], rays.shape[1], axis=1)
    bend = np.array([[0.0], [-AIR_PER_MM * bench.air_k_per_m], [0.0]])
    screen_mm, tilt = meet_screen(bench, start, rays, bend)
    return Seen(np.zeros_like(screen_mm), screen_mm, tilt)


def meet_film(
    mirror: Mirror, start: FloatArray, rays: FloatArray, bend: FloatArray, displacement_um: float
) -> tuple[FloatArray, FloatArray]:
    radius = mirror.radius_mm
    # a flat sheet half way down the bowl gives the first guess
    path = (mirror.sag_mm / 2 - start[2]) / rays[2]
    film = mirror.own_axes(start[:2] + path * rays[:2]) / radius
    for _ in range(12):
        place, along_x, along_y = mirror.position_mm(film[0], film[1], displacement_um)
        off = start + path * rays + path**2 / 2 * bend - place
        arriving = rays + path * bend
        matrix = np.stack([along_x, along_y, -arriving], axis=1).transpose(2, 0, 1)
        step = np.linalg.solve(matrix, off.T[:, :, None])[:, :, 0].T
        # far outside the ring the film is only continued: keep its points near
        step[:2] = np.clip(step[:2], -0.2, 0.2)
        film = film + step[:2]
        path = path + step[2]
        inside = film[0] ** 2 + film[1] ** 2 < 1.02
        if not inside.any() or np.abs(off[:, inside]).max() < MET_MM:
            break
    return film, path


def meet_screen(
    bench: Bench, place: FloatArray, leaving: FloatArray, bend: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Places (2, n) on the screen and tangents of the viewing angle."""
    axes = bench.screen.axes
    from_screen = axes @ (place - bench.screen.place_mm[:, None])
    ray, down = axes @ leaving, axes @ bend
    path = -from_screen[2] / ray[2]
    for _ in range(8):
        on = from_screen + path * ray + path**2 / 2 * down
        path = path - (on[2] - bench.face_mm(on[0], on[1])) / ray[2]
    on = from_screen + path * ray + path**2 / 2 * down
    arriving = ray + path * down
    arriving = arriving / np.linalg.norm(arriving, axis=0)
    inside = arriving[:2] / GLASS_INDEX  # sines in the glass
    depth = bench.glass_mm * inside / np.sqrt(1 - np.sum(inside**2, axis=0))
    return (on[:2] + depth) / bench.pitch, arriving[:2] / -arriving[2]
