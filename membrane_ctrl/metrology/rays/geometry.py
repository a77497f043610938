"""Camera and screen in world coordinates: the one form that the code uses
(docs/reference/interfaces.md).

The short form is converted to it on loading. With the camera at F = a (cos alpha, 0, sin alpha)
looking at O without roll, image down is world -y, forward is -F / a, and image right is the unit
vector normal to both that points towards +x: (sin alpha, 0, -cos alpha).
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from membrane_ctrl.config.schema import GeometryConfig, MirrorConfig, OpticsConfig
from membrane_ctrl.config.sight import compute_poses
from membrane_ctrl.metrology.numerics.vectors import vector_lengths
from membrane_ctrl.metrology.rays.cushion import Cushion
from membrane_ctrl.metrology.rays.gas_lens import GasLens, trace_gas_lens
from membrane_ctrl.metrology.rays.lens_distortion import distort_points, undistort_points
from membrane_ctrl.metrology.rays.screen_face import Face
from membrane_ctrl.model.arrays import ArrayLike, FloatArray


@dataclass(frozen=True)
class Geometry:
    """Poses of camera and screen, and the lens.

    Attributes
    ----------
    pinhole_mm : (3,) array
        Camera pinhole F in world.
    rotation : (3, 3) array
        Rows are the camera's x (right), y (down) and z (forward) in world.
    focal_px : float
        Focal length over the pixels' pitch.
    principal_px : tuple[float, float]
        Column and row of the principal point.
    distortion : tuple of float
        OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for a pinhole.
    screen_origin_mm : (3,) array
        O' in world.
    screen_s_x, screen_s_y : (3,) arrays
        Unit vectors of s_x and s_y in world.
    face : Face
        Deviation of the screen from the plane of s_x and s_y.
    cushion : Cushion, optional
        The film in front of the mirror.
    gas_lens : GasLens, optional
        How it moves the screen points of the mirror.
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
    cushion: Cushion | None = None
    gas_lens: GasLens | None = None

    @classmethod
    def from_config(cls, optics: OpticsConfig) -> "Geometry":
        """The geometry a configuration describes."""
        camera = optics.camera
        pinhole, rotation, origin, s_x, s_y = compute_poses(optics.geometry)
        return cls(
            pinhole_mm=pinhole,
            rotation=rotation,
            focal_px=camera.focal_mm / (camera.pixel_um * 1e-3),
            principal_px=camera.principal,
            distortion=camera.distortion,
            screen_origin_mm=origin,
            screen_s_x=s_x,
            screen_s_y=s_y,
            face=Face.from_config(optics.geometry.screen),
            cushion=Cushion.from_config(optics.mirror),
            gas_lens=_find_gas_lens(optics.geometry, optics.mirror),
        )

    def without_front_film(self) -> "Geometry":
        """The same bench with a single film."""
        return replace(self, cushion=None, gas_lens=None)

    def rays(self, columns_px: ArrayLike, rows_px: ArrayLike) -> FloatArray:
        """Rays from the pinhole through image points.

        Parameters
        ----------
        columns_px, rows_px : (...) arrays
            Image points; pixel centres are integers.

        Returns
        -------
        (3, ...) array
            Unit vectors in world; NaN where no ray belongs to a point of a distorted picture.
        """
        columns, rows = np.broadcast_arrays(
            np.asarray(columns_px, float), np.asarray(rows_px, float)
        )

        # Tangents to the axis, without the lens' distortion; z forward, then turned into world.
        x = (columns - self.principal_px[0]) / self.focal_px
        y = (rows - self.principal_px[1]) / self.focal_px
        if any(self.distortion):
            x, y = undistort_points(x, y, self.distortion)
        camera = np.stack([x, y, np.ones_like(x)])
        camera /= vector_lengths(camera)
        return np.asarray(np.tensordot(self.rotation.T, camera, axes=1))

    @property
    def screen_axes(self) -> FloatArray:
        """Unit vectors of s_x, s_y and of the normal towards the mirror, as rows (3,
        3) in world.
        """
        return np.stack(
            [self.screen_s_x, self.screen_s_y, np.cross(self.screen_s_x, self.screen_s_y)]
        )

    def screen_points(self, screen_mm: FloatArray) -> FloatArray:
        """World points (3, ...) on the face at screen coordinates (2, ...) in mm from O'."""
        origin = self.screen_origin_mm.reshape(3, *[1] * (screen_mm.ndim - 1))
        in_screen = np.concatenate([screen_mm, self.face.heights(screen_mm)[:1]])
        return np.asarray(origin + np.tensordot(self.screen_axes.T, in_screen, axes=1))


@lru_cache(maxsize=16)
def _find_gas_lens(geometry: GeometryConfig, mirror: MirrorConfig) -> GasLens | None:
    """The gas lens of a configured bench; None for a single film."""
    cushion = Cushion.from_config(mirror)
    if cushion is None:
        return None
    pinhole, _rotation, origin, s_x, s_y = compute_poses(geometry)
    axes = np.stack([s_x, s_y, np.cross(s_x, s_y)])
    return trace_gas_lens(cushion, pinhole, origin, axes)


def project_points(geometry: Geometry, world_mm: FloatArray) -> FloatArray:
    """Project world points into the picture, through the lens.

    Parameters
    ----------
    geometry : Geometry
    world_mm : (3, n) array
        Points in front of the camera.

    Returns
    -------
    (2, n) array
        Column and row in pixels.
    """
    camera = geometry.rotation @ (world_mm - geometry.pinhole_mm[:, None])
    through = camera[:2] / camera[2]
    if any(geometry.distortion):
        through = distort_points(through[0], through[1], geometry.distortion)
    column, row = geometry.focal_px * through
    return np.stack([column + geometry.principal_px[0], row + geometry.principal_px[1]])
