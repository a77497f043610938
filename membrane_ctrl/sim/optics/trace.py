"""Exact trace of camera rays to the film and, reflected, to the screen:
Newton on the true surface.
"""

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
from numba import njit
from scipy.interpolate import RectBivariateSpline

from membrane_ctrl.config.optics import (
    CameraConfig,
    GeometryConfig,
    HeightMapConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.sim.optics.film_shape import FilmTerms, height_and_slopes

# Camera and screen of the twin as exact poses: rays from the pinhole, and the plane in which they
# end.
#
# World: origin at the mirror's vertex, x horizontal, y up, z out of the reflective side; mm.
_UNDISTORT_STEPS = 200  # each gains about a digit with a usual lens
_UNDISTORT_TOLERANCE = 1e-14  # tangent of the ray's angle


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Pinhole `position_mm` (3,); rows of `rotation` (3, 3): camera x (right), y (down), z
    (forward) in world.
    """

    position_mm: FloatArray
    rotation: FloatArray


@dataclass(frozen=True, slots=True)
class ScreenPose:
    """O' as `origin_mm` and the unit vectors of `s_x` and `s_y`, each (3,), in world; bow and
    height map of the face.

    The face departs from the plane by bow_per_mm (s_x^2 + s_y^2) and the map, towards s_x x s_y,
    which points at the mirror.
    """

    origin_mm: FloatArray
    s_x: FloatArray
    s_y: FloatArray
    bow_per_mm: float = 0.0
    height_map: HeightMapConfig | None = None


@dataclass(frozen=True, slots=True)
class ScreenError:
    """Deviation of a screen from its nominal pose.

    `tilt_about_x_deg` and `tilt_about_y_deg` turn it about its own s_x and s_y axes (right-handed);
    `bow_mm` is how far the face stands towards the mirror 200 mm away from O' (paraboloid; s_x and
    s_y count along the flat plane).
    """

    tilt_about_x_deg: float = 0.0
    tilt_about_y_deg: float = 0.0
    bow_mm: float = 0.0


_BOW_RADIUS_MM = 200.0  # half side of the paper's pattern region, rounded


def camera_pose(geometry: GeometryConfig) -> CameraPose:
    """Pose of the camera: as given, or F = a (cos alpha, 0,
    sin alpha) looking at O without roll.
    """
    if geometry.camera is not None:
        return CameraPose(np.array(geometry.camera.position_mm), np.array(geometry.camera.rotation))
    a_mm, _, alpha = _short(geometry)
    forward = np.array([-cos(alpha), 0.0, -sin(alpha)])
    right = np.array([sin(alpha), 0.0, -cos(alpha)])  # world +x as far as it is across the axis
    return CameraPose(-a_mm * forward, np.stack([right, np.cross(forward, right), forward]))


def screen_pose(geometry: GeometryConfig, error: ScreenError | None = None) -> ScreenPose:
    """Pose of the screen: as given, or O' = b (-cos alpha, 0, sin alpha) and perpendicular to OO';
    then the error.
    """
    face = geometry.screen or ScreenPoseConfig()
    given = face.pose
    if given is not None:
        origin, s_x, s_y = (np.array(vector) for vector in given)
    else:
        _, b_mm, alpha = _short(geometry)
        origin = b_mm * np.array([-cos(alpha), 0.0, sin(alpha)])
        s_x, s_y = np.array([-sin(alpha), 0.0, -cos(alpha)]), np.array([0.0, 1.0, 0.0])
    error = error or ScreenError()
    s_y = _turned(s_y, s_x, radians(error.tilt_about_x_deg))
    s_x = _turned(s_x, s_y, radians(error.tilt_about_y_deg))
    return ScreenPose(
        origin, s_x, s_y, (face.bow_mm + error.bow_mm) / _BOW_RADIUS_MM**2, face.height_map
    )


def pixel_directions(
    camera: CameraConfig, pose: CameraPose, columns: FloatArray, rows: FloatArray
) -> FloatArray:
    """Unit vectors in world (N, 3) of the rays through the given pixel positions (N,), lens
    distortion undone.
    """
    focal_px = camera.focal_mm * 1000.0 / camera.pixel_um
    c0, r0 = camera.principal
    x, y = _undistorted((columns - c0) / focal_px, (rows - r0) / focal_px, camera.distortion)
    in_world = np.stack([x, y, np.ones_like(x)], axis=1) @ pose.rotation
    return np.asarray(in_world / np.linalg.norm(in_world, axis=1, keepdims=True), dtype=np.float64)


def _undistorted(
    x_d: FloatArray, y_d: FloatArray, distortion: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Undo OpenCV's lens model, x_d = x radial(r^2) + tangential(x, y), by fixed-point iteration to
    the last bit.
    """
    if not distortion:
        return x_d, y_d
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *[0.0] * 8)[:8]
    x, y = x_d, y_d
    for _ in range(_UNDISTORT_STEPS):
        r2 = x * x + y * y
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        x_next = (x_d - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / radial
        y_next = (y_d - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / radial
        change = max(float(np.abs(x_next - x).max()), float(np.abs(y_next - y).max()))
        x, y = x_next, y_next
        if change < _UNDISTORT_TOLERANCE:
            return x, y
    raise ValueError(
        f"camera.distortion = {distortion} folds the picture: it cannot be undone at its edge"
    )


def _short(geometry: GeometryConfig) -> tuple[float, float, float]:
    """a in mm, b in mm, alpha in rad; the configuration ensures that one of the two forms is
    complete.
    """
    if geometry.a_mm is None or geometry.b_mm is None or geometry.alpha_deg is None:
        raise ValueError("geometry: neither a_mm, b_mm, alpha_deg nor camera and screen poses")
    return geometry.a_mm, geometry.b_mm, radians(geometry.alpha_deg)


def _turned(vector: FloatArray, axis: FloatArray, angle_rad: float) -> FloatArray:
    """A vector across the unit `axis`, turned about it (Rodrigues,
    whose third term vanishes here).
    """
    return vector * cos(angle_rad) + np.cross(axis, vector) * sin(angle_rad)


# The twin's screen face: rays continued from the screen's plane to the true face.
#
# A ray that crosses the plane at (u, v) with tangents (a, b) to its normal is at (u + a w, v + b w)
# at a distance w from the plane. On the face w = c (u^2 + v^2) + map(u, v): solved by fixed-point
# iteration, each step of which gains the product of the face's slope and the tangents, a factor of
# 50 or more.

_TOLERANCE_MM = 1e-11
_FACE_MAX_STEPS = 50  # a grazing ray may never converge


def onto_face(
    place_mm: FloatArray,
    tangents: FloatArray,
    bow_per_mm: float,
    height_map: HeightMapConfig | None,
) -> FloatArray:
    """s_x and s_y (2, N) on the face of rays that cross the plane at `place_mm` (2, N) with
    `tangents` (2, N).
    """
    if bow_per_mm == 0.0 and height_map is None:
        return place_mm
    spline = None if height_map is None else _spline(height_map)
    found = place_mm
    for _ in range(_FACE_MAX_STEPS):
        off_mm = bow_per_mm * np.sum(found**2, axis=0)
        if spline is not None:
            off_mm = off_mm + spline.ev(found[1], found[0])
        last, found = found, place_mm + off_mm * tangents
        if not np.nanmax(np.abs(found - last), initial=0.0) > _TOLERANCE_MM:
            break
    return found


def _spline(height_map: HeightMapConfig) -> RectBivariateSpline:
    """Through the nodes, cubic along an axis with four or more of them; beyond the grid its edge's
    height goes on.
    """
    rows, columns = (min(3, len(axis) - 1) for axis in (height_map.s_y_mm, height_map.s_x_mm))
    return RectBivariateSpline(
        height_map.s_y_mm, height_map.s_x_mm, height_map.heights_mm, kx=rows, ky=columns
    )


_BEYOND = 1.1  # rays beyond this share of the radius are not traced: polynomials diverge there
_MAX_STEPS = 20  # Newton needs 4 on any bowl; a grazing ray may never converge


@dataclass(frozen=True, slots=True)
class Trace:
    """Where rays met film and screen, each (N,), in mm.

    `x_mm`, `y_mm`: on the film, or on the plane of its rim for rays far outside it, which are not
    traced; NaN for rays that never come down on that plane. `s_x_mm`, `s_y_mm`: on the screen; 0
    for rays that are not traced, NaN for those that never reach the screen.
    """

    x_mm: FloatArray
    y_mm: FloatArray
    s_x_mm: FloatArray
    s_y_mm: FloatArray

    def on_film(self, radius_mm: float) -> BoolArray:
        """Which rays met the film inside its rim, (N,)."""
        return self.x_mm**2 + self.y_mm**2 <= radius_mm**2


def trace(
    camera: CameraPose,
    directions: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    screen: ScreenPose,
) -> Trace:
    """Follow rays, unit vectors (N, 3) in world, from the pinhole over the film to the screen.

    The film is the surface z = vertex_z_mm + h(x, y), its bowl `sag_mm` deep.
    """
    hits = _trace(
        camera.position_mm,
        np.ascontiguousarray(directions),
        film,
        sag_mm,
        vertex_z_mm,
        screen.origin_mm,
        np.stack([screen.s_x, screen.s_y, np.cross(screen.s_x, screen.s_y)]),
    )
    s_x_mm, s_y_mm = onto_face(hits[2:4], hits[4:6], screen.bow_per_mm, screen.height_map)
    return Trace(hits[0], hits[1], s_x_mm, s_y_mm)


@njit(cache=True)
def _film_distance(
    start: FloatArray,
    direction: FloatArray,
    film: FilmTerms,
    sag_mm: float,
    vertex_z_mm: float,
    guess_mm: float,
) -> float:
    """Path from `start` to the film along a unit vector; NaN if Newton does not converge.

    f(t) = z(t) - vertex_z - h(x(t), y(t)) = 0 with f' = d_z - h_x d_x - h_y d_y.
    """
    t = guess_mm
    for _ in range(_MAX_STEPS):
        h, hx, hy = height_and_slopes(
            film, sag_mm, start[0] + t * direction[0], start[1] + t * direction[1]
        )
        miss = start[2] + t * direction[2] - vertex_z_mm - h
        step = miss / (direction[2] - hx * direction[0] - hy * direction[1])
        t -= step
        if abs(step) < _TOLERANCE_MM:
            return float(t)
    return float(np.nan)


@njit(cache=True)
def _plane_point(
    p: FloatArray, direction: FloatArray, origin: FloatArray, axes: FloatArray
) -> tuple[float, float, float, float]:
    """s_x and s_y where a ray from `p` crosses the screen's plane, and its tangents; NaN if it runs
    away from it.

    In the screen's axes the ray is q + t r.
    """
    q, r = axes @ (p - origin), axes @ direction
    if q[2] * r[2] >= 0.0:
        return np.nan, np.nan, np.nan, np.nan
    t = -q[2] / r[2]
    return q[0] + t * r[0], q[1] + t * r[1], r[0] / r[2], r[1] / r[2]


@njit(cache=True)
def _trace(
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
    normal, p = np.empty(3), np.empty(3)
    for n in range(directions.shape[0]):
        d = directions[n]
        if d[2] >= 0.0 or start[2] <= rim_z_mm:  # never comes down on the film
            hits[:, n] = np.nan
            continue
        to_rim_mm = (rim_z_mm - start[2]) / d[2]
        hits[0, n], hits[1, n] = start[0] + to_rim_mm * d[0], start[1] + to_rim_mm * d[1]
        if hits[0, n] ** 2 + hits[1, n] ** 2 > beyond:
            continue
        t = _film_distance(start, d, film, sag_mm, vertex_z_mm, to_rim_mm)
        if np.isnan(t):
            hits[2:, n] = np.nan
            continue
        for axis in range(3):
            p[axis] = start[axis] + t * d[axis]
        _, hx, hy = height_and_slopes(film, sag_mm, p[0], p[1])
        normal[0], normal[1], normal[2] = -hx, -hy, 1.0
        # law of reflection: r = d - 2 (d n) n / (n n)
        reflected = d - (2.0 * np.dot(d, normal) / np.dot(normal, normal)) * normal
        hits[0, n], hits[1, n] = p[0], p[1]
        hits[2, n], hits[3, n], hits[4, n], hits[5, n] = _plane_point(p, reflected, origin, axes)
    return hits
