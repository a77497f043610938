"""The camera's pose from the ring: a circle of known radius is seen as an ellipse, whose five
numbers are its pose.

The sixth, a turn of everything about z, is unobservable and defines x (`bench_poses`). The fit
minimises the distance from the ring to the points where the rim's rays meet its plane, over a,
alpha, yaw, pitch and roll.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.calibration.rim_edges import (
    EDGE_SIGMA_PX,
    LEAST_FOUND,
    RIM_POINTS,
    meet_rim,
    rim_edges,
    subtract_mean_place,
)
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, usual_sigma
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction
from membrane_ctrl.model.arrays import FloatArray

POSE_NAMES = ("a_mm", "alpha_deg", "camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg")
_PLACES = [NAMES.index(name) for name in POSE_NAMES]
# Units of the solver's unknowns, so that its steps are of one size.
_UNITS = np.array([usual_sigma(name) for name in POSE_NAMES])
_SOFT_PX = 0.3  # distance beyond which an edge counts linearly


@dataclass(frozen=True)
class RingPose:
    """The pose that the rim gives.

    Attributes
    ----------
    values : (5,) array
        Values of `POSE_NAMES`; 0 for the stated bench.
    sigmas : (5,) array
        Their standard deviations.
    rms_px : float
        Residual of an edge.
    points : int
        Number of edges that were used.
    """

    values: FloatArray
    sigmas: FloatArray
    rms_px: float
    points: int

    def bench(self, stated: Geometry) -> Geometry:
        """The stated bench with the camera at the rim's pose and the screen moved with alpha."""
        return _make_bench(stated, self.values)


def ring_pose(
    light: FloatArray,
    stated: Geometry,
    rough_px: FloatArray,
    radius_mm: float,
    rim_z: HeightFunction,
    radius_sigma_mm: float,
) -> RingPose:
    """Fit the pose, weighted with the hand measurements (`bench_parameters.POSE`).

    Parameters
    ----------
    light : (H, W) array
        White minus black.
    stated : Geometry
        The stated bench.
    rough_px : (2, n) array
        The rim as `rim_outline.find_outline` sees it, to within a few pixels.
    radius_mm : float
        Radius of the ring.
    rim_z : height function
        Height of the rim in world; a ring is flat, the rim of a mounted film nearly.
    radius_sigma_mm : float
        Standard uncertainty of the radius, which enters `a_mm`.

    Returns
    -------
    RingPose

    Raises
    ------
    ValueError
        If half of the rim or more is not visible.
    """
    edges = rim_edges(light, rough_px)
    if edges.shape[1] < LEAST_FOUND * RIM_POINTS:
        raise ValueError(
            f"only {edges.shape[1] / RIM_POINTS:.0%} of the rim is seen as an edge of light"
        )
    mm_per_px = radius_mm / float(np.mean(np.hypot(*subtract_mean_place(edges))))

    def miss_px(x: FloatArray) -> FloatArray:
        """Distances (n,) of the edges from the ring, with the pose x (5,) in units of `_UNITS`."""
        radii_mm = _radii_mm(_make_bench(stated, x * _UNITS), edges, rim_z)
        return np.asarray((radii_mm - radius_mm) / mm_per_px)

    from scipy.optimize import least_squares  # calibrations without a pose start sooner

    fit = least_squares(miss_px, np.zeros(len(POSE_NAMES)), loss="soft_l1", f_scale=_SOFT_PX)
    found = np.asarray(fit.x, float)
    slopes = np.asarray(fit.jac, float)

    # Information of the edges: their scatter, and what they have in common.
    rms_px = float(np.sqrt(np.mean(miss_px(found) ** 2)))
    inverse = np.linalg.inv(slopes.T @ slopes)
    shared = inverse @ slopes.T @ _shared_misses(edges, radius_sigma_mm / mm_per_px)
    information = np.linalg.inv(inverse * rms_px**2 + shared @ shared.T)

    # Together with the hand measurements, whose information is 1 in these units.
    covariance = np.linalg.inv(information + np.eye(len(POSE_NAMES)))
    values = covariance @ information @ found * _UNITS
    sigmas = np.sqrt(np.diag(covariance)) * _UNITS
    return RingPose(values, sigmas, rms_px, edges.shape[1])


def _make_bench(stated: Geometry, pose: FloatArray) -> Geometry:
    """The stated bench with the values (5,) of `POSE_NAMES`."""
    values = np.zeros(len(NAMES))
    values[_PLACES] = pose
    return bench_at(stated, values).geometry


def _radii_mm(geometry: Geometry, edges: FloatArray, rim_z: HeightFunction) -> FloatArray:
    """Distances (n,) from the axis at which the rays of edges (2, n) meet the rim's height."""
    return np.asarray(np.hypot(*meet_rim(geometry, edges, rim_z)))


def _shared_misses(edges: FloatArray, radius_sigma_px: float) -> FloatArray:
    """Errors (n, 3) that the edges have in common, one sigma each.

    The radius; and the edge's own error as a rim that is larger, longer across, or longer along a
    diagonal.
    """
    x, y = subtract_mean_place(edges) / np.hypot(*subtract_mean_place(edges))
    larger = np.full(x.size, np.hypot(radius_sigma_px, EDGE_SIGMA_PX))
    across = EDGE_SIGMA_PX * (x * x - y * y)
    diagonal = EDGE_SIGMA_PX * 2 * x * y
    return np.stack([larger, across, diagonal], axis=1)
