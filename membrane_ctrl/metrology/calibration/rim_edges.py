"""Edges of the light at the mirror's rim, to a fraction of a pixel."""

import numpy as np

from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction
from membrane_ctrl.metrology.rays.rim_outline import find_outline, light_at
from membrane_ctrl.model.arrays import FloatArray

RIM_POINTS = 720  # around the rim
_REACH_PX = 8.0  # each way from the rough rim
_STEP_PX = 0.25
LEAST_FOUND = 0.5  # share of the rim: less is no ellipse
RADIUS_SIGMA_MM = 0.2
# 1 sigma of an edge that a whole rim may share: a threshold on a blurred edge is off by the blur's
# asymmetry.
EDGE_SIGMA_PX = 0.1
_LEAST_CONTRAST = 1 / 4  # of an edge, over the brightest line's inner end
_HEIGHT_STEPS = 4  # the rim's height hardly changes with the place: each gains three digits


def meet_rim(
    geometry: Geometry, edges: FloatArray, rim_z: HeightFunction
) -> tuple[FloatArray, FloatArray]:
    """Where the rays of edges meet the rim's height.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    edges : (2, n) array
        Columns and rows.
    rim_z : height function
        Height of the rim in world at x and y, mm.

    Returns
    -------
    x_mm, y_mm : (n,) arrays
    """
    rays = geometry.rays(*edges)
    z_mm = np.zeros(edges.shape[1])
    x_mm = y_mm = z_mm
    for _ in range(_HEIGHT_STEPS):
        t = (z_mm - geometry.pinhole_mm[2]) / rays[2]
        x_mm, y_mm = geometry.pinhole_mm[:2, None] + t * rays[:2]
        z_mm = rim_z(x_mm, y_mm)
    return x_mm, y_mm


def find_edges(
    light: FloatArray, stated: Geometry, radius_mm: float, rim_z_mm: float
) -> FloatArray | None:
    """Find the edges of the light at the rim.

    Parameters
    ----------
    light : (H, W) array
        White minus black.
    stated : Geometry
        The stated bench.
    radius_mm, rim_z_mm : float
        Radius of the rim, and the height of its plane in world.

    Returns
    -------
    (2, n) array or None
        Columns and rows of the edges; None if half of the rim or more is not visible.
    """
    outline = find_outline(light, stated, radius_mm, rim_z_mm)
    if outline is None:
        return None
    try:
        edges = rim_edges(light, outline.rim_px)
    except ValueError:  # no ellipse
        return None
    if edges.shape[1] < LEAST_FOUND * RIM_POINTS:
        return None
    return edges


def rim_edges(light: FloatArray, rough_px: FloatArray) -> FloatArray:
    """Find the edges of the light, to a fraction of a pixel.

    Along lines across the rim, an edge is where the light falls through the mean of its levels
    inside and outside.

    Parameters
    ----------
    light : (H, W) array
        White minus black.
    rough_px : (2, m) array
        The rough rim.

    Returns
    -------
    (2, n) array
        Columns and rows of the edges that are seen.

    Raises
    ------
    ValueError
        If the rough rim is no ellipse.
    """
    # Outward normals of the ellipse through the rough rim.
    ellipse = _fit_ellipse(rough_px)
    along = np.roll(ellipse, -1, axis=1) - np.roll(ellipse, 1, axis=1)
    normal = np.stack([along[1], -along[0]]) / np.hypot(*along)
    from_centre = ellipse - ellipse.mean(axis=1, keepdims=True)
    normal *= np.sign(np.sum(normal * from_centre, axis=0))

    # Light along lines through the rim, and its levels at their ends.
    reach_px = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
    lines = ellipse[:, :, None] + normal[:, :, None] * reach_px
    values = light_at(light, lines)
    ends = reach_px.size // 4
    inside = np.median(values[:, :ends], axis=1)
    outside = np.median(values[:, -ends:], axis=1)
    half = (inside + outside) / 2

    # Lines with exactly one edge: one that is lit again further out crosses something else.
    is_below = values < half[:, None]
    first_below = np.argmax(is_below, axis=1)
    crossings = (np.diff(is_below.astype(int), axis=1) != 0).sum(axis=1)
    has_contrast = inside - outside > np.nanmax(inside) * _LEAST_CONTRAST
    is_seen = np.isfinite(values).all(axis=1) & (first_below > 0) & has_contrast
    is_seen &= crossings == 1

    # The edge by linear interpolation.
    line = np.flatnonzero(is_seen)
    k = first_below[line]
    high = values[line, k - 1]
    low = values[line, k]
    at_px = reach_px[k - 1] + _STEP_PX * (high - half[line]) / (high - low)
    return np.asarray(ellipse[:, line] + normal[:, line] * at_px)


def _fit_ellipse(points_px: FloatArray) -> FloatArray:
    """Points (2, RIM_POINTS) on the ellipse nearest to the given ones (2, m).

    It is the conic a x^2 + b x y + c y^2 + d x + e y = 1 by least squares. Raises ValueError if
    that is no ellipse.
    """
    middle = points_px.mean(axis=1)
    size = float(np.std(points_px))
    x, y = (points_px - middle[:, None]) / size
    terms = np.stack([x * x, x * y, y * y, x, y], axis=1)
    a, b, c, d, e = np.linalg.lstsq(terms, np.ones(x.size), rcond=None)[0]

    # About its centre it is p^T M p = 1: the axes are the eigenvectors of M, their lengths the
    # inverse roots of its eigenvalues.
    form = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(form, [-d / 2, -e / 2])
    values, axes = np.linalg.eigh(form / (1 + centre @ form @ centre))
    if values.min() <= 0:
        raise ValueError("the rim is not an ellipse")

    # A circle, stretched along the axes.
    theta = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    circle = np.stack([np.cos(theta), np.sin(theta)])
    around = axes @ (circle / np.sqrt(values)[:, None])
    return np.asarray(middle[:, None] + size * (centre[:, None] + around))


def subtract_mean_place(edges: FloatArray) -> FloatArray:
    """Edges (2, n) less their mean."""
    return np.asarray(edges - edges.mean(axis=1, keepdims=True))
