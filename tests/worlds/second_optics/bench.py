"""Camera, lens, screen and air of the second world.

A `Bench` is where things really are. `Bench.changed` gives the bench that differs by named errors
of a hand measurement, `Bench.moved` one whose camera or screen has moved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FULL_SIZE_PX = (2448, 2048)
FULL_PIXEL_MM = 3.45e-3
FOCAL_MM = 16.0
A_MM, B_MM, ALPHA_DEG = 2672.0, 2871.0, 80.9
SIX = ("shift_1_mm", "shift_2_mm", "shift_3_mm", "turn_1_rad", "turn_2_rad", "turn_3_rad")
STEEL_PER_K = 12e-6

# standard uncertainties of a hand measurement, and of a data sheet
HAND_SIGMAS = {
    "a_mm": 2.0,
    "b_mm": 2.0,
    "alpha_deg": 0.3,
    "screen_x_mm": 1.0,
    "screen_y_mm": 1.0,
    "screen_turn_x_deg": 0.5,
    "screen_turn_y_deg": 0.5,
    "screen_turn_z_deg": 0.2,
    "camera_yaw_deg": 0.1,
    "camera_pitch_deg": 0.1,
    "camera_roll_deg": 0.1,
    "focal_relative": 0.01,
    "principal_x_mm": 0.07,
    "principal_y_mm": 0.07,
    "k1": 0.02,
    "k2": 0.05,
    "p1": 1e-3,
    "p2": 1e-3,
    "bow_mm": 1.5,
    "pitch_relative": 1e-3,
    "laser_relative": 1e-3,
    "glass_mm": 1.0,
    "air_k_per_m": 0.5,
    "temperature_k": 2.0,
}


@dataclass(frozen=True)
class Pose:
    """A place, and unit vectors as rows: camera right, down, forward; screen s_x, s_y, out."""

    place_mm: FloatArray
    axes: FloatArray

    def moved(self, six: FloatArray) -> Pose:
        """Shifted along the own axes (mm), then turned about them (rad, a rotation vector)."""
        shift, turn = np.asarray(six[:3], float), np.asarray(six[3:], float)
        rotation = rotation_of(turn @ self.axes)
        return Pose(self.place_mm + shift @ self.axes, self.axes @ rotation.T)


@dataclass(frozen=True)
class Bench:
    """Everything that light passes between camera and screen, apart from the mirror.

    Attributes
    ----------
    distortion : tuple of float
        k1, k2, p1, p2, k3 of the lens.
    bow_mm, twist_mm, wave_mm : float
        The screen's face leaves its plane towards the mirror: by a paraboloid (its height 200 mm
        from the centre), by the saddle s_x s_y (at 200, 200 mm), and by a wave 300 mm long.
    pitch : float
        True over stated size of the screen's pixels.
    glass_mm, air_k_per_m : float
        Cover glass of the screen, vertical gradient of the air's temperature.
    """

    camera: Pose
    screen: Pose
    focal_px: float
    principal_px: tuple[float, float]
    size_px: tuple[int, int]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    bow_mm: float = 0.0
    twist_mm: float = 0.0
    wave_mm: float = 0.0
    pitch: float = 1.0
    glass_mm: float = 0.0
    air_k_per_m: float = 0.0

    @classmethod
    def paper(
        cls,
        resolution: float = 0.25,
        a_mm: float = A_MM,
        b_mm: float = B_MM,
        alpha: float = ALPHA_DEG,
    ) -> Bench:
        """The bench of the paper with larger pixels; `alpha` in degrees."""
        size_px = (round(FULL_SIZE_PX[0] * resolution), round(FULL_SIZE_PX[1] * resolution))
        camera, screen = short_form(a_mm, b_mm, alpha)
        middle = ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
        pixel_mm = FULL_PIXEL_MM * FULL_SIZE_PX[0] / size_px[0]
        return cls(camera, screen, FOCAL_MM / pixel_mm, middle, size_px)

    @property
    def pixel_mm(self) -> float:
        """Pitch of the sensor."""
        return FULL_PIXEL_MM * FULL_SIZE_PX[0] / self.size_px[0]

    def changed(self, errors: Mapping[str, float]) -> Bench:
        """The paper's bench that differs from this one by errors named as in `HAND_SIGMAS`.

        Lens, bow, glass and air are added to this bench's own. Raises ValueError for other names.
        """
        if unknown := set(errors) - set(HAND_SIGMAS):
            raise ValueError(f"unknown errors: {', '.join(sorted(unknown))}")
        off = {name: errors.get(name, 0.0) for name in HAND_SIGMAS}
        camera, screen = short_form(
            A_MM + off["a_mm"], B_MM + off["b_mm"], ALPHA_DEG + off["alpha_deg"]
        )
        turn = np.deg2rad([off["camera_pitch_deg"], off["camera_yaw_deg"], off["camera_roll_deg"]])
        camera = camera.moved(np.concatenate([np.zeros(3), turn]))
        turn = np.deg2rad(
            [off["screen_turn_x_deg"], off["screen_turn_y_deg"], off["screen_turn_z_deg"]]
        )
        screen = screen.moved(np.concatenate([[off["screen_x_mm"], off["screen_y_mm"], 0.0], turn]))
        grown = 1 + STEEL_PER_K * off["temperature_k"]
        k1, k2, p1, p2, k3 = self.distortion
        principal = (
            self.principal_px[0] + off["principal_x_mm"] / self.pixel_mm,
            self.principal_px[1] + off["principal_y_mm"] / self.pixel_mm,
        )
        return replace(
            self,
            camera=Pose(grown * camera.place_mm, camera.axes),
            screen=Pose(grown * screen.place_mm, screen.axes),
            focal_px=self.focal_px * np.exp(off["focal_relative"]),
            principal_px=principal,
            distortion=(k1 + off["k1"], k2 + off["k2"], p1 + off["p1"], p2 + off["p2"], k3),
            bow_mm=self.bow_mm + off["bow_mm"],
            pitch=self.pitch * (1 + off["pitch_relative"]),
            glass_mm=self.glass_mm + abs(off["glass_mm"]),
            air_k_per_m=self.air_k_per_m + off["air_k_per_m"],
        )

    def moved(self, camera: FloatArray, screen: FloatArray) -> Bench:
        """The bench after motions of camera and screen in six degrees of freedom each (`SIX`)."""
        return replace(self, camera=self.camera.moved(camera), screen=self.screen.moved(screen))

    def directions(self, column: FloatArray, row: FloatArray) -> FloatArray:
        """Unit vectors (3, n) of the rays of image points, through the lens."""
        x_seen = (column - self.principal_px[0]) / self.focal_px
        y_seen = (row - self.principal_px[1]) / self.focal_px
        x, y = x_seen.copy(), y_seen.copy()
        for _ in range(50):  # the lens distorts x, y into what is seen
            distorted_x, distorted_y = distort(x, y, self.distortion)
            off_x, off_y = x_seen - distorted_x, y_seen - distorted_y
            x, y = x + off_x, y + off_y
            if max(np.abs(off_x).max(), np.abs(off_y).max()) < 1e-13:
                break
        rays = np.stack([x, y, np.ones_like(x)]).T @ self.camera.axes
        return np.asarray((rays / np.linalg.norm(rays, axis=1, keepdims=True)).T)

    def face_mm(self, s_x: FloatArray, s_y: FloatArray) -> FloatArray:
        """Distance of the screen's face from its plane, towards the mirror."""
        bowl = self.bow_mm * (s_x**2 + s_y**2) / 200.0**2
        saddle = self.twist_mm * s_x * s_y / 200.0**2
        return bowl + saddle + self.wave_mm * np.sin(2 * np.pi * s_x / 300.0)


def short_form(a_mm: float, b_mm: float, alpha_deg: float) -> tuple[Pose, Pose]:
    """Camera and screen of the short form: both look at the vertex, without roll."""
    c, s = np.cos(np.deg2rad(alpha_deg)), np.sin(np.deg2rad(alpha_deg))
    camera = Pose(
        a_mm * np.array([c, 0.0, s]),
        np.array([[s, 0.0, -c], [0.0, -1.0, 0.0], [-c, 0.0, -s]]),
    )
    screen = Pose(
        b_mm * np.array([-c, 0.0, s]),
        np.array([[-s, 0.0, -c], [0.0, 1.0, 0.0], [c, 0.0, -s]]),
    )
    return camera, screen


def rotation_of(vector: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def distort(
    x: FloatArray, y: FloatArray, k: tuple[float, float, float, float, float]
) -> tuple[FloatArray, FloatArray]:
    """Where the lens images the direction (x, y, 1): radial k1, k2, k3, decentring p1, p2."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def drawn_errors(rng: np.random.Generator, share: float = 1.0) -> dict[str, float]:
    """Errors of a hand measurement, all at once; `share` multiplies their sigmas."""
    return {name: share * sigma * rng.standard_normal() for name, sigma in HAND_SIGMAS.items()}
