"""Photographs of a flat picture, by rays of an own lens model: no OpenCV in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]
# about the axes of the board, in degrees
_TURNS_DEG = (
    (0, 0, 0),
    (35, 0, 5),
    (-35, 5, 0),
    (0, 35, -5),
    (5, -35, 90),
    (25, 25, 10),
    (-25, 25, 180),
    (20, -30, 3),
)
_SIDE = 2  # rays a pixel, each way


@dataclass(frozen=True)
class Photographer:
    """A camera: focal length and principal point in px, k1, k2, p1, p2."""

    width_px: int
    height_px: int
    focal_px: float
    principal_px: tuple[float, float]
    lens: tuple[float, float, float, float]

    def take(
        self,
        picture: NDArray[np.uint8],
        unit_px: float,
        turn: FloatArray,
        shift: FloatArray,
        rng: np.random.Generator,
    ) -> NDArray[np.uint8]:
        """The picture, `unit_px` pixels a unit, its first pixel's outer corner at the plane's
        origin.

        A point p of the plane z = 0 is at `turn` p + `shift` in the camera.
        """
        rays = self.rays
        normal = turn[:, 2]
        place = turn.T @ (rays * (normal @ shift) / (normal @ rays) - shift[:, None])
        j, i = (np.floor(p * unit_px).astype(int) for p in place[:2])
        inside = (i >= 0) & (i < picture.shape[0]) & (j >= 0) & (j < picture.shape[1])
        light = np.full(rays.shape[1], 128.0)
        light[inside] = 40 + picture[i[inside], j[inside]] * (160 / 255)
        shape = (self.height_px, _SIDE, self.width_px, _SIDE)
        seen = light.reshape(shape).mean(axis=(1, 3)) + rng.normal(
            0, 1.0, (self.height_px, self.width_px)
        )
        return np.clip(np.round(seen), 0, 255).astype(np.uint8)

    @cached_property
    def rays(self) -> FloatArray:
        """Of all pixels, row by row, (3, n)."""
        offsets = (np.arange(_SIDE) + 0.5) / _SIDE - 0.5
        column = (np.arange(self.width_px)[:, None] + offsets).ravel()
        row = (np.arange(self.height_px)[:, None] + offsets).ravel()
        x, y = self.straight(*np.meshgrid(column, row))
        return np.stack([x, y, np.ones_like(x)]).reshape(3, -1)

    def straight(self, column: FloatArray, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Tangents of the rays through image points: the lens' formula inverted by repeated
        insertion.
        """
        k1, k2, p1, p2 = self.lens
        xd, yd = (
            (column - self.principal_px[0]) / self.focal_px,
            (row - self.principal_px[1]) / self.focal_px,
        )
        x, y = xd.copy(), yd.copy()
        for _ in range(20):
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2 * r2
            x, y = (
                (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
                (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
            )
        return x, y


def photographs(
    camera: Photographer, picture: NDArray[np.uint8], unit_px: float, count: int, seed: int
) -> list[Image]:
    """The picture turned this way and that, some 26 units away."""
    rng = np.random.default_rng(seed)
    middle = np.array([picture.shape[1], picture.shape[0], 0.0]) / (2 * unit_px)
    out = []
    for degrees in _TURNS_DEG[:count]:
        turn = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
        shift = np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(24, 28)]) - turn @ middle
        out.append(camera.take(picture, unit_px, turn, shift, rng))
    return out
