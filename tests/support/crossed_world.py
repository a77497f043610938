"""A second world of crossed fringes: rays, film, panel, light and air share no code with the product.

Film: a height function of its own, moving with time; rays by fixed-point steps, normals by differences of the height.
Panel: a response that is not straight, brightness that wanders in space and time, dimming. Room: ambient light with a
slope. Air: waves that bend the rays. Stand: grows along the camera's axis. Dust: spots that move now and then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w
from numpy.typing import NDArray

Array = NDArray[np.float64]
PERIODS, PERIOD_MM, CROSSED = 8, 49.82, 32
SIDE_MM = PERIODS * PERIOD_MM
RADIUS_MM = 500.0


@dataclass
class Waves:
    """A random field: waves whose lengths are about `length_mm`; each amplitude forgets itself in `memory_s`."""

    rms: float
    length_mm: float
    memory_s: float
    seed: int
    count: int = 40
    _time_s: float = 0.0

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._k = self._random.normal(0, 2 * math.pi / self.length_mm / 2, (self.count, 2))
        self._amplitude = self._random.normal(size=(2, self.count))

    def at(self, time_s: float, x: Array, y: Array) -> Array:
        keep = math.exp(-abs(time_s - self._time_s) / self.memory_s)
        fresh = self._random.normal(size=(2, self.count))
        self._amplitude = keep * self._amplitude + math.sqrt(1 - keep**2) * fresh
        self._time_s = time_s
        angle = np.multiply.outer(self._k[:, 0], x) + np.multiply.outer(self._k[:, 1], y)
        cosine, sine = self._amplitude
        field = np.tensordot(cosine, np.cos(angle), 1) + np.tensordot(sine, np.sin(angle), 1)
        return np.asarray(self.rms / math.sqrt(self.count) * field)


@dataclass
class CrossedWorld:
    """The bench; switch a disturbance off with 0."""

    width: int = 306
    height: int = 256
    pixel_um: float = 27.6
    focal_mm: float = 16.0
    a_mm: float = 2672.0
    b_mm: float = 2871.0
    alpha_deg: float = 80.9
    sag_mm: float = 37.1
    drift_um_per_s: float = 0.002
    swing_um: float = 0.3
    shimmer_um: float = 0.1  # swing of astigmatism and coma
    noise_adu: float = 0.4
    brightness: float = 0.005
    ambient_adu: float = 2.0
    bend: float = 0.04  # of the panel's response
    dim_per_s: float = 1e-5
    dust: int = 20
    air_um: float = 0.1  # on the screen
    kelvin: float = 0.0  # swing of the stand's temperature
    seed: int = 1
    _light: Waves = field(init=False)
    _air: tuple[Waves, Waves] = field(init=False)

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._light = Waves(self.brightness, 75.0, 60.0, self.seed + 1)
        self._air = (Waves(self.air_um, 400.0, 0.5, self.seed + 2), Waves(self.air_um, 400.0, 0.5, self.seed + 3))
        self._phase = self._random.uniform(0, 2 * math.pi, 4)
        self._spots = self._random.uniform(-0.9, 0.9, (self.dust, 2)) * RADIUS_MM

    def sag_um(self, t: float) -> float:
        return 1e3 * self.sag_mm + self.drift_um_per_s * t + self.swing_um * math.sin(0.7 * t + self._phase[0])

    def film_mm(self, x: Array, y: Array, t: float) -> Array:
        """Height above the vertex."""
        u, v = x / RADIUS_MM, y / RADIUS_MM
        q = u * u + v * v
        bowl = q * (1.075 - 0.06 * q - 0.015 * q * q)
        wave = 1e-3 * self.shimmer_um * np.sin(np.array([1.3, 2.1, 0.9]) * t + self._phase[1:])
        out = 1e-3 * self.sag_um(t) * bowl + (0.25 + wave[0]) * (u * u - v * v) + (0.1 + wave[1]) * 2 * u * v
        return np.asarray(out + (0.05 + wave[2]) * u * (3 * q - 2) + 0.004 * np.cos(3.0 * u + 5.0 * v))

    def vertex_z_mm(self, t: float) -> float:
        """The ring rests: the vertex sinks as the bowl deepens."""
        return (1e3 * self.sag_mm - self.sag_um(t)) * 1e-3

    def kelvin_at(self, t: float) -> float:
        return self.kelvin * math.sin(2 * math.pi * t / 1200.0)

    def trace(self, t: float) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
        """Screen coordinates, place on the mirror and whether it is inside the rim, of every pixel."""
        alpha = math.radians(self.alpha_deg)
        pinhole = (self.a_mm + 0.060 * self.kelvin_at(t)) * np.array([math.cos(alpha), 0.0, math.sin(alpha)])
        forward = -np.array([math.cos(alpha), 0.0, math.sin(alpha)])
        right, down = np.array([math.sin(alpha), 0.0, -math.cos(alpha)]), np.array([0.0, -1.0, 0.0])
        row, column = np.mgrid[: self.height, : self.width].astype(float)
        scale = self.pixel_um * 1e-3 / self.focal_mm
        across, along = (column - (self.width - 1) / 2) * scale, (row - (self.height - 1) / 2) * scale
        ray = forward + across[..., None] * right + along[..., None] * down
        low, h = self.vertex_z_mm(t), np.zeros(row.shape)
        for _ in range(8):
            reach = (low + h - pinhole[2]) / ray[..., 2]
            x, y = pinhole[0] + reach * ray[..., 0], pinhole[1] + reach * ray[..., 1]
            h = np.where(np.hypot(x, y) < 1.05 * RADIUS_MM, self.film_mm(x, y, t), h)
        e = 0.25
        slope_x = (self.film_mm(x + e, y, t) - self.film_mm(x - e, y, t)) / (2 * e)
        slope_y = (self.film_mm(x, y + e, t) - self.film_mm(x, y - e, t)) / (2 * e)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        back = ray - 2 * np.sum(ray * normal, axis=-1, keepdims=True) * normal
        away = np.array([math.cos(alpha), 0.0, -math.sin(alpha)])  # into the screen
        origin = -self.b_mm * away
        place = np.stack([x, y, low + h], axis=-1)
        far = ((origin - place) @ away) / (back @ away)
        hit = place + far[..., None] * back - origin
        s_x, s_y = hit @ np.array([-math.sin(alpha), 0.0, -math.cos(alpha)]), hit @ np.array([0.0, 1.0, 0.0])
        if self.air_um:
            s_x = s_x + 1e-3 * self._air[0].at(t, x, y)
            s_y = s_y + 1e-3 * self._air[1].at(t, x, y)
        return s_x, s_y, x, y, np.hypot(x, y) <= RADIUS_MM

    def frame(self, t: float, pattern: Any, gain: float = 1.0) -> NDArray[np.uint8]:
        """What the camera sees of a pattern, a function of s_x and s_y from the low edge that gives 0 to 1."""
        s_x, s_y, x, y, inside = self.trace(t)
        level = np.clip(pattern(s_x + SIDE_MM / 2, s_y + SIDE_MM / 2), 0, 1)
        lit = level + self.bend * np.sin(math.pi * level) ** 2
        if self.brightness:
            lit = lit * (1 + self._light.at(t, s_x, s_y))
        shown = np.maximum(np.abs(s_x), np.abs(s_y)) < SIDE_MM / 2
        lit = np.where(shown, 0.02 + 0.98 * lit * (1 - self.dim_per_s * t), 0.02)
        for spot_x, spot_y in self._spots:
            lit = lit * (1 - 0.6 * np.exp(-((x - spot_x) ** 2 + (y - spot_y) ** 2) / (2 * 6.0**2)))
        room = self.ambient_adu * (1 + 0.3 * x / RADIUS_MM + 0.2 * math.sin(0.05 * t))
        corner = 1 - 0.1 * (x**2 + y**2) / RADIUS_MM**2
        counts = 5 + np.where(inside, room + 190 * gain * lit * corner, 0.0)
        return np.clip(np.rint(counts + self._random.normal(0, self.noise_adu, counts.shape)), 0, 255).astype(
            np.uint8
        )

    def move_dust(self) -> None:
        self._spots = self._random.uniform(-0.9, 0.9, (self.dust, 2)) * RADIUS_MM

    def crossed(self, t: float, shift_x: float = 0.0, shift_y: float = 0.0, gain: float = 1.0) -> NDArray[np.uint8]:
        """A frame of the crossed pattern."""
        rate = 2 * math.pi * CROSSED / SIDE_MM

        def pattern(s_x: Array, s_y: Array) -> Array:
            waves = np.cos(rate * s_x - math.pi + shift_x) + np.cos(rate * s_y - math.pi + shift_y)
            return np.asarray(0.5 + waves / 4)

        return self.frame(t, pattern, gain)

    def _table(self, kind: str) -> dict[str, Any]:
        pattern = {"steps": 4, "periods": PERIODS, "period_mm": PERIOD_MM}
        return {"schema": "membrane-capture/1", "kind": kind, "pattern": pattern}

    def write_reference(self, folder: Path, t: float = 0.0) -> None:
        """Write the 18 frames of a full set, the film at rest."""
        folder.mkdir(parents=True)
        rows = []
        for name, row, pattern in _full():
            cv2.imwrite(str(folder / f"{name}.png"), self.frame(t, pattern))
            rows.append({"file": f"{name}.png", **row})
        table = self._table("full")
        table["geometry"] = {"a_mm": self.a_mm, "b_mm": self.b_mm, "alpha_deg": self.alpha_deg}
        table["camera"] = {
            "width_px": self.width, "height_px": self.height, "focal_mm": self.focal_mm, "pixel_um": self.pixel_um,
            "noise_adu": self.noise_adu,
        }  # fmt: skip
        table["mirror"] = {"radius_mm": RADIUS_MM, "analysis_radius_mm": 475.0}
        table["frames"] = rows
        (folder / "capture.toml").write_text(tomli_w.dumps(table))

    def write_track(self, folder: Path, times: Array, step_every_s: float = 10.0, dust_every: int = 25) -> None:
        """Write a tracking set beside `full`: five steps, then a pattern that stands still from step to step."""
        folder.mkdir(parents=True)
        rows, step, stepped_s = [], -1, -math.inf
        for k, t in enumerate(times):
            if self.dust and k % dust_every == dust_every - 1:
                self.move_dust()
            if k < 5 or t - stepped_s >= step_every_s:
                step, stepped_s = step + 1, float(t)
            shift_x, shift_y = 2 * math.pi * (step % 5) / 5, 2 * math.pi * (2 * step % 5) / 5
            cv2.imwrite(str(folder / f"t{k}.png"), self.crossed(float(t), shift_x, shift_y))
            rows.append({
                "file": f"t{k}.png", "role": "crossed", "shift_x_rad": shift_x, "shift_y_rad": shift_y,
                "time_s": float(t),
            })  # fmt: skip
        table = self._table("track") | {"reference": "../full", "frames": rows}
        table["pattern"]["crossed"] = {"periods": CROSSED, "period_mm": SIDE_MM / CROSSED}
        (folder / "capture.toml").write_text(tomli_w.dumps(table))

    def height_um(self, t: float, x: Array, y: Array) -> Array:
        """The true height above the vertex."""
        zero = np.zeros(1)
        return 1e3 * (self.film_mm(x, y, t) - self.film_mm(zero, zero, t))


def _full() -> Any:
    """Names, rows and patterns of a full set."""
    rate = 2 * math.pi / PERIOD_MM
    for axis in ("x", "y"):

        def along(s_x: Array, s_y: Array, axis: str = axis) -> Array:
            return s_x if axis == "x" else s_y

        for k in range(4):

            def wave(s_x: Array, s_y: Array, k: int = k, along: Any = along) -> Array:
                return np.asarray(0.5 + 0.5 * np.cos(rate * along(s_x, s_y) - math.pi + k * math.pi / 2))

            yield f"{axis}{k}", {"role": "sin", "axis": axis, "index": k}, wave
        for bit in range(1, 5):

            def gray(s_x: Array, s_y: Array, bit: int = bit, along: Any = along) -> Array:
                half = np.clip(np.floor(2 * along(s_x, s_y) / PERIOD_MM), 0, 15).astype(int)
                return np.asarray(((half ^ (half >> 1)) >> (4 - bit)) & 1, float)

            yield f"{axis}g{bit}", {"role": "gray", "axis": axis, "index": bit}, gray
    yield "white", {"role": "white"}, lambda s_x, _: np.ones_like(s_x)
    yield "black", {"role": "black"}, lambda s_x, _: np.zeros_like(s_x)
