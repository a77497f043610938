"""Edges of the light at the mirror's rim, to a fraction of a pixel."""

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction
from membrane_ctrl.metrology.rays.rim_outline import find_outline, light_at
from membrane_ctrl.model.arrays import FloatArray

RIM_POINTS = 720
_REACH_PX = 8.0  # each way from the rough rim
_STEP_PX = 0.25
LEAST_FOUND = 0.5  # of the rim: less is no ellipse
RADIUS_SIGMA_MM = 0.2
# A threshold on a blurred edge is off by the blur's asymmetry, which a whole rim may share
EDGE_SIGMA_PX = 0.1


def on_rim(
    geometry: Geometry, edges: FloatArray, rim_z: HeightFunction
) -> tuple[FloatArray, FloatArray]:
    """x and y in mm at which the rays of edges (2, n) meet the rim's height."""
    rays, z = geometry.rays(*edges), np.zeros(edges.shape[1])
    x = y = z
    for _ in range(
        4
    ):  # the height at the rim hardly changes with the place: each step gains three digits
        t = (z - geometry.pinhole_mm[2]) / rays[2]
        x, y = geometry.pinhole_mm[:2, None] + t * rays[:2]
        z = rim_z(x, y)
    return x, y


def find_edges(
    light: FloatArray, stated: Geometry, radius_mm: float, rim_z_mm: float
) -> FloatArray | None:
    """Edges of the light (2, n) at the rim; None if half of it or more is not visible."""
    outline = find_outline(light, stated, radius_mm, rim_z_mm)
    try:
        edges = None if outline is None else rim_edges(light, outline.rim_px)
    except ValueError:  # no ellipse
        return None
    return edges if edges is not None and edges.shape[1] >= LEAST_FOUND * RIM_POINTS else None


def rim_edges(light: FloatArray, rough_px: FloatArray) -> FloatArray:
    """Edges of the light (2, n), to a fraction of a pixel, along normals of the ellipse through the
    rough rim.
    """
    ellipse = _fit_ellipse(rough_px)
    ahead = np.roll(ellipse, -1, axis=1) - np.roll(ellipse, 1, axis=1)
    normal = np.stack([ahead[1], -ahead[0]]) / np.hypot(*ahead)
    normal *= np.sign(np.sum(normal * (ellipse - ellipse.mean(axis=1, keepdims=True)), axis=0))
    reach = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    lines = ellipse[:, :, None] + normal[:, :, None] * reach
    values = light_at(light, lines)
    ends = reach.size // 4
    inside, outside = np.median(values[:, :ends], axis=1), np.median(values[:, -ends:], axis=1)
    half = (inside + outside) / 2
    below = values < half[:, None]
    k = np.argmax(below, axis=1)
    seen = np.isfinite(values).all(axis=1) & (k > 0) & (inside - outside > np.nanmax(inside) / 4)
    # exactly one edge: a line that is lit again further out crosses something else
    seen &= (np.diff(below.astype(int), axis=1) != 0).sum(axis=1) == 1
    n = np.flatnonzero(seen)
    k = k[n]
    high, low = values[n, k - 1], values[n, k]
    at = reach[k - 1] + _STEP_PX * (high - half[n]) / (high - low)
    return np.asarray(ellipse[:, n] + normal[:, n] * at)


def _fit_ellipse(points_px: FloatArray) -> FloatArray:
    """(2, _POINTS) on the ellipse nearest to the points: the conic through them,
    by least squares.
    """
    middle, size = points_px.mean(axis=1), float(np.std(points_px))
    x, y = (points_px - middle[:, None]) / size
    a, b, c, d, e = np.linalg.lstsq(
        np.stack([x * x, x * y, y * y, x, y], axis=1), np.ones(x.size), rcond=None
    )[0]
    form = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(form, [-d / 2, -e / 2])
    values, axes = np.linalg.eigh(form / (1 + centre @ form @ centre))
    if values.min() <= 0:
        raise ValueError("the rim is not an ellipse")
    theta = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    round_ = axes @ (np.stack([np.cos(theta), np.sin(theta)]) / np.sqrt(values)[:, None])
    return np.asarray(middle[:, None] + size * (centre[:, None] + round_))


def from_middle(edges: FloatArray) -> FloatArray:
    return np.asarray(edges - edges.mean(axis=1, keepdims=True))
