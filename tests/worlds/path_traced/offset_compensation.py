"""Undo what the renderer's offset of a ray does at surfaces that rays pass.

A renderer in single precision starts a ray a little beyond the surface that it has just passed
(`meshes.RAY_OFFSET`). At a film that a ray passes on its way to the mirror and back this moves the
ray sideways: the screen is seen up to 60 µm elsewhere, more than the gas behind the film moves it.

The size is measured with the renderer itself: the bench with a film and a gas that change nothing,
against the bench without them. The mirror's normals are then tilted so that the passing rays meet
the screen where they would without the offset.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.worlds.path_traced.meshes import Surface, film_surface
from tests.worlds.path_traced.ramp import ramp_places_mm, ramp_texture
from tests.worlds.path_traced.scene import FrontFilm, RenderedBench, RenderSettings, render_surface
from tests.worlds.second_optics import Bench
from tests.worlds.second_optics.patterns import PERIOD_MM, PERIODS
from tests.worlds.second_optics.rays import trace

FloatArray = NDArray[np.float64]

ORDER = 6  # of the polynomial in the mirror's coordinates: the moved places are smooth
INSIDE = 0.97  # of the radius: pixels at the edge see the ring, too
IN_PATTERN = 0.95  # of the pattern's half side
WHOLE = 1e-3  # of the light: a pixel that lost a path is left out
TILT = 1e-6  # rad: step of the numerical derivatives


def compensated_film(
    bench: RenderedBench, displacement_um: float, settings: RenderSettings
) -> Surface:
    """The reflecting film, with normals that undo the offset at the front film.

    Raises ImportError without Mitsuba.
    """
    surface = film_surface(bench.mirror, displacement_um)
    if bench.front is None:
        return surface
    moved_mm = _moved_places_mm(bench, surface, displacement_um, settings)
    return tilt_normals(surface, bench.bench, -moved_mm)


def tilt_normals(surface: Surface, bench: Bench, wanted_mm: FloatArray) -> Surface:
    """Tilt normals so that each vertex sends the camera's ray elsewhere on the screen.

    Parameters
    ----------
    wanted_mm : (2, n) array
        By how much, along s_x and s_y.
    """
    normals = surface.normals
    seen_mm = _screen_places_mm(surface.vertices_mm, normals, bench)
    by_tilt = []
    for axis in range(2):
        tilted = normals.copy()
        tilted[:, axis] += TILT
        by_tilt.append((_screen_places_mm(surface.vertices_mm, tilted, bench) - seen_mm) / TILT)
    # for each vertex: [d s / d tilt_x, d s / d tilt_y] tilt = wanted
    matrix = np.stack(by_tilt, axis=-1).transpose(1, 0, 2)
    tilt = np.linalg.solve(matrix, wanted_mm.T[:, :, None])[:, :, 0]
    tilted = normals.copy()
    tilted[:, :2] += tilt
    return replace(surface, normals=tilted / np.linalg.norm(tilted, axis=1, keepdims=True))


def _moved_places_mm(
    bench: RenderedBench, surface: Surface, displacement_um: float, settings: RenderSettings
) -> FloatArray:
    """How far each vertex (2, n) sees the screen elsewhere because of the front film's offset."""
    assert bench.front is not None
    pinhole = replace(bench, room=0.0, aperture_mm=0.0, front=None)
    nothing = FrontFilm(bench.front.sag_mm, refractive_index=1.0, gas_index_excess=0.0)
    images = [
        render_surface(one, surface, [ramp_texture()], settings)[0]
        for one in (pinhole, replace(pinhole, front=nothing))
    ]
    moved_mm = ramp_places_mm(images[1]) - ramp_places_mm(images[0])

    width_px, height_px = bench.bench.size_px
    column, row = np.meshgrid(np.arange(width_px, dtype=float), np.arange(height_px, dtype=float))
    seen = trace(bench.bench, bench.mirror, column.ravel(), row.ravel(), displacement_um)
    shape = (2, height_px, width_px)
    film, screen_mm = seen.film.reshape(shape), seen.screen_mm.reshape(shape)
    half_mm = PERIODS * PERIOD_MM / 2
    good = np.hypot(*film) < INSIDE
    good &= np.abs(screen_mm).max(axis=0) < IN_PATTERN * half_mm
    for image in images:
        light = image[:, :, 2]
        good &= np.abs(light / np.median(light[good]) - 1) < WHOLE

    matrix = _polynomials(film[0][good], film[1][good])
    coefficients, *_ = np.linalg.lstsq(matrix, moved_mm[:, good].T)
    place = surface.vertices_mm[:, :2] / bench.mirror.radius_mm
    return np.asarray((_polynomials(place[:, 0], place[:, 1]) @ coefficients).T)


def _polynomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """Monomials (n, terms) up to `ORDER`."""
    powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    return np.stack([x**i * y**j for i, j in powers], axis=-1)


def _screen_places_mm(place_mm: FloatArray, normals: FloatArray, bench: Bench) -> FloatArray:
    """Where the camera's rays to places (n, 3) meet the screen (2, n) after the reflection."""
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    ray = place_mm - bench.camera.place_mm
    leaving = ray - 2 * np.sum(ray * unit, axis=1, keepdims=True) * unit
    from_screen = bench.screen.axes @ (place_mm - bench.screen.place_mm).T
    along = bench.screen.axes @ leaving.T
    on_screen = from_screen - from_screen[2] / along[2] * along
    return np.asarray(on_screen[:2] / bench.pitch)
