"""Slopes and paraboloid of a facet from positions on the screen, in the facet's own frame.

Where a camera ray meets the facet depends on the shape, and the slope there on where: the
paraboloid of the last round places the points of the next. The facet's pose from its corners is
good to a few hundredths of a degree only, much coarser than its slopes, so camera and screen are
turned about the vertex until the fitted normal there is z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.rays.geometry import Geometry

# A general paraboloid from slopes: plain least squares, or robust against glints, dust and
# turned-down edges.
#
# h = t_x x + t_y y + (c_xx x^2 + 2 c_xy x y + c_yy y^2) / 2 has slopes that are linear in its five
# parameters,
#
#     dh/dx = t_x + c_xx x + c_xy y,      dh/dy = t_y + c_xy x + c_yy y.
#
# Both slopes share c_xy: a surface that exists. (Fitting each slope by itself and averaging the two
# c_xy afterwards is nearly the same, and throws the integrability away as a check.) The focal
# length along x is 1 / (2 c_xx).
#
# Robust: iteratively reweighted least squares. Each slope component has a weight of its own from
# its residual in units of its axis' spread, 1.4826 median |r| (Tukey: Beaton & Tukey 1974, 4.685;
# Huber 1964, 1.345; both tuned to 95 % efficiency on Gaussian noise).


FloatArray = NDArray[np.float64]
Loss = Literal["squares", "huber", "tukey"]

_MAD_TO_SIGMA = 1.4826  # of a Gaussian
_TUKEY = 4.685
_HUBER = 1.345
_MAX_ITERATIONS = 200
# of the largest parameter: 10 nm in a focal length of 100 m, far below what any noise allows
_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Paraboloid:
    """h(0, 0) = 0; tilts without unit, curvatures in 1/mm."""

    tilt_x: float
    tilt_y: float
    curvature_xx_per_mm: float
    curvature_xy_per_mm: float
    curvature_yy_per_mm: float

    @property
    def focal_x_mm(self) -> float:
        """Focal length along x."""
        return 0.5 / self.curvature_xx_per_mm

    @property
    def focal_y_mm(self) -> float:
        """Focal length along y."""
        return 0.5 / self.curvature_yy_per_mm

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height at points (...)."""
        quadratic = self.curvature_xx_per_mm * x_mm**2 + 2 * self.curvature_xy_per_mm * x_mm * y_mm
        quadratic = quadratic + self.curvature_yy_per_mm * y_mm**2
        return np.asarray(self.tilt_x * x_mm + self.tilt_y * y_mm + quadratic / 2)

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """dh/dx and dh/dy, (2, ...), at points (...)."""
        along_x = self.tilt_x + self.curvature_xx_per_mm * x_mm + self.curvature_xy_per_mm * y_mm
        along_y = self.tilt_y + self.curvature_xy_per_mm * x_mm + self.curvature_yy_per_mm * y_mm
        return np.stack([along_x, along_y])

    def intersect(self, origin_mm: FloatArray, rays: FloatArray) -> FloatArray:
        """Points (3, N) where rays (3, N) from one origin (3,) first meet the surface.

        With d(t) = z - h along the ray a quadratic a t^2 + b t + c, t = 2 c / (-b + sqrt(b^2 - 4 a
        c)): the form that loses no digits when a, the curvature along the ray, is nearly 0. NaN
        where a ray misses.
        """
        (x, y, z), (u, v, w) = origin_mm, rays
        k_xx, k_xy, k_yy = (
            self.curvature_xx_per_mm,
            self.curvature_xy_per_mm,
            self.curvature_yy_per_mm,
        )
        a = -(k_xx * u**2 + 2 * k_xy * u * v + k_yy * v**2) / 2
        slope_x, slope_y = self.slopes(np.asarray(x), np.asarray(y))
        b = w - slope_x * u - slope_y * v
        c = z - self.height_mm(np.asarray(x), np.asarray(y))
        root = np.sqrt(np.where(b**2 - 4 * a * c >= 0, b**2 - 4 * a * c, np.nan))
        return np.asarray(origin_mm[:, None] + rays * (2 * c / (root - b)))


@dataclass(frozen=True)
class ParaboloidFit:
    """A paraboloid and its residual.

    Attributes
    ----------
    surface : Paraboloid
    residual : (2, N) array
        Measured minus fitted slopes.
    weights : (2, N) array
        Of the last iteration; 1 for plain least squares.
    """

    surface: Paraboloid
    residual: FloatArray
    weights: FloatArray


def fit_slopes(
    x_mm: FloatArray, y_mm: FloatArray, slopes: FloatArray, loss: Loss = "squares"
) -> ParaboloidFit:
    """Fit a paraboloid to slopes (2, N) measured at points (N,).

    Raises
    ------
    ValueError
        If a number is not finite, the points do not determine a paraboloid, or the weights do not
        settle.
    """
    if not (np.isfinite(slopes).all() and np.isfinite(x_mm).all() and np.isfinite(y_mm).all()):
        raise ValueError("slopes or points that are not finite")
    scale_mm = (
        float(np.max(np.abs([x_mm, y_mm]), initial=0.0)) or 1.0
    )  # columns of like size: a sound condition
    design = _design(x_mm / scale_mm, y_mm / scale_mm)
    weights = np.ones_like(slopes)
    parameters = _solve(design, slopes, weights)
    for _ in range(_MAX_ITERATIONS if loss != "squares" else 0):
        weights = _weights(slopes - np.tensordot(design, parameters, axes=1), loss)
        last, parameters = parameters, _solve(design, slopes, weights)
        if np.max(np.abs(parameters - last)) <= _TOLERANCE * np.max(np.abs(parameters)):
            break
    else:
        if loss != "squares":
            raise ValueError(f"robust fit did not settle in {_MAX_ITERATIONS} iterations")
    residual = slopes - np.tensordot(design, parameters, axes=1)
    tilt, curvature = parameters[:2], parameters[2:] / scale_mm
    return ParaboloidFit(Paraboloid(*map(float, (*tilt, *curvature))), residual, weights)


def _design(x: FloatArray, y: FloatArray) -> FloatArray:
    """Derivatives of both slopes with respect to (t_x, t_y, c_xx, c_xy, c_yy), (2, N, 5)."""
    one, zero = np.ones_like(x), np.zeros_like(x)
    return np.stack(
        [np.stack([one, zero, x, y, zero], axis=1), np.stack([zero, one, zero, x, y], axis=1)]
    )


def _solve(design: FloatArray, slopes: FloatArray, weights: FloatArray) -> FloatArray:
    root = np.sqrt(weights)
    rows = (design * root[..., None]).reshape(-1, design.shape[-1])
    parameters, _, rank, _ = np.linalg.lstsq(rows, (slopes * root).ravel(), rcond=None)
    if rank < design.shape[-1]:
        raise ValueError("the points do not determine a paraboloid")
    return np.asarray(parameters)


def _weights(residual: FloatArray, loss: Loss) -> FloatArray:
    """Weight of each component from its size against its axis' spread."""
    sigma = _MAD_TO_SIGMA * np.median(np.abs(residual), axis=1, keepdims=True)
    size = np.abs(residual) / np.maximum(sigma, math.ulp(1.0))
    if loss == "huber":
        return np.asarray(np.minimum(1.0, _HUBER / np.maximum(size, _HUBER)))
    return np.asarray(np.where(size < _TUKEY, (1 - (size / _TUKEY) ** 2) ** 2, 0.0))


_FLAT = Paraboloid(0.0, 0.0, 0.0, 0.0, 0.0)
_MAX_ROUNDS = 30
_TILT_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Sight:
    """What each pixel sees: its ray and a point on the screen.

    Attributes
    ----------
    columns_px, rows_px : (N,) arrays
        Image points.
    screen_mm : (2, N) array
        Screen coordinates it sees in the mirror.
    """

    columns_px: FloatArray
    rows_px: FloatArray
    screen_mm: FloatArray

    def every(self, stride: int) -> Sight:
        """Every `stride`-th pixel."""
        return Sight(self.columns_px[::stride], self.rows_px[::stride], self.screen_mm[:, ::stride])


@dataclass(frozen=True)
class FacetFit:
    """The facet, with the geometry turned so that its vertex faces z.

    Attributes
    ----------
    fit : ParaboloidFit
        Surface, residual slopes and weights.
    geometry : Geometry
        Camera and screen in the facet's frame.
    points_mm : (3, N) array
    slopes : (2, N) array
        dh/dx, dh/dy at the points.
    """

    fit: ParaboloidFit
    geometry: Geometry
    points_mm: FloatArray
    slopes: FloatArray


def exact_slopes(
    points_mm: FloatArray, pinhole_mm: FloatArray, screen_points_mm: FloatArray
) -> FloatArray:
    """Slopes (2, N): the normal is the bisector of the rays to the
    pinhole and to the screen point.
    """
    to_camera = pinhole_mm[:, None] - points_mm
    to_screen = screen_points_mm - points_mm
    normal = to_camera / np.linalg.norm(to_camera, axis=0) + to_screen / np.linalg.norm(
        to_screen, axis=0
    )
    return np.asarray(-normal[:2] / normal[2])


def measure_on(
    surface: Paraboloid, geometry: Geometry, sight: Sight
) -> tuple[FloatArray, FloatArray]:
    """Points (3, N) where the pixels' rays meet `surface`, and the slopes (2, N) measured there."""
    points_mm = surface.intersect(
        geometry.pinhole_mm, geometry.rays(sight.columns_px, sight.rows_px)
    )
    return points_mm, exact_slopes(
        points_mm, geometry.pinhole_mm, geometry.screen_points(sight.screen_mm)
    )


def solve_facet(geometry: Geometry, sight: Sight, loss: Loss = "squares") -> FacetFit:
    """Slopes, paraboloid and pose of a facet.

    Raises
    ------
    ValueError
        If pixels miss the facet or see no screen, or the tilt does not settle.
    """
    surface = _FLAT
    for _ in range(_MAX_ROUNDS):
        points_mm, slopes = measure_on(surface, geometry, sight)
        fit = fit_slopes(points_mm[0], points_mm[1], slopes, loss)
        if max(abs(fit.surface.tilt_x), abs(fit.surface.tilt_y)) < _TILT_TOLERANCE:
            return FacetFit(fit, geometry, points_mm, slopes)
        surface = replace(fit.surface, tilt_x=0.0, tilt_y=0.0)  # the turn below removes the tilt
        geometry = turned(geometry, _normal_to_z(fit.surface))
    raise ValueError(f"the facet's tilt did not settle in {_MAX_ROUNDS} rounds")


def turned(geometry: Geometry, rotation: FloatArray) -> Geometry:
    """Camera and screen turned about the origin by a rotation matrix (3, 3)."""
    return replace(
        geometry,
        pinhole_mm=rotation @ geometry.pinhole_mm,
        rotation=geometry.rotation @ rotation.T,
        screen_origin_mm=rotation @ geometry.screen_origin_mm,
        screen_s_x=rotation @ geometry.screen_s_x,
        screen_s_y=rotation @ geometry.screen_s_y,
    )


def _normal_to_z(surface: Paraboloid) -> FloatArray:
    """The shortest rotation that turns the normal at the vertex to z: I + K + K^2 / (1 + n_z), K =
    [n x z].
    """
    normal = np.array([-surface.tilt_x, -surface.tilt_y, 1.0])
    normal /= np.linalg.norm(normal)
    axis_x, axis_y = normal[1], -normal[0]
    cross = np.array([[0.0, 0.0, axis_y], [0.0, 0.0, -axis_x], [-axis_y, axis_x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + normal[2]))
