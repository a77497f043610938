"""The camera's pose from the ring: a circle of known radius is seen as an ellipse, whose five
numbers are its pose.

The sixth, a turn of everything about z, is unobservable and defines x (`parameters`). The fit
minimises the distance from the ring to the points where the rim's rays meet its plane, over a,
alpha, yaw, pitch and roll.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays import bench_parameters
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, bench_at, usual_sigma
from membrane_ctrl.metrology.rays.geometry import Geometry, find_outline, light_at
from membrane_ctrl.metrology.reconstruction.surface_fit import HeightFunction
from membrane_ctrl.model.arrays import FloatArray

POSE_NAMES = ("a_mm", "alpha_deg", "camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg")
_PLACES = [NAMES.index(name) for name in POSE_NAMES]
_UNITS = np.array(
    [usual_sigma(name) for name in POSE_NAMES]
)  # so that the solver's steps are of one size
_POINTS = 720
_REACH_PX = 8.0  # each way from the rough rim
_STEP_PX = 0.25
_LEAST_FOUND = 0.5  # of the rim: less is no ellipse
RADIUS_SIGMA_MM = 0.2
# A threshold on a blurred edge is off by the blur's asymmetry, which a whole rim may share
EDGE_SIGMA_PX = 0.1
_CENTRE_MM = 0.5  # the film's axis, by its clamp, against the edge that is seen
_OVAL_MM = 0.3  # a welded or turned ring of a metre, each of two directions
_STEP = 1e-3  # of a parameter's sigma by hand


@dataclass(frozen=True)
class RingPose:
    """The pose that the rim gives."""

    values: FloatArray  # (5,): of `POSE_NAMES`, 0 for the stated bench
    sigmas: FloatArray  # (5,)
    rms_px: float  # residual of an edge
    points: int  # edges that were used

    def bench(self, stated: Geometry) -> Geometry:
        """The stated bench with the camera at the rim's pose and the screen moved with alpha."""
        return _bench(stated, self.values)


def ring_pose(
    light: FloatArray,
    stated: Geometry,
    rough_px: FloatArray,
    radius_mm: float,
    rim_z: HeightFunction,
    radius_sigma_mm: float,
) -> RingPose:
    """Fit the pose, weighted with the hand measurements (`parameters.POSE`).

    Raises ValueError if half of the rim or more is not visible.

    Parameters
    ----------
    light : (H, W) array
        White minus black.
    rough_px : (2, n) array
        The rim as `geometry.find_outline` sees it, to within `_REACH_PX`.
    rim_z : height function
        Height of the rim in world; a ring is flat, the rim of a mounted film nearly.
    radius_sigma_mm : float
        How well the radius is known, which enters `a_mm`.
    """
    edges = rim_edges(light, rough_px)
    if edges.shape[1] < _LEAST_FOUND * _POINTS:
        raise ValueError(
            f"only {edges.shape[1] / _POINTS:.0%} of the rim is seen as an edge of light"
        )
    mm_per_px = radius_mm / float(np.mean(np.hypot(*_from_middle(edges))))

    def miss_px(x: FloatArray) -> FloatArray:
        return np.asarray(
            (_radii_mm(_bench(stated, x * _UNITS), edges, rim_z) - radius_mm) / mm_per_px
        )

    from scipy.optimize import least_squares  # calibrations without a pose start sooner

    fit = least_squares(miss_px, np.zeros(len(POSE_NAMES)), loss="soft_l1", f_scale=0.3)
    slopes, found = np.asarray(fit.jac, float), np.asarray(fit.x, float)
    rms_px = float(np.sqrt(np.mean(miss_px(found) ** 2)))
    inverse = np.linalg.inv(slopes.T @ slopes)
    shared = inverse @ slopes.T @ _shared(edges, radius_sigma_mm / mm_per_px)
    seen = np.linalg.inv(inverse * rms_px**2 + shared @ shared.T)
    both = np.linalg.inv(seen + np.eye(len(POSE_NAMES)))  # in units of the hand's sigmas
    return RingPose(
        both @ seen @ found * _UNITS, np.sqrt(np.diag(both)) * _UNITS, rms_px, edges.shape[1]
    )


def _bench(stated: Geometry, own: FloatArray) -> Geometry:
    values = np.zeros(len(NAMES))
    values[_PLACES] = own
    return bench_at(stated, values).geometry


def _radii_mm(geometry: Geometry, edges: FloatArray, rim_z: HeightFunction) -> FloatArray:
    return np.asarray(np.hypot(*on_rim(geometry, edges, rim_z)))


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
    return edges if edges is not None and edges.shape[1] >= _LEAST_FOUND * _POINTS else None


def rim_edges(light: FloatArray, rough_px: FloatArray) -> FloatArray:
    """Edges of the light (2, n), to a fraction of a pixel, along normals of the ellipse through the
    rough rim.
    """
    ellipse = _ellipse(rough_px)
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


def _ellipse(points_px: FloatArray) -> FloatArray:
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
    theta = 2 * np.pi * np.arange(_POINTS) / _POINTS
    round_ = axes @ (np.stack([np.cos(theta), np.sin(theta)]) / np.sqrt(values)[:, None])
    return np.asarray(middle[:, None] + size * (centre[:, None] + round_))


def _shared(edges: FloatArray, radius_sigma_px: float) -> FloatArray:
    """Misses that the edges have in common, one sigma each, (n, 3).

    The radius; and the edge's own error as a rim that is larger, longer across, or longer along a
    diagonal.
    """
    x, y = _from_middle(edges) / np.hypot(*_from_middle(edges))
    alike = np.full(x.size, np.hypot(radius_sigma_px, EDGE_SIGMA_PX))
    return np.stack([alike, EDGE_SIGMA_PX * (x * x - y * y), EDGE_SIGMA_PX * 2 * x * y], axis=1)


def _from_middle(edges: FloatArray) -> FloatArray:
    return np.asarray(edges - edges.mean(axis=1, keepdims=True))


# The rim as evidence in the calibration: it shows the size of everything that is seen.
#
# Seen from the true bench the radii at which the edges' rays meet the ring are the ring's: their
# mean, their place and their ovalness are five observations. Their errors are the ring's own and
# the edge's, which all edges share; the noise of single edges is nothing beside them.


@dataclass(frozen=True)
class Rim:
    """Edges of the light at the ring."""

    edges_px: FloatArray  # (2, n): column and row
    radius_mm: float
    radius_sigma_mm: float = RADIUS_SIGMA_MM

    @classmethod
    def of(
        cls, edges_px: Sequence[FloatArray], radius_mm: float, radius_sigma_mm: float
    ) -> "Rim | None":
        """The edges of several sets together; None without any."""
        return (
            cls(np.concatenate(edges_px, axis=1), radius_mm, radius_sigma_mm) if edges_px else None
        )

    def sums(self, stated: Geometry, common: FloatArray) -> FloatArray:
        """Normal equations (COMMON + 1, squared) of the five
        observations at the common unknowns.
        """
        now = self._seen_mm(stated, common)
        columns = [np.zeros(now.size)] * common.size
        optical = [
            k
            for k, name in enumerate(bench_parameters.NAMES[: bench_parameters.OPTICAL])
            if name not in _OF_SCREEN
        ]
        for k in (*optical, *range(len(bench_parameters.NAMES), common.size)):
            step = _STEP * (
                bench_parameters.ALL[k].sigma if k < len(bench_parameters.NAMES) else 1.0
            )
            there = common.copy()
            there[k] += step
            columns[k] = (self._seen_mm(stated, there) - now) / step
        rows = np.column_stack([*columns, -now]) / self._sigmas_mm(stated)[:, None]
        return np.asarray(rows.T @ rows)

    def _sigmas_mm(self, stated: Geometry) -> FloatArray:
        edge_mm = EDGE_SIGMA_PX * float(np.linalg.norm(stated.pinhole_mm)) / stated.focal_px
        own = np.array([self.radius_sigma_mm, _CENTRE_MM, _CENTRE_MM, _OVAL_MM, _OVAL_MM])
        return np.asarray(np.hypot(own, edge_mm))

    def _seen_mm(self, stated: Geometry, common: FloatArray) -> FloatArray:
        """Mean radius less the ring's, place (2,) and ovalness (2,) of the edges."""
        geometry, ring = (
            bench_parameters.bench_at(stated, common[: len(bench_parameters.NAMES)]).geometry,
            common[_RING],
        )
        orders = np.arange(1, ring.size // 2 + 1)

        def height(x: FloatArray, y: FloatArray) -> FloatArray:
            turns = np.outer(orders, np.arctan2(y, x))
            return np.asarray(ring[0] + np.concatenate([np.cos(turns), np.sin(turns)]).T @ ring[1:])

        x, y = on_rim(geometry, self.edges_px, height)
        theta = np.arctan2(y, x)
        waves = [
            np.ones_like(theta),
            np.cos(theta),
            np.sin(theta),
            np.cos(2 * theta),
            np.sin(2 * theta),
        ]
        return np.asarray(
            np.linalg.lstsq(np.stack(waves, axis=1), np.hypot(x, y) - self.radius_mm, rcond=None)[0]
        )


_RING = slice(len(bench_parameters.NAMES), None)
_OF_SCREEN = {
    name for name in bench_parameters.NAMES if name.startswith(("b_", "screen_", "bow_", "pitch_"))
}
