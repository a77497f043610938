"""Slopes and paraboloid of a facet from positions on the screen, in the facet's own frame.

Where a camera ray meets the facet depends on the shape, and the slope there on where: the paraboloid of the last
round places the points of the next. The facet's pose from its corners is good to a few hundredths of a degree only,
much coarser than its slopes, so camera and screen are turned about the vertex until the fitted normal there is z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.metrology.paraboloid import Loss, Paraboloid, ParaboloidFit, fit_slopes

FloatArray = NDArray[np.float64]

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


def exact_slopes(points_mm: FloatArray, pinhole_mm: FloatArray, screen_points_mm: FloatArray) -> FloatArray:
    """Slopes (2, N): the normal is the bisector of the rays to the pinhole and to the screen point."""
    to_camera = pinhole_mm[:, None] - points_mm
    to_screen = screen_points_mm - points_mm
    normal = to_camera / np.linalg.norm(to_camera, axis=0) + to_screen / np.linalg.norm(to_screen, axis=0)
    return np.asarray(-normal[:2] / normal[2])


def measure_on(surface: Paraboloid, geometry: Geometry, sight: Sight) -> tuple[FloatArray, FloatArray]:
    """Points (3, N) where the pixels' rays meet `surface`, and the slopes (2, N) measured there."""
    points_mm = surface.intersect(geometry.pinhole_mm, geometry.rays(sight.columns_px, sight.rows_px))
    return points_mm, exact_slopes(points_mm, geometry.pinhole_mm, geometry.screen_points(sight.screen_mm))


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
        surface = replace(fit.surface, tilt_x=0.0, tilt_y=0.0)  # the turn below takes the tilt out
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
    """The shortest rotation that turns the normal at the vertex to z: I + K + K^2 / (1 + n_z), K = [n x z]."""
    normal = np.array([-surface.tilt_x, -surface.tilt_y, 1.0])
    normal /= np.linalg.norm(normal)
    axis_x, axis_y = normal[1], -normal[0]
    cross = np.array([[0.0, 0.0, axis_y], [0.0, 0.0, -axis_x], [-axis_y, axis_x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + normal[2]))
