"""Camera and screen in world coordinates: the one form that the code uses
(docs/reference/interfaces.md).

The short form is converted to it on loading. With the camera at F = a (cos alpha, 0, sin alpha)
looking at O without roll, image down is world -y, forward is -F / a, and image right is the unit
vector normal to both that points towards +x: (sin alpha, 0, -cos alpha).

The screen's face: its deviation from its plane, w(s_x, s_y), towards the mirror (along s_x x s_y).

w = c (s_x^2 + s_y^2) + map(s_x, s_y): a bow, and a bicubic spline through the nodes of a measured
grid. The spline is kept as its polynomial in each cell, sum of C[m, n] v^m u^n with u and v from 0
to 1 across the cell, so that a loop needs one look-up and a Horner scheme. Beyond the grid the
height of its edge continues.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from membrane_ctrl.config.optics import HeightMapConfig, ScreenPoseConfig
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.config.sight import poses
from membrane_ctrl.metrology.numerics.compiled import kernel, step
from membrane_ctrl.model.arrays import ArrayLike, FloatArray

BOW_RADIUS_MM = 200.0  # where `bow_mm` is counted: half the paper's pattern, rounded
_ORDER = 4  # coefficients of a cubic


class Face(NamedTuple):
    """A face; a named tuple, since compiled loops take one as it is."""

    bow_per_mm: float  # c, in 1/mm
    # (rows, columns, 4, 4): polynomials of the map's cells, along s_y and s_x; without cells there
    # is no map
    cells_mm: FloatArray
    low_mm: FloatArray  # (2,): first node along s_x and s_y
    pitch_mm: FloatArray  # (2,): distance of the nodes

    @classmethod
    def of(cls, screen: ScreenPoseConfig | None) -> "Face":
        """The face that a configuration describes; a plane for None."""
        bow_mm = 0.0 if screen is None else screen.bow_mm
        cells, low, pitch = _cells(None if screen is None else screen.height_map)
        return cls(bow_mm / BOW_RADIUS_MM**2, cells, low, pitch)

    @property
    def is_plane(self) -> bool:
        """Whether nothing stands off."""
        return bool(is_plane(self))

    def heights(self, screen_mm: FloatArray) -> FloatArray:
        """w, dw/ds_x and dw/ds_y, (3, ...), in mm and without unit, at screen coordinates (2, ...)
        in mm.
        """
        flat = np.ascontiguousarray(screen_mm.reshape(2, -1))
        out = np.empty((3, flat.shape[1]))
        _heights(self, flat, out)
        return out.reshape(3, *screen_mm.shape[1:])


def _cells(config: HeightMapConfig | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cells, first nodes and distances of the nodes of a map."""
    if config is None:
        return np.zeros((0, 0, _ORDER, _ORDER)), np.zeros(2), np.ones(2)
    along_y = _taylor(np.array(config.heights_mm), np.array(config.s_y_mm))
    both = _taylor(along_y.transpose(2, 0, 1), np.array(config.s_x_mm))  # column, n, row, m
    ends = np.array([(axis[0], axis[-1], len(axis) - 1) for axis in (config.s_x_mm, config.s_y_mm)])
    cells = np.ascontiguousarray(both.transpose(2, 0, 3, 1))
    return cells, ends[:, 0].copy(), (ends[:, 1] - ends[:, 0]) / ends[:, 2]


def _taylor(values: FloatArray, nodes_mm: FloatArray) -> FloatArray:
    """Coefficients (cells, 4, ...) of the spline through values (nodes, ...), in powers of the
    share of a cell.
    """
    from scipy.interpolate import (
        make_interp_spline,
    )  # loads for a third of a second; most screens have no map

    degree = min(_ORDER, nodes_mm.size) - 1
    spline = make_interp_spline(nodes_mm, values, k=degree)
    pitch = (nodes_mm[-1] - nodes_mm[0]) / (nodes_mm.size - 1)
    out = np.zeros((nodes_mm.size - 1, _ORDER, *values.shape[1:]))
    for m in range(degree + 1):
        out[:, m] = spline(nodes_mm[:-1], nu=m) * (pitch**m / math.factorial(m))
    return out


@step
def is_plane(face):  # type: ignore[no-untyped-def]
    """Whether nothing stands off."""
    return face.bow_per_mm == 0 and face.cells_mm.shape[0] == 0


@step
def face_height(face, a, b):  # type: ignore[no-untyped-def]
    """w, dw/ds_x and dw/ds_y at a point."""
    w = face.bow_per_mm * (a * a + b * b)
    wa = 2 * face.bow_per_mm * a
    wb = 2 * face.bow_per_mm * b
    rows, columns = face.cells_mm.shape[0], face.cells_mm.shape[1]
    if rows > 0:
        u = (a - face.low_mm[0]) / face.pitch_mm[0]
        v = (b - face.low_mm[1]) / face.pitch_mm[1]
        inside_u, inside_v = 0.0 <= u <= columns, 0.0 <= v <= rows
        u, v = min(max(u, 0.0), float(columns)), min(max(v, 0.0), float(rows))
        column, row = min(int(u), columns - 1), min(int(v), rows - 1)
        u -= column
        v -= row
        h = 0.0
        hu = 0.0
        hv = 0.0
        for m in range(3, -1, -1):
            line = 0.0
            slope = 0.0
            for n in range(3, -1, -1):
                slope = slope * u + line
                line = line * u + face.cells_mm[row, column, m, n]
            hv = hv * v + h
            h = h * v + line
            hu = hu * v + slope
        w += h
        wa += hu / face.pitch_mm[0] if inside_u else 0.0
        wb += hv / face.pitch_mm[1] if inside_v else 0.0
    return w, wa, wb


@kernel
def _heights(face, screen_mm, out):  # type: ignore[no-untyped-def]
    for p in range(screen_mm.shape[1]):
        out[0, p], out[1, p], out[2, p] = face_height(face, screen_mm[0, p], screen_mm[1, p])


_UNDONE = 1e-9  # of a tangent: 5e-6 of a pixel of the paper's lens


@dataclass(frozen=True)
class Geometry:
    """Poses of camera and screen, and the lens."""

    pinhole_mm: FloatArray  # (3,): camera pinhole F in world
    rotation: (
        FloatArray  # (3, 3): rows are the camera's x (right), y (down) and z (forward) in world
    )
    focal_px: float
    principal_px: tuple[float, float]  # column, row
    distortion: tuple[
        float, ...
    ]  # OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; empty for a pinhole
    screen_origin_mm: FloatArray  # (3,): O' in world
    screen_s_x: FloatArray  # (3,): unit vectors of s_x and s_y in world
    screen_s_y: FloatArray  # (3,)
    face: Face  # how the screen deviates from the plane of s_x and s_y

    @classmethod
    def from_config(cls, optics: OpticsConfig) -> "Geometry":
        """The geometry a configuration describes."""
        camera = optics.camera
        pinhole, rotation, origin, s_x, s_y = poses(optics.geometry)
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
        """Unit vectors in world, (3, ...), from the pinhole through image points (pixel centres are
        integers).
        """
        columns, rows = np.broadcast_arrays(
            np.asarray(columns_px, float), np.asarray(rows_px, float)
        )
        x = (columns - self.principal_px[0]) / self.focal_px
        y = (rows - self.principal_px[1]) / self.focal_px
        if any(self.distortion):
            x, y = _undistort(x, y, self.distortion)
        camera = np.stack([x, y, np.ones_like(x)])
        camera /= np.linalg.norm(camera, axis=0)
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


def _undistort(
    x: FloatArray, y: FloatArray, distortion: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """Normalised pinhole coordinates of distorted ones; iterated until the last digit is stable.

    NaN where the iteration does not reach the point, or reaches one beyond a fold of the model,
    where the distance from the axis falls again: no ray, or another one, belongs to such a point.
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
    """Distance from the axis, as a tangent, at which the lens' radial part stops growing; at most 2
    (63 degrees).
    """
    radius: FloatArray = np.linspace(0.0, 2.0, 2001)
    radial = (*distortion[:2], 0.0, 0.0, *distortion[4:])
    falls = np.diff(distort(radius, np.zeros_like(radius), radial)[0]) <= 0
    return float(radius[np.argmax(falls)]) if falls.any() else float(radius[-1])


def distort(x: FloatArray, y: FloatArray, distortion: tuple[float, ...]) -> FloatArray:
    """Distorted coordinates (2, n) of normalised pinhole ones, by OpenCV's model."""
    through = np.stack([x, y, np.ones_like(x)], axis=1)
    seen = cv2.projectPoints(through, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))[0]
    return np.asarray(seen[:, 0].T, np.float64)


# The mirror's rim in the picture: where the light ends, against where the camera's pose puts the
# rim.
#
# A circle on the mirror is an ellipse in the picture. The pose predicts points of the rim; the edge
# of the light is searched along the line from the middle through each. The edge is at half the
# light well inside.

_POINTS = 180
_FROM, _TO = 0.85, 1.15  # of the expected radius
_SAMPLES = 121
_LEAST_FOUND = 0.4


@dataclass(frozen=True)
class Outline:
    """The rim as seen and as expected."""

    rim_px: FloatArray  # (2, n): column and row of the rim's points that were found
    centre_px: tuple[float, float]  # centre of the ellipse that fits them
    expected_px: tuple[float, float]  # that of the ellipse which the pose predicts
    offset_mm: float  # distance of the two, on the mirror
    size_ratio: float  # seen over expected, mean radius


def light_at(light: FloatArray, places_px: FloatArray) -> FloatArray:
    """Light (H, W) between pixels, at columns and rows (2, ...); NaN outside. SciPy's would load
    for 0.2 s.
    """
    far = np.array(light.shape[::-1]).reshape(2, *[1] * (places_px.ndim - 1)) - 1
    inside = ((places_px >= 0) & (places_px <= far)).all(axis=0)
    column, row = low = np.clip(np.floor(np.where(inside, places_px, 0.0)), 0, far - 1).astype(int)
    right, down = places_px - low
    upper, lower = (
        (1 - right) * light[k, column] + right * light[k, column + 1] for k in (row, row + 1)
    )
    return np.where(inside, (1 - down) * upper + down * lower, np.nan)


def find_outline(
    light: FloatArray, geometry: Geometry, rim_mm: float, rim_z_mm: float
) -> Outline | None:
    """Look for the rim.

    Parameters
    ----------
    light : (H, W) array
        White minus black, or the fringes' mean.
    rim_mm, rim_z_mm : float
        Radius of the rim, and the height of its plane in world (the sag).

    Returns
    -------
    Outline or None
        None if the rim is not in the picture (a stop inside it, a pattern too small to light it).
    """
    theta = 2 * np.pi * np.arange(_POINTS) / _POINTS
    circle = np.stack([rim_mm * np.cos(theta), rim_mm * np.sin(theta), np.full(_POINTS, rim_z_mm)])
    expected = project(geometry, circle)
    middle = expected.mean(axis=1)
    reach = np.linspace(_FROM, _TO, _SAMPLES)
    lines = middle[:, None, None] + (expected - middle[:, None])[:, :, None] * reach
    values = light_at(light, lines)
    whole = np.isfinite(values).all(axis=1)  # a line that leaves the picture is not used
    inside = np.where(whole, np.median(values[:, :10], axis=1), 0.0)
    below = values < inside[:, None] / 2
    first = np.argmax(below, axis=1)
    found = whole & below.any(axis=1) & (first > 0) & (inside > np.max(inside) / 4)
    if np.count_nonzero(found) < _LEAST_FOUND * _POINTS:
        return None
    scale = reach[first] - (reach[1] - reach[0]) / 2
    ray = expected - middle[:, None]
    rim = middle[:, None] + ray * scale
    # A rim shifted by w and scaled by ratio meets the ray at scale |ray| = ratio |ray| + (n w) / (n
    # u), with n the normal of the expected rim and u the ray's direction.
    length = np.linalg.norm(ray, axis=0)
    tangent = np.roll(expected, -1, axis=1) - np.roll(expected, 1, axis=1)
    normal = np.stack([tangent[1], -tangent[0]])
    design = np.stack([length, *(normal / np.sum(normal * ray / length, axis=0))], axis=1)[found]
    ratio, shift_x, shift_y = np.linalg.lstsq(design, (scale * length)[found], rcond=None)[0]
    rim = rim[:, found]
    mm_per_px = rim_mm / float(np.mean(np.linalg.norm(expected - middle[:, None], axis=0)))
    return Outline(
        rim_px=rim,
        centre_px=(float(middle[0] + shift_x), float(middle[1] + shift_y)),
        expected_px=(float(middle[0]), float(middle[1])),
        offset_mm=float(np.hypot(shift_x, shift_y)) * mm_per_px,
        size_ratio=float(ratio),
    )


def project(geometry: Geometry, world_mm: FloatArray) -> FloatArray:
    """Column and row (2, n) of world points (3, n), through the lens."""
    camera = geometry.rotation @ (world_mm - geometry.pinhole_mm[:, None])
    through = camera[:2] / camera[2]
    if any(geometry.distortion):
        through = distort(through[0], through[1], geometry.distortion)
    column, row = geometry.focal_px * through
    return np.stack([column + geometry.principal_px[0], row + geometry.principal_px[1]])
