"""Exact trace of camera rays to the film and, reflected, to the screen, by Newton's method on the
true surface.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.bench_poses import CameraPose, ScreenPose
from membrane_ctrl.sim.optics.film_terms import FilmTerms, height_and_slopes
from membrane_ctrl.sim.optics.screen_face import TOLERANCE_MM, project_onto_face

_BEYOND = 1.1  # rays beyond this share of the radius are not traced: polynomials diverge there
_MAX_STEPS = 20  # Newton needs 4 on any bowl; a grazing ray may never converge


@dataclass(frozen=True, slots=True)
class Trace:
    """Where rays met film and screen.

    Attributes
    ----------
    x_mm, y_mm : (N,) arrays
        On the film, or on the plane of its rim for rays far outside it, which are not traced; NaN
        for rays that never come down on that plane.
    s_x_mm, s_y_mm : (N,) arrays
        On the screen; 0 for rays that are not traced, NaN for those that never reach the screen.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    s_x_mm: FloatArray
    s_y_mm: FloatArray

    def on_film(self, radius_mm: float) -> BoolArray:
        """Which rays met the film inside its rim, (N,)."""
        return self.x_mm**2 + self.y_mm**2 <= radius_mm**2


def trace_rays(
    camera: CameraPose,
    directions: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    screen: ScreenPose,
) -> Trace:
    """Follow rays from the pinhole over the film to the screen.

    Parameters
    ----------
    camera : CameraPose
        The pinhole.
    directions : (N, 3) array
        Unit vectors in world.
    film : FilmTerms
        The surface z = vertex_z_mm + h(x, y).
    sag_mm : float
        Depth of its bowl.
    vertex_z_mm : float
        Height of its vertex.
    screen : ScreenPose
        The screen.

    Returns
    -------
    Trace
    """
    hits = _trace_kernel(
        camera.position_mm,
        np.ascontiguousarray(directions),
        film,
        sag_mm,
        vertex_z_mm,
        screen.origin_mm,
        np.stack([screen.s_x, screen.s_y, np.cross(screen.s_x, screen.s_y)]),
    )
    s_x_mm, s_y_mm = project_onto_face(hits[2:4], hits[4:6], screen.bow_per_mm, screen.height_map)
    return Trace(hits[0], hits[1], s_x_mm, s_y_mm)


@compile_loop()
def find_film_distance(
    start: FloatArray,
    direction: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    guess_mm: float,
) -> float:
    """Path from a point to the film along a ray, by Newton's method; NaN if it does not converge.

    f(t) = z(t) - vertex_z - h(x(t), y(t)) = 0 with f' = d_z - h_x d_x - h_y d_y.

    Parameters
    ----------
    start : (3,) array
        Point in world, mm.
    direction : (3,) array
        Unit vector of the ray, in world.
    film : FilmTerms
        Shape of the film.
    sag_mm : float
        Its sag.
    vertex_z_mm : float
        Height of its vertex in world.
    guess_mm : float
        Path to begin with.
    """
    t = guess_mm
    for _ in range(_MAX_STEPS):
        # Height of the point above the film there, and the step that makes it 0.
        x = start[0] + t * direction[0]
        y = start[1] + t * direction[1]
        h, hx, hy = height_and_slopes(film, sag_mm, x, y)
        above = start[2] + t * direction[2] - vertex_z_mm - h
        step = above / (direction[2] - hx * direction[0] - hy * direction[1])
        t -= step
        if abs(step) < TOLERANCE_MM:
            return float(t)
    return float(np.nan)


@compile_loop()
def find_plane_point(
    p: FloatArray, direction: FloatArray, origin: FloatArray, axes: FloatArray
) -> tuple[float, float, float, float]:
    """Where a ray crosses the screen's plane: in the screen's axes the ray is q + t r.

    Parameters
    ----------
    p : (3,) array
        Point of the ray in world, mm.
    direction : (3,) array
        Unit vector of the ray, in world.
    origin : (3,) array
        O', the screen's origin in world, mm.
    axes : (3, 3) array
        The screen's axes in world: s_x, s_y and the normal, as rows.

    Returns
    -------
    s_x, s_y : float
        The point, mm; NaN if the ray runs away from the screen.
    tangent_x, tangent_y : float
        Motion along s_x and s_y for each mm along the normal.
    """
    q = axes @ (p - origin)
    r = axes @ direction
    runs_away = q[2] * r[2] >= 0.0
    if runs_away:
        return np.nan, np.nan, np.nan, np.nan
    t = -q[2] / r[2]
    s_x = q[0] + t * r[0]
    s_y = q[1] + t * r[1]
    return s_x, s_y, r[0] / r[2], r[1] / r[2]


@compile_loop()
def _trace_kernel(
    start: FloatArray,
    directions: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    origin: FloatArray,
    axes: FloatArray,
) -> FloatArray:
    """(6, N): x and y on the film, s_x and s_y on the screen's plane, tangents of the ray there."""
    hits = np.zeros((6, directions.shape[0]))
    rim_z_mm = vertex_z_mm + sag_mm
    beyond = (_BEYOND * film.radius_mm) ** 2
    normal = np.empty(3)
    p = np.empty(3)
    for n in range(directions.shape[0]):
        d = directions[n]
        if d[2] >= 0.0 or start[2] <= rim_z_mm:  # never comes down on the film
            hits[:, n] = np.nan
            continue

        # Where it crosses the rim's plane; far outside the rim it is not followed.
        to_rim_mm = (rim_z_mm - start[2]) / d[2]
        hits[0, n] = start[0] + to_rim_mm * d[0]
        hits[1, n] = start[1] + to_rim_mm * d[1]
        if hits[0, n] ** 2 + hits[1, n] ** 2 > beyond:
            continue

        # Where it meets the film.
        t = find_film_distance(start, d, film, sag_mm, vertex_z_mm, to_rim_mm)
        if np.isnan(t):
            hits[2:, n] = np.nan
            continue
        for axis in range(3):
            p[axis] = start[axis] + t * d[axis]
        hits[0, n] = p[0]
        hits[1, n] = p[1]

        # Law of reflection: r = d - 2 (d n) n / (n n).
        _, hx, hy = height_and_slopes(film, sag_mm, p[0], p[1])
        normal[0] = -hx
        normal[1] = -hy
        normal[2] = 1.0
        reflected = d - (2.0 * np.dot(d, normal) / np.dot(normal, normal)) * normal
        hits[2, n], hits[3, n], hits[4, n], hits[5, n] = find_plane_point(
            p, reflected, origin, axes
        )
    return hits
