"""Crossed fringes of a bench whose parts move during the frames; its rays share no code with the
product.

Camera, screen, mirror, sensor and lens are moved in the world's own vectors: the ray of a pixel,
the plane of the screen and the film are those of `crossed_fringes`, moved by turns and shifts that
are written here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.worlds.crossed_fringes import RADIUS_MM, Array, CrossedWorld

# What moves: µm along and µrad about the camera's right, down and forward, the screen's s_x, s_y
# and normal, the world's x, y and z (mirror); µm of the sensor, and ppm of the focal length.
PARTS = tuple(
    f"{body}_{axis}" for body in ("camera", "screen", "mirror") for axis in ("x", "y", "z")
)
TURNS = tuple(
    f"{body}_r{axis}" for body in ("camera", "screen", "mirror") for axis in ("x", "y", "z")
)
LENS = ("sensor_x", "sensor_y", "focal")
Course = Callable[[float], float]


def _spin(vector: Array, axis: Array, angle: float) -> Array:
    """A vector turned about a unit axis."""
    return np.asarray(
        vector * math.cos(angle)
        + np.cross(axis, vector) * math.sin(angle)
        + axis * (axis @ vector) * (1 - math.cos(angle))
    )


def _spin_all(vectors: list[Array], about: list[Array], urad: list[float]) -> list[Array]:
    for axis, angle in zip(about, urad, strict=True):
        vectors = [_spin(vector, axis, 1e-6 * angle) for vector in vectors]
    return vectors


@dataclass
class MovingBench(CrossedWorld):
    """The bench with motions by name, each a function of time; the film may change, too."""

    motions: Mapping[str, Course] = field(default_factory=dict)
    # change of the film above the ring's plane, in µm, at places in radii and a time
    film_um: Callable[[Array, Array, float], Array] | None = None

    def _now(self, name: str, t: float) -> float:
        course = self.motions.get(name)
        return 0.0 if course is None else float(course(t))

    def film_mm(self, x: Array, y: Array, t: Any) -> Array:
        height = super().film_mm(x, y, t)
        if self.film_um is None:
            return height
        return np.asarray(height + 1e-3 * self.film_um(x / RADIUS_MM, y / RADIUS_MM, float(t)))

    def trace(self, t: Any) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
        """As the world's, on the moved bench."""
        now = float(np.mean(t))
        # The paper's bench: a camera that looks at the mirror's centre, a screen opposite to it
        alpha = math.radians(self.alpha_deg)
        cosine = math.cos(alpha)
        sine = math.sin(alpha)
        pinhole = self.a_mm * np.array([cosine, 0.0, sine])
        forward = -np.array([cosine, 0.0, sine])
        right = np.array([sine, 0.0, -cosine])
        down = np.array([0.0, -1.0, 0.0])
        into = np.array([cosine, 0.0, -sine])  # the screen
        origin = -self.b_mm * into
        s_x = np.array([-sine, 0.0, -cosine])
        s_y = np.array([0.0, 1.0, 0.0])
        # The motions of this moment
        bodies = ("camera", "screen", "mirror")
        shift = {
            body: [1e-3 * self._now(f"{body}_{axis}", now) for axis in "xyz"] for body in bodies
        }
        turn = {body: [self._now(f"{body}_r{axis}", now) for axis in "xyz"] for body in bodies}
        # Camera and screen move along and about their own axes
        axes = [right, down, forward]
        pinhole = pinhole + sum(mm * axis for mm, axis in zip(shift["camera"], axes, strict=True))
        right, down, forward = _spin_all(axes, axes, turn["camera"])
        axes = [s_x, s_y, -into]
        origin = origin + sum(mm * axis for mm, axis in zip(shift["screen"], axes, strict=True))
        s_x, s_y, normal = _spin_all(axes, axes, turn["screen"])
        # In the moved mirror's frame, the rest of the bench has moved the opposite way.
        world = list(np.eye(3))
        mirror = np.array(shift["mirror"])
        back = [-urad for urad in turn["mirror"]]
        pinhole, origin = _spin_all([pinhole - mirror, origin - mirror], world[::-1], back[::-1])
        right, down, forward, s_x, s_y, normal = _spin_all(
            [right, down, forward, s_x, s_y, normal], world[::-1], back[::-1]
        )
        # The rays of the pixels
        row, column = np.mgrid[: self.height, : self.width].astype(float)
        focal_mm = self.focal_mm * (1 + 1e-6 * self._now("focal", now))
        scale = self.pixel_um * 1e-3 / focal_mm
        off_x, off_y = (self._now(f"sensor_{axis}", now) / self.pixel_um for axis in "xy")
        across = (column + off_x - (self.width - 1) / 2) * scale
        along = (row + off_y - (self.height - 1) / 2) * scale
        ray = forward + across[..., None] * right + along[..., None] * down
        # Where they meet the film, by fixed-point iteration
        low = self.vertex_z_mm(now)
        height = np.zeros(row.shape)
        for _ in range(9):
            reach = (low + height - pinhole[2]) / ray[..., 2]
            x = pinhole[0] + reach * ray[..., 0]
            y = pinhole[1] + reach * ray[..., 1]
            near = np.hypot(x, y) < 1.05 * RADIUS_MM
            height = np.where(near, self.film_mm(x, y, now), height)
        # Reflected at the film's normal, by central differences
        e = 0.25
        by_x = (self.film_mm(x + e, y, now) - self.film_mm(x - e, y, now)) / (2 * e)
        by_y = (self.film_mm(x, y + e, now) - self.film_mm(x, y - e, now)) / (2 * e)
        up = np.stack([-by_x, -by_y, np.ones_like(x)], axis=-1)
        up /= np.linalg.norm(up, axis=-1, keepdims=True)
        away = ray - 2 * np.sum(ray * up, axis=-1, keepdims=True) * up
        # Where the reflections meet the screen
        place = np.stack([x, y, low + height], axis=-1)
        far = ((origin - place) @ normal) / (away @ normal)
        hit = place + far[..., None] * away - origin
        return hit @ s_x, hit @ s_y, x, y, np.hypot(x, y) <= RADIUS_MM
