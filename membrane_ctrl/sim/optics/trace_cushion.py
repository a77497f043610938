"""Exact trace of camera rays through a clear front film to the mirror, and of the two further
images of the screen that the film makes.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.bench_poses import CameraPose, ScreenPose
from membrane_ctrl.sim.optics.film_terms import FilmTerms, height_and_slopes
from membrane_ctrl.sim.optics.front_film import FrontFilm, film_constants
from membrane_ctrl.sim.optics.screen_face import TOLERANCE_MM, project_onto_face
from membrane_ctrl.sim.optics.trace import Trace, find_film_distance, find_plane_point

_BEYOND = 1.1  # rays beyond this share of the radius are not traced: polynomials diverge there
_MAX_STEPS = 20  # Newton needs 4
_BESIDE_MM = 0.5  # for the slope of the film's thickness along z


@dataclass(frozen=True, slots=True)
class CushionTrace:
    """Where rays meet mirror and screen, and where the front film's images of the screen are.

    Attributes
    ----------
    main : Trace
        By the mirror, as for a single film.
    images_mm : (2, 2, N) array
        s_x and s_y of the image by the film's outside, and of that by mirror, film and mirror; NaN
        where there is none.
    """

    main: Trace
    images_mm: FloatArray


def trace_cushion(
    camera: CameraPose,
    directions: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    front: FrontFilm,
    screen: ScreenPose,
) -> CushionTrace:
    """Follow rays from the pinhole through the front film to the mirror and on to the screen.

    Parameters
    ----------
    camera, directions, film, sag_mm, vertex_z_mm, screen
        As of `trace.trace_rays`.
    front : FrontFilm
        The clear film. Its rim stands where the mirror's does.

    Returns
    -------
    CushionTrace
    """
    # Where the rays meet the mirror and, by three ways, the plane of the screen.
    bulge_mm = front.bulge_at_mm(sag_mm)
    hits = _trace_kernel(
        camera.position_mm,
        np.ascontiguousarray(directions),
        film,
        sag_mm,
        vertex_z_mm,
        front.shape.terms,
        bulge_mm,
        vertex_z_mm + sag_mm + front.rim_gap_mm + bulge_mm,
        film_constants(front),
        screen.origin_mm,
        np.stack([screen.s_x, screen.s_y, np.cross(screen.s_x, screen.s_y)]),
    )

    # From the plane to the screen's face: the main image, and both others.
    on_face = [
        project_onto_face(
            hits[k : k + 2], hits[k + 2 : k + 4], screen.bow_per_mm, screen.height_map
        )
        for k in (2, 6, 10)
    ]
    main = Trace(hits[0], hits[1], *on_face[0])
    return CushionTrace(main, np.array(on_face[1:]))


@compile_loop()
def _front_distance(
    start: FloatArray, direction: FloatArray, front: FilmTerms, bulge_mm: float, top_mm: float
) -> float:
    """Path from `start` to the face z = top - h(x, y) along a unit vector; NaN without one.

    It begins where the ray is as high as the face over its start.
    """
    # Where to begin.
    h, _hx, _hy = height_and_slopes(front, bulge_mm, start[0], start[1])
    t = (top_mm - h - start[2]) / direction[2]
    if direction[2] < 0.0:  # from the camera, far away: begin in the film's plane
        t = (top_mm - bulge_mm - start[2]) / direction[2]

    # Newton's method on f(t) = z(t) - top + h(x(t), y(t)).
    for _ in range(_MAX_STEPS):
        x = start[0] + t * direction[0]
        y = start[1] + t * direction[1]
        h, hx, hy = height_and_slopes(front, bulge_mm, x, y)
        above = start[2] + t * direction[2] - top_mm + h
        step = above / (direction[2] + hx * direction[0] + hy * direction[1])
        t -= step
        if abs(step) < TOLERANCE_MM:
            return float(t)
    return float(np.nan)


@compile_loop()
def _front_normal(front: FilmTerms, bulge_mm: float, p: FloatArray) -> FloatArray:
    """Unit normal of the front film, towards the camera."""
    _h, hx, hy = height_and_slopes(front, bulge_mm, p[0], p[1])
    normal = np.array([hx, hy, 1.0])
    return normal / np.sqrt(np.dot(normal, normal))  # type: ignore[no-any-return]


@compile_loop()
def _mirror_normal(film: FilmTerms, sag_mm: float, p: FloatArray) -> FloatArray:
    """Unit normal of the mirror, towards the camera."""
    _h, hx, hy = height_and_slopes(film, sag_mm, p[0], p[1])
    normal = np.array([-hx, -hy, 1.0])
    return normal / np.sqrt(np.dot(normal, normal))  # type: ignore[no-any-return]


@compile_loop()
def _reflect(direction: FloatArray, normal: FloatArray) -> FloatArray:
    """A ray after a mirror with this unit normal."""
    return direction - 2.0 * np.dot(direction, normal) * normal  # type: ignore[no-any-return]


@compile_loop()
def _refract(
    direction: FloatArray, normal: FloatArray, index_from: float, index_to: float
) -> FloatArray:
    """A unit vector behind a face: the part along the face is n_1 / n_2 of that before (Snell)."""
    along_normal = np.dot(direction, normal)
    along_face = (index_from / index_to) * (direction - along_normal * normal)
    cosine = np.sqrt(1.0 - np.dot(along_face, along_face))
    return along_face + np.copysign(cosine, along_normal) * normal  # type: ignore[no-any-return]


@compile_loop()
def _pass_film(
    start: FloatArray,
    direction: FloatArray,
    front: FilmTerms,
    bulge_mm: float,
    top_mm: float,
    constants: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Point and direction behind the film, from either side: a ray that comes down is refracted by
    the outer and then by the inner face, one that goes up by the inner one first.

    The inner face is the outer one, lowered so that the film has its thickness along its normal.
    """
    thickness_mm, film_index, gas_index = constants
    comes_down = direction[2] < 0.0
    point = start
    ray = direction
    for face in range(2):
        # Where the ray meets the face, and the normal there; the inner face is found beside the
        # outer one.
        is_outer = (face == 0) == comes_down
        t = _front_distance(point, ray, front, bulge_mm, top_mm)
        met = point + t * ray
        normal = _front_normal(front, bulge_mm, met)
        index_outside = 1.0
        if not is_outer:
            lowered, by_x, by_y = _lowered_face(front, bulge_mm, thickness_mm, met)
            t = _front_distance(point, ray, front, bulge_mm, top_mm - lowered)
            met = point + t * ray
            normal = _front_normal(front, bulge_mm, met)
            normal = normal / normal[2] + np.array([by_x, by_y, 0.0])
            normal = normal / np.sqrt(np.dot(normal, normal))
            index_outside = gas_index

        # Into the film, then out of it.
        point = met
        if face == 0:
            ray = _refract(ray, normal, index_outside, film_index)
        else:
            ray = _refract(ray, normal, film_index, index_outside)
    return point, ray


@compile_loop()
def _lowered_face(
    front: FilmTerms, bulge_mm: float, thickness_mm: float, p: FloatArray
) -> tuple[float, float, float]:
    """Vertical distance of the inner face from the outer one near a point, and its slopes.

    A film of one thickness along its normal is thicker by sqrt(1 + slope^2) along z.
    """
    # At the point, then a little to the left, right, below and above it: central differences.
    distances = np.empty(5)
    for k in range(5):
        x = p[0]
        y = p[1]
        if k == 1 or k == 2:
            x += _BESIDE_MM * (2 * k - 3)
        elif k > 2:
            y += _BESIDE_MM * (2 * k - 7)
        _h, hx, hy = height_and_slopes(front, bulge_mm, x, y)
        distances[k] = thickness_mm * np.sqrt(1.0 + hx * hx + hy * hy)
    by_x = (distances[2] - distances[1]) / (2.0 * _BESIDE_MM)
    by_y = (distances[4] - distances[3]) / (2.0 * _BESIDE_MM)
    return distances[0], by_x, by_y


@compile_loop()
def _trace_kernel(
    start: FloatArray,
    directions: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    front: FilmTerms,
    bulge_mm: float,
    top_mm: float,
    constants: FloatArray,
    origin: FloatArray,
    axes: FloatArray,
) -> FloatArray:
    """(14, N): x and y on the mirror; then for the main image and for both others s_x and s_y on
    the screen's plane, and tangents of the ray there.
    """
    hits = np.zeros((14, directions.shape[0]))
    hits[6:] = np.nan
    rim_z_mm = vertex_z_mm + sag_mm
    beyond = (_BEYOND * film.radius_mm) ** 2
    for n in range(directions.shape[0]):
        d = directions[n]
        if d[2] >= 0.0 or start[2] <= top_mm:  # never comes down on the films
            hits[:, n] = np.nan
            continue

        # Where it crosses the rim's plane; far outside the rim it is not followed.
        to_rim_mm = (rim_z_mm - start[2]) / d[2]
        hits[0, n] = start[0] + to_rim_mm * d[0]
        hits[1, n] = start[1] + to_rim_mm * d[1]
        if hits[0, n] ** 2 + hits[1, n] ** 2 > beyond:
            continue

        # The image by the film's outside.
        outside = start + _front_distance(start, d, front, bulge_mm, top_mm) * d
        mirrored = _reflect(d, _front_normal(front, bulge_mm, outside))
        hits[6, n], hits[7, n], hits[8, n], hits[9, n] = find_plane_point(
            outside, mirrored, origin, axes
        )

        # Through the film to the mirror.
        inside, ray = _pass_film(start, d, front, bulge_mm, top_mm, constants)
        guess_mm = (rim_z_mm - inside[2]) / ray[2]
        t = find_film_distance(inside, ray, film, sag_mm, vertex_z_mm, guess_mm)
        if np.isnan(t):
            hits[2:, n] = np.nan
            continue
        p = inside + t * ray
        hits[0, n] = p[0]
        hits[1, n] = p[1]
        up = _reflect(ray, _mirror_normal(film, sag_mm, p))

        # Out through the film to the screen.
        leaving, outward = _pass_film(p, up, front, bulge_mm, top_mm, constants)
        hits[2, n], hits[3, n], hits[4, n], hits[5, n] = find_plane_point(
            leaving, outward, origin, axes
        )

        # The image by mirror, film and mirror: back from the film's inside.
        under = p + _front_distance(p, up, front, bulge_mm, top_mm) * up
        down = _reflect(up, _front_normal(front, bulge_mm, under))
        t = find_film_distance(under, down, film, sag_mm, vertex_z_mm, under[2] - vertex_z_mm)
        again = under + t * down
        if np.isnan(t) or again[0] ** 2 + again[1] ** 2 > beyond:
            continue
        up = _reflect(down, _mirror_normal(film, sag_mm, again))
        leaving, outward = _pass_film(again, up, front, bulge_mm, top_mm, constants)
        hits[10, n], hits[11, n], hits[12, n], hits[13, n] = find_plane_point(
            leaving, outward, origin, axes
        )
    return hits
