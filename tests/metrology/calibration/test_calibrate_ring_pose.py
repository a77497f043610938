"""The camera's pose from the ring, against pictures by rays of an own camera."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.calibration.rim_edges import rim_edges
from membrane_ctrl.metrology.calibration.ring_pose import POSE_NAMES, RingPose, ring_pose
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.rim_outline import find_outline
from tests.support.board_photograph import Photographer

FloatArray = NDArray[np.float64]

CAMERA = CameraConfig(
    width_px=612, height_px=512, pixel_um=13.8, distortion=(-0.1, 0.05, 3e-4, -2e-4)
)
OPTICS = OpticsConfig(camera=CAMERA)
STATED = Geometry.from_config(OPTICS)
RIM_MM, RIM_Z_MM = 500.0, 37.0
TRUE = {
    "a_mm": 3.0,
    "alpha_deg": 0.35,
    "camera_yaw_deg": 0.15,
    "camera_pitch_deg": -0.12,
    "camera_roll_deg": 0.1,
}


def picture(flat: bool = True) -> FloatArray:
    """Light of a disc in the ring, seen by the camera that TRUE describes."""
    own = Photographer(612, 512, STATED.focal_px, CAMERA.principal, (-0.1, 0.05, 3e-4, -2e-4))
    a_mm = 2672.0 + TRUE["a_mm"]
    alpha = np.radians(80.9 + TRUE["alpha_deg"])
    pinhole = a_mm * np.array([np.cos(alpha), 0.0, np.sin(alpha)])
    rows = np.array(
        [[np.sin(alpha), 0, -np.cos(alpha)], [0, -1, 0], [-np.cos(alpha), 0, -np.sin(alpha)]]
    )
    for axis, name in enumerate(("camera_pitch_deg", "camera_yaw_deg", "camera_roll_deg")[::-1]):
        rows = (
            Rotation.from_rotvec(TRUE[name] * np.eye(3)[2 - axis], degrees=True).as_matrix() @ rows
        )
    rays = rows.T @ own.rays
    t = (RIM_Z_MM - pinhole[2]) / rays[2]
    x, y = pinhole[:2, None] + t * rays[:2]
    if not flat:  # the rim waves by a millimetre, as a badly mounted film's
        t = (rim_wave(x, y) - pinhole[2]) / rays[2]
        x, y = pinhole[:2, None] + t * rays[:2]
    lit = (np.hypot(x, y) < RIM_MM) * 180.0
    side = int(np.sqrt(own.rays.shape[1] / (612 * 512)))
    seen = lit.reshape(512, side, 612, side).mean(axis=(1, 3))
    return np.asarray(seen + np.random.default_rng(1).normal(0, 0.5, seen.shape))


def rim_z(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.full_like(x, RIM_Z_MM)


def rim_wave(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(RIM_Z_MM + np.cos(2 * np.arctan2(y, x)))


def fitted(light: FloatArray, rim: object = rim_z) -> RingPose:
    outline = find_outline(light, STATED, RIM_MM, RIM_Z_MM)
    assert outline is not None
    return ring_pose(light, STATED, outline.rim_px, RIM_MM, rim, 0.2)  # type: ignore[arg-type]


def test_the_pose_is_found_within_its_sigmas() -> None:
    pose = fitted(picture())
    error = pose.values - np.array([TRUE[name] for name in POSE_NAMES])
    # hand's sigmas are weighed in: what the ring says little of stays near 0
    assert np.all(np.abs(error) < 2.5 * pose.sigmas), dict(
        zip(POSE_NAMES, error / pose.sigmas, strict=True)
    )
    known = dict(zip(POSE_NAMES, pose.sigmas, strict=True))
    assert known["a_mm"] < 1.5
    assert known["camera_yaw_deg"] < 0.01
    assert known["camera_pitch_deg"] < 0.002
    assert pose.points > 700
    assert pose.rms_px < 0.3


def test_a_rim_that_waves_is_followed() -> None:
    light = picture(flat=False)
    followed, ignored = fitted(light, rim_wave), fitted(light)
    assert followed.rms_px < ignored.rms_px
    assert followed.values == pytest.approx(fitted(picture()).values, abs=0.02)


def test_half_a_rim_is_refused() -> None:
    light = picture()
    outline = find_outline(light, STATED, RIM_MM, RIM_Z_MM)
    assert outline is not None
    light[:, :320] = 0.0
    with pytest.raises(ValueError, match="of the rim is seen as an edge of light"):
        ring_pose(light, STATED, outline.rim_px, RIM_MM, rim_z, 0.2)


def test_edges_are_found_to_a_fraction_of_a_pixel() -> None:
    row, column = np.indices((400, 400)).astype(float)
    light = 100 * np.clip(120.3 - np.hypot(column - 201.2, row - 198.7) + 0.5, 0, 1)
    theta = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    rough = np.array([[200.0], [200.0]]) + 119 * np.stack([np.cos(theta), np.sin(theta)])
    edges = rim_edges(light, rough)
    radii = np.hypot(edges[0] - 201.2, edges[1] - 198.7)
    assert radii == pytest.approx(120.3, abs=0.1)
    assert radii.mean() == pytest.approx(120.3, abs=0.01)
