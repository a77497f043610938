"""Camera and screen in world coordinates: the one form the code behind knows (INTERFACES section 1).

The short form is turned into it on loading. With the camera at F = a (cos alpha, 0, sin alpha) looking at O
without roll, image down is world -y, forward is -F / a, and image right is the unit vector normal to both that points
towards +x: (sin alpha, 0, -cos alpha).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from membrane_ctrl.config import GeometryConfig, OpticsConfig
from membrane_ctrl.metrology.face import Face

FloatArray = NDArray[np.float64]

_UNDONE = 1e-9  # of a tangent: 5e-6 of a pixel of the paper's lens


@dataclass(frozen=True)
class Geometry:
    """Where camera and screen stand and how the lens maps.

    Attributes
    ----------
    pinhole_mm : (3,) array
        Camera pinhole F in world.
    rotation : (3, 3) array
        Rows are the camera's x (right), y (down) and z (forward) in world.
    focal_px : float
        Focal length in pixels.
    principal_px : (column, row)
        Principal point.
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for a pinhole.
    screen_origin_mm : (3,) array
        O' in world.
    screen_s_x, screen_s_y : (3,) arrays
        Unit vectors of s_x and s_y in world.
    face : Face
        How the screen stands off the plane of s_x and s_y.
    """

    pinhole_mm: FloatArray
    rotation: FloatArray
    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, ...]
    screen_origin_mm: FloatArray
    screen_s_x: FloatArray
    screen_s_y: FloatArray
    face: Face

    @classmethod
    def from_config(cls, optics: OpticsConfig) -> Geometry:
        """The geometry a configuration describes."""
        camera = optics.camera
        pinhole, rotation, origin, s_x, s_y = _poses(optics.geometry)
        return cls(
            pinhole_mm=pinhole,
            rotation=rotation,
            focal_px=camera.focal_mm / (camera.pixel_um * 1e-3),
            principal_px=camera.principal,
            distortion=camera.distortion,
            screen_origin_mm=origin,
            screen_s_x=s_x,
            screen_s_y=s_y,
            face=Face.of(optics.geometry.screen),
        )

    def rays(self, columns_px: ArrayLike, rows_px: ArrayLike) -> FloatArray:
        """Unit vectors in world, (3, ...), from the pinhole through image points (pixel centres are integers)."""
        columns, rows = np.broadcast_arrays(np.asarray(columns_px, float), np.asarray(rows_px, float))
        x = (columns - self.principal_px[0]) / self.focal_px
        y = (rows - self.principal_px[1]) / self.focal_px
        if any(self.distortion):
            x, y = _undistort(x, y, self.distortion)
        camera = np.stack([x, y, np.ones_like(x)])
        camera /= np.linalg.norm(camera, axis=0)
        return np.asarray(np.tensordot(self.rotation.T, camera, axes=1))

    @property
    def screen_axes(self) -> FloatArray:
        """Unit vectors of s_x, s_y and of the normal towards the mirror, as rows (3, 3) in world."""
        return np.stack([self.screen_s_x, self.screen_s_y, np.cross(self.screen_s_x, self.screen_s_y)])

    def screen_points(self, screen_mm: FloatArray) -> FloatArray:
        """World points (3, ...) on the face at screen coordinates (2, ...) in mm from O'."""
        origin = self.screen_origin_mm.reshape(3, *[1] * (screen_mm.ndim - 1))
        in_screen = np.concatenate([screen_mm, self.face.heights(screen_mm)[:1]])
        return np.asarray(origin + np.tensordot(self.screen_axes.T, in_screen, axes=1))


def _poses(config: GeometryConfig) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pinhole, rotation, O', s_x, s_y in world from either form."""
    screen = None if config.screen is None else config.screen.pose
    if config.camera is not None and screen is not None:
        general = (config.camera.position_mm, config.camera.rotation, *screen)
        pinhole, rotation, origin, s_x, s_y = (np.array(value, float) for value in general)
        return pinhole, rotation, origin, s_x, s_y
    if config.a_mm is None or config.b_mm is None or config.alpha_deg is None:
        raise ValueError("geometry has neither a_mm, b_mm, alpha_deg nor both poses")
    cosine, sine = math.cos(math.radians(config.alpha_deg)), math.sin(math.radians(config.alpha_deg))
    rotation = np.array([[sine, 0.0, -cosine], [0.0, -1.0, 0.0], [-cosine, 0.0, -sine]])
    return (
        config.a_mm * np.array([cosine, 0.0, sine]),
        rotation,
        config.b_mm * np.array([-cosine, 0.0, sine]),
        np.array([-sine, 0.0, -cosine]),
        np.array([0.0, 1.0, 0.0]),
    )


def _undistort(x: FloatArray, y: FloatArray, distortion: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Normalised pinhole coordinates of distorted ones; iterated until the last digit stands still.

    NaN where the way back does not lead to the point, or leads to one beyond a fold of the model, where distance from
    the axis falls again: no ray, or not this one, belongs to such a point.
    """
    points, lens = np.stack([x.ravel(), y.ravel()], axis=1), np.array(distortion)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    solved = cv2.undistortPoints(points[:, None], np.eye(3), lens, None, None, None, criteria)
    straight: FloatArray = np.asarray(solved, np.float64)[:, 0]
    back = distort(straight[:, 0], straight[:, 1], distortion)
    undone = np.abs(back.T - points).max(axis=1) <= _UNDONE
    straight[~undone | (np.hypot(*straight.T) > _fold(distortion))] = np.nan
    return straight[:, 0].reshape(x.shape), straight[:, 1].reshape(x.shape)


def _fold(distortion: tuple[float, ...]) -> float:
    """Distance from the axis, as a tangent, at which the lens' radial part stops growing; at most 2 (63 degrees)."""
    radius: FloatArray = np.linspace(0.0, 2.0, 2001)
    radial = (*distortion[:2], 0.0, 0.0, *distortion[4:])
    falls = np.diff(distort(radius, np.zeros_like(radius), radial)[0]) <= 0
    return float(radius[np.argmax(falls)]) if falls.any() else float(radius[-1])


def distort(x: FloatArray, y: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    """Distorted coordinates (2, n) of normalised pinhole ones, by OpenCV's model."""
    through = np.stack([x, y, np.ones_like(x)], axis=1)
    seen = cv2.projectPoints(through, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))[0]
    return np.asarray(seen[:, 0].T, np.float64)
