"""Poses of the simulated camera and screen, and the rays through the camera's pixels.

World: origin at the mirror's vertex, x horizontal, y up, z out of the reflective side; mm.
"""

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np

from membrane_ctrl.config.optics import (
    CameraConfig,
    GeometryConfig,
    HeightMapConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.model.arrays import FloatArray

_UNDISTORT_STEPS = 200  # each gains about a digit with a usual lens
_UNDISTORT_TOLERANCE = 1e-14  # tangent of the ray's angle
_BOW_RADIUS_MM = 200.0  # half side of the paper's pattern region, rounded


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Pose of the camera.

    Attributes
    ----------
    position_mm : (3,) array
        Pinhole in world.
    rotation : (3, 3) array
        Rows: camera x (right), y (down) and z (forward) in world.
    """

    position_mm: FloatArray
    rotation: FloatArray


@dataclass(frozen=True, slots=True)
class ScreenPose:
    """Pose and face of the screen.

    The face deviates from the plane by bow_per_mm (s_x^2 + s_y^2) and the map, towards s_x x s_y,
    which points at the mirror.

    Attributes
    ----------
    origin_mm : (3,) array
        O' in world.
    s_x, s_y : (3,) arrays
        Unit vectors in world.
    bow_per_mm : float
        Coefficient of the bow.
    height_map : HeightMapConfig or None
        A measured map.
    """

    origin_mm: FloatArray
    s_x: FloatArray
    s_y: FloatArray
    bow_per_mm: float = 0.0
    height_map: HeightMapConfig | None = None


@dataclass(frozen=True, slots=True)
class ScreenError:
    """Deviation of a screen from its nominal pose.

    Attributes
    ----------
    tilt_about_x_deg, tilt_about_y_deg : float
        Turns about its own s_x and s_y axes (right-handed).
    bow_mm : float
        Deviation of the face towards the mirror, 200 mm away from O' (paraboloid; s_x and s_y count
        along the flat plane).
    """

    tilt_about_x_deg: float = 0.0
    tilt_about_y_deg: float = 0.0
    bow_mm: float = 0.0


def camera_pose(geometry: GeometryConfig) -> CameraPose:
    """Pose of the camera: as given, or F = a (cos alpha, 0, sin alpha), looking at O without
    roll.
    """
    if geometry.camera is not None:
        return CameraPose(np.array(geometry.camera.position_mm), np.array(geometry.camera.rotation))

    # Forward points from F to O.
    a_mm, _, alpha = _find_short_form(geometry)
    forward = np.array([-cos(alpha), 0.0, -sin(alpha)])
    right = np.array([sin(alpha), 0.0, -cos(alpha)])  # world +x as far as it is across the axis
    return CameraPose(-a_mm * forward, np.stack([right, np.cross(forward, right), forward]))


def screen_pose(geometry: GeometryConfig, error: ScreenError | None = None) -> ScreenPose:
    """Return the pose of the screen: as given, or O' = b (-cos alpha, 0, sin alpha) and
    perpendicular to OO'; then the error.

    Parameters
    ----------
    geometry : GeometryConfig
        The stated bench.
    error : ScreenError or None
        By which the true screen differs from it.
    """
    # The stated pose, in either form of a geometry.
    face = geometry.screen or ScreenPoseConfig()
    given = face.pose
    if given is not None:
        origin_mm, s_x, s_y = (np.array(vector) for vector in given)
    else:
        _, b_mm, alpha = _find_short_form(geometry)
        origin_mm = b_mm * np.array([-cos(alpha), 0.0, sin(alpha)])
        s_x = np.array([-sin(alpha), 0.0, -cos(alpha)])
        s_y = np.array([0.0, 1.0, 0.0])

    # The error: about s_x first, then about the s_y that is turned by it; its bow adds to the face.
    error = error or ScreenError()
    s_y = _rotate_vector(s_y, s_x, radians(error.tilt_about_x_deg))
    s_x = _rotate_vector(s_x, s_y, radians(error.tilt_about_y_deg))
    bow_per_mm = (face.bow_mm + error.bow_mm) / _BOW_RADIUS_MM**2
    return ScreenPose(origin_mm, s_x, s_y, bow_per_mm, face.height_map)


def pixel_directions(
    camera: CameraConfig, pose: CameraPose, columns: FloatArray, rows: FloatArray
) -> FloatArray:
    """Return the rays through pixel positions; the distortion of the lens is taken out of these.

    Parameters
    ----------
    camera : CameraConfig
        Focal length, pixel pitch, principal point and distortion.
    pose : CameraPose
        Pose of the camera in world.
    columns, rows : (N,) array
        Pixel positions.

    Returns
    -------
    (N, 3) array
        Unit vectors in world.
    """
    # Tangents of the angle to the axis in the picture, without the lens' distortion, in world.
    focal_px = camera.focal_mm * 1000.0 / camera.pixel_um
    column_px, row_px = camera.principal
    pictured_x = (columns - column_px) / focal_px
    pictured_y = (rows - row_px) / focal_px
    x, y = _undistort_points(pictured_x, pictured_y, camera.distortion)
    in_world = np.stack([x, y, np.ones_like(x)], axis=1) @ pose.rotation
    return np.asarray(in_world / np.linalg.norm(in_world, axis=1, keepdims=True), dtype=np.float64)


def _undistort_points(
    x_d: FloatArray, y_d: FloatArray, distortion: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Undo OpenCV's lens model, x_d = x radial(r^2) + tangential(x, y), by fixed-point iteration to
    the last bit.
    """
    if not distortion:
        return x_d, y_d

    # OpenCV's order; coefficients that are not given are 0.
    k1, k2, p1, p2, k3, k4, k5, k6 = (*distortion, *[0.0] * 8)[:8]
    x = x_d
    y = y_d
    for _ in range(_UNDISTORT_STEPS):
        # x <- (x_d - tangential(x, y)) / radial(r^2)
        r2 = x * x + y * y
        numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = numerator / denominator
        x_next = (x_d - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / radial
        y_next = (y_d - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / radial
        change_x = float(np.abs(x_next - x).max())
        change_y = float(np.abs(y_next - y).max())
        x = x_next
        y = y_next
        if max(change_x, change_y) < _UNDISTORT_TOLERANCE:
            return x, y
    raise ValueError(
        f"camera.distortion = {distortion} folds the picture: it cannot be undone at its edge"
    )


def _find_short_form(geometry: GeometryConfig) -> tuple[float, float, float]:
    """a in mm, b in mm, alpha in rad; the configuration ensures that one of the two forms is
    complete.
    """
    if geometry.a_mm is None or geometry.b_mm is None or geometry.alpha_deg is None:
        raise ValueError("geometry: neither a_mm, b_mm, alpha_deg nor camera and screen poses")
    return geometry.a_mm, geometry.b_mm, radians(geometry.alpha_deg)


def _rotate_vector(vector: FloatArray, axis: FloatArray, angle_rad: float) -> FloatArray:
    """A vector across the unit `axis`, turned about it (Rodrigues, whose third term vanishes
    here).
    """
    return vector * cos(angle_rad) + np.cross(axis, vector) * sin(angle_rad)
