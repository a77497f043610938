"""A bench that is not as it is stated: geometry, light, air, glass and film differ at random."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.optics import (
    CameraConfig,
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
    SigmasConfig,
)
from membrane_ctrl.geometry.spread_file import geometry_spread
from membrane_ctrl.metrology.figure.set_motion import LASER_NOISE_UM
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.pattern_levels import pattern_sequence
from membrane_ctrl.sim.optics.trace import Trace

FloatArray = NDArray[np.float64]

# bend of a ray per mm and K/m: the air's refractive index falls with temperature
AIR_PER_MM = 0.93e-9
GLASS_INDEX = 1.52
STEEL_PER_K = 12e-6
SHRINK = 8  # 64 pixels in one: the noise of the pixels counts eight times
CALIBRATED = 0.01  # of the default sigmas
CAMERA = CameraConfig(width_px=2448 // SHRINK, height_px=2048 // SHRINK, pixel_um=3.45 * SHRINK)


@dataclass
class BentRays(OpticsRenderer):
    """The twin's film and screen, seen by rays that the air bends and that end on pixels behind
    glass.

    Temperature that grows upward bends a ray down: it is a parabola. The screen's plane is the
    front of the glass.
    """

    air_k_per_m: float = 0.0
    glass_mm: float = 0.0

    def _trace_film(self, directions: FloatArray, displacement_um: float) -> Trace:
        found = super()._trace_film(directions, displacement_um)
        start, bend = (
            self._camera_pose.position_mm,
            np.array([0.0, -AIR_PER_MM * self.air_k_per_m, 0.0]),
        )
        vertex_z_mm = -(displacement_um - self.reference_um) / 1000.0

        def height_mm(x: FloatArray, y: FloatArray) -> FloatArray:
            return self.film.height_mm(x, y, displacement_um)

        seen = np.isfinite(found.s_x_mm) & (
            found.x_mm**2 + found.y_mm**2 < (1.05 * self.film.radius_mm) ** 2
        )
        ray = directions[seen]
        t = ((found.x_mm[seen] - start[0]) / ray[:, 0])[:, None]
        for _ in range(6):  # fixed point: the film is flat beside the rays
            p = start + t * ray + t**2 / 2 * bend
            t = t + ((vertex_z_mm + height_mm(p[:, 0], p[:, 1]) - p[:, 2]) / ray[:, 2])[:, None]
        p = start + t * ray + t**2 / 2 * bend
        x, y, step = p[:, 0], p[:, 1], 0.05
        slopes = [
            height_mm(x + dx, y + dy) - height_mm(x - dx, y - dy)
            for dx, dy in ((step, 0), (0, step))
        ]
        normal = np.stack(
            [-slopes[0] / (2 * step), -slopes[1] / (2 * step), np.ones_like(x)], axis=1
        )
        arriving = ray + t * bend
        away = arriving - 2 * np.sum(arriving * normal, axis=1, keepdims=True) * normal / np.sum(
            normal**2, axis=1, keepdims=True
        )
        found.s_x_mm[seen], found.s_y_mm[seen] = self._behind_glass(p, away, bend).T
        found.x_mm[seen], found.y_mm[seen] = x, y
        return found

    def _behind_glass(self, start_mm: FloatArray, away: FloatArray, bend: FloatArray) -> FloatArray:
        """s_x and s_y (n, 2) of the pixels that rays from `start_mm` (n, 3) show."""
        screen = self._screen_pose
        face = np.stack([screen.s_x, screen.s_y, np.cross(screen.s_x, screen.s_y)])
        q, out, down = (start_mm - screen.origin_mm) @ face.T, away @ face.T, face @ bend
        path = -q[:, 2] / out[:, 2]
        for _ in range(6):
            on = q + path[:, None] * out + path[:, None] ** 2 / 2 * down
            off_mm = screen.bow_per_mm * np.sum(on[:, :2] ** 2, axis=1)
            path = path + (off_mm - on[:, 2]) / out[:, 2]
        on = q + path[:, None] * out + path[:, None] ** 2 / 2 * down
        across = out[:, :2] / np.linalg.norm(out, axis=1, keepdims=True) / GLASS_INDEX  # Snell
        return np.asarray(
            on[:, :2]
            + self.glass_mm * across / np.sqrt(1 - np.sum(across**2, axis=1, keepdims=True))
        )


class DirectRays(BentRays):
    """The screen itself before the camera, behind its glass."""

    def _trace_film(
        self, directions: FloatArray, displacement_um: float, film: Any = None
    ) -> Trace:
        bend, none = np.array([0.0, -AIR_PER_MM * self.air_k_per_m, 0.0]), np.zeros(len(directions))
        start_mm = np.tile(self._camera_pose.position_mm, (len(directions), 1))
        return Trace(none, none, *self._behind_glass(start_mm, directions, bend).T)


def stated_bench(calibrated: bool) -> OpticsConfig:
    """The bench that the sets state."""
    share = CALIBRATED if calibrated else 1.0
    sigmas = {name: share * value for name, value in SigmasConfig().model_dump().items()}
    geometry = GeometryConfig(
        a_mm=2672.0,
        b_mm=2871.0,
        alpha_deg=80.9,
        a_sigma_mm=2.0 * share,
        b_sigma_mm=2.0 * share,
        alpha_sigma_deg=0.3 * share,
        sigmas=SigmasConfig(**sigmas),
        reference_displacement_um=0.0,
    )
    return OpticsConfig(geometry=geometry, camera=CAMERA)


def stated_sigmas(stated: OpticsConfig) -> SigmasConfig:
    """Of what is not calibrated."""
    return stated.geometry.sigmas or SigmasConfig()


def true_bench(
    stated: OpticsConfig, rng: np.random.Generator
) -> tuple[OpticsConfig, dict[str, float]]:
    """The bench as it really is, grown since it was measured; and by how much each input was stated
    wrong.
    """
    spread, _ = geometry_spread(stated, None)
    off = dict(zip(spread.names, spread.draw_change(rng), strict=True))
    grown = 1 + STEEL_PER_K * stated_sigmas(stated).temperature_k * rng.standard_normal()
    return bench_off_by(stated, off, grown), off


def bench_off_by(
    stated: OpticsConfig, off: Mapping[str, float], grown: float = 1.0
) -> OpticsConfig:
    """The bench that is stated wrong by these amounts, and has grown by this factor since."""
    there = bench_at(Geometry.from_config(stated), np.array([off.get(name, 0.0) for name in NAMES]))
    geometry = there.geometry
    rows = [tuple(row) for row in geometry.rotation]
    camera = CameraPoseConfig(
        position_mm=tuple(grown * geometry.pinhole_mm), rotation=(rows[0], rows[1], rows[2])
    )
    screen = ScreenPoseConfig(
        origin_mm=tuple(grown * geometry.screen_origin_mm),
        s_x=tuple(geometry.screen_s_x),
        s_y=tuple(geometry.screen_s_y),
        bow_mm=off.get("bow_mm", 0.0),
    )
    lens = {
        "focal_mm": geometry.focal_px * stated.camera.pixel_um * 1e-3,
        "principal_px": geometry.principal_px,
    }
    return OpticsConfig(
        geometry=GeometryConfig(camera=camera, screen=screen, reference_displacement_um=0.0),
        camera=stated.camera.model_copy(
            update={
                **lens,
                "distortion": geometry.distortion,
                "bits": 16,
                "noise_adu": 0.0,
            }  # see `Room.stack`
        ),
        pattern=stated.pattern.model_copy(
            update={"period_mm": stated.pattern.period_mm * there.pitch}
        ),
    )


@dataclass
class Room:
    """Light, blur, laser, dust and the film's motion of one bench, the same for all of its sets."""

    gamma: float
    flicker: float
    ambient: float
    blur_px: float
    laser: bool
    moves_um: float
    dust: bool
    stale: bool
    held: bool = False  # the film comes to the same place in each set
    mean_um: float = 0.0  # of the film in the last set

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Room:
        """At random."""
        return cls(
            gamma=float(rng.choice([1.0, rng.uniform(1.0, 2.2)])),
            flicker=float(rng.choice([0.0, rng.uniform(0.0, 0.015)])),
            ambient=float(rng.choice([0.0, rng.uniform(0.0, 0.05)])),
            blur_px=float(rng.choice([0.0, rng.uniform(0.0, 8.0)])),
            laser=bool(rng.random() < 0.6),
            moves_um=float(rng.choice([0.5, rng.uniform(1.0, 30.0)])),
            dust=bool(rng.random() < 0.3),
            stale=bool(rng.random() < 0.1),
        )

    def causes(self) -> list[str]:
        """What is wrong with the sets."""
        named = {
            "gamma": self.gamma > 1,
            "flicker": self.flicker > 0,
            "ambient light": self.ambient > 0,
        }
        named |= {
            "blur": self.blur_px > 0,
            "no laser": not self.laser,
            "film moves": self.moves_um > 0.5,
        }
        named |= {"dust": self.dust, "stale frame": self.stale}
        return [name for name, there in named.items() if there]

    def stack(
        self,
        render: Callable[[Any, float, float], FloatArray],
        rng: np.random.Generator,
        camera: CameraConfig,
    ) -> FrameStack:
        """A set whose film moves by a random walk about its mean. `render` gives 16 bits without
        noise.

        The camera's noise, and its one rounding, come after the blur.
        """
        shown = pattern_sequence("full", OpticsConfig().pattern)
        where_um = (
            self.moves_um * np.cumsum(rng.standard_normal(len(shown))) / math.sqrt(len(shown))
        )
        where_um += rng.uniform(-20.0, 20.0) * (self.moves_um > 0)
        if self.held:
            where_um -= where_um.mean()
        white = render(shown[-2], 0.0, 1.0)
        frames = []
        for k, (pattern, place_um) in enumerate(zip(shown, where_um, strict=True)):
            frame = render(pattern, float(place_um), 1 + self.flicker * rng.standard_normal())
            frame = frame + self.ambient * white / 2 * k / len(shown)
            if self.blur_px:
                frame = cv2.GaussianBlur(frame, (0, 0), self.blur_px / SHRINK)
            full = 2**camera.bits - 1
            frame = frame * (full / (2**16 - 1)) + camera.noise_adu * rng.standard_normal(
                frame.shape
            )
            frames.append(
                np.clip(np.rint(frame), 0, full).astype(np.uint8 if camera.bits == 8 else np.uint16)
            )
        if self.dust:
            for row, column in rng.integers(20, 230, (20, 2)):
                for frame in frames[:: rng.integers(1, 3)]:
                    frame[row : row + 2, column : column + 2] //= 2
        if self.stale:
            late = int(rng.integers(1, 8))
            frames[late] = frames[late - 1]
        readings = (
            where_um + LASER_NOISE_UM * rng.standard_normal(len(shown))
            if self.laser
            else np.full(len(shown), np.nan)
        )
        sinusoids = [k for k, pattern in enumerate(shown) if pattern.role == "sin"]
        self.mean_um = float(where_um[sinusoids].mean())
        return FrameStack(np.stack(frames), tuple(shown), readings, {})
