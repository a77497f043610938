"""A simulation of crossed fringes whose rays, film, panel, light and air share no code with the
product.

Film: a height function of its own, moving with time; rays by fixed-point steps, normals by
differences of the height.
Panel: a response that is not straight, brightness that wanders in space and time, dimming, a pulsed
backlight, pictures that stick. Room: ambient light with a slope. Air: waves that bend the rays.
Stand: grows along the camera's axis. Dust: spots that move now and then. The film may vibrate, and
the camera's shutter may roll.
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
from scipy import ndimage, special

Array = NDArray[np.float64]
PERIODS, PERIOD_MM, CROSSED = 8, 49.82, 32
SIDE_MM = PERIODS * PERIOD_MM
RADIUS_MM = 500.0
# Vibrations: frequency, lobes and circles of each
DRUM = ((27.13, 1, 1), (48.21, 2, 1), (57.37, 0, 1), (61.09, 0, 2))
EXPOSURE_S, DUTY = 0.02, 0.7


def _bessel(lobes: int, circles: int) -> Array:
    """Coefficients of J_m(z r) / r^m as a polynomial of r^2, z the zero at the rim; unit RMS times
    cos(m theta).
    """
    zero = special.jn_zeros(lobes, circles)[-1]
    rms = abs(special.jv(lobes + 1, zero)) * (math.sqrt(0.5) if lobes else 1.0)
    series = [
        (-1) ** k
        * (zero / 2) ** (2 * k + lobes)
        / (special.factorial(k) * special.factorial(k + lobes))
        for k in range(14)
    ]
    return np.asarray(np.array(series[::-1]) / rms)


_BESSEL = [_bessel(lobes, circles) for _, lobes, circles in DRUM]


@dataclass
class Waves:
    """A random field: waves whose lengths are about `length_mm`; each amplitude forgets itself in
    `memory_s`.
    """

    rms: float
    length_mm: float
    memory_s: float
    reach_mm: float  # from the middle: the field is that of the nearest edge beyond
    seed: int
    count: int = 40
    _time_s: float = 0.0

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        k = self._random.normal(0, 2 * math.pi / self.length_mm / 2, (self.count, 2))
        self._amplitude = self._random.normal(size=(2, self.count))
        self._nodes_mm, self._step_mm = np.linspace(
            -self.reach_mm,
            self.reach_mm,
            1 + math.ceil(20 * self.reach_mm / self.length_mm),
            retstep=True,
        )
        x, y = np.meshgrid(self._nodes_mm, self._nodes_mm)
        angle = np.multiply.outer(k[:, 0], x) + np.multiply.outer(k[:, 1], y)
        self._waves = np.stack([np.cos(angle), np.sin(angle)])

    def at(self, time_s: float, x: Array, y: Array) -> Array:
        """The field at places (mm), by cubic splines between nodes a tenth of its length apart."""
        keep = math.exp(-abs(time_s - self._time_s) / self.memory_s)
        fresh = self._random.normal(size=(2, self.count))
        self._amplitude = keep * self._amplitude + math.sqrt(1 - keep**2) * fresh
        self._time_s = time_s
        nodes = self.rms / math.sqrt(self.count) * np.tensordot(self._amplitude, self._waves, 2)
        places = [(place + self.reach_mm) / self._step_mm for place in (y, x)]
        return np.asarray(ndimage.map_coordinates(nodes, places, order=3, mode="nearest"))


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
    astigmatism_mm: tuple[float, float] = (0.25, 0.1)
    coma_mm: float = 0.05
    ripple_mm: float = 0.004
    ripple_waves: tuple[float, float] = (3.0, 5.0)  # radians over the radius along x, y
    side_mm: float = SIDE_MM  # of the pattern
    crossed_periods: int = CROSSED
    contrast: float = 1.0  # of the crossed pattern
    laser_um: float = math.nan  # noise of the laser's readings; NaN gives none
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
    backlight_hz: float = 0.0  # of its pulses; 0 is steady
    rolling_s: float = 0.0  # from the first row to the last
    sticking: float = 0.0  # light that is lost where the panel has always been bright
    sticking_s: float = 3600.0
    drum_nm: float = 0.0  # RMS amplitude of each vibration
    bits: int = 8
    seed: int = 1
    _light: Waves = field(init=False)
    _air: tuple[Waves, Waves] = field(init=False)

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._light = Waves(self.brightness, 75.0, 60.0, self.side_mm / 2, self.seed + 1)
        self._air = (
            Waves(self.air_um, 400.0, 0.5, RADIUS_MM, self.seed + 2),
            Waves(self.air_um, 400.0, 0.5, RADIUS_MM, self.seed + 3),
        )
        self._height = np.zeros((0, 0))  # of the rays' places, of the last frame
        self._burnt, self._shown_s = np.zeros(2, complex), 0.0
        self._dust = np.ones((0, 0))
        self._phase = self._random.uniform(0, 2 * math.pi, 4)
        self._spots = self._random.uniform(-0.9, 0.9, (self.dust, 2)) * RADIUS_MM

    def sag_um(self, t: Any) -> Any:
        """Without the vibrations."""
        return (
            1e3 * self.sag_mm
            + self.drift_um_per_s * t
            + self.swing_um * np.sin(0.7 * t + self._phase[0])
        )

    def film_mm(self, x: Array, y: Array, t: Any) -> Array:
        """Height above the vertex of the film without vibrations, and these; `t` is one time or
        that of each row.
        """
        u, v = x / RADIUS_MM, y / RADIUS_MM
        q = u * u + v * v
        bowl = q * (1.075 - 0.06 * q - 0.015 * q * q)
        swing = [
            1e-3 * self.shimmer_um * np.sin(w * t + p)
            for w, p in zip((1.3, 2.1, 0.9), self._phase[1:], strict=True)
        ]
        out = 1e-3 * self.sag_um(t) * bowl + (self.astigmatism_mm[0] + swing[0]) * (u * u - v * v)
        out = (
            out
            + (self.astigmatism_mm[1] + swing[1]) * 2 * u * v
            + (self.coma_mm + swing[2]) * u * (3 * q - 2)
        )
        out = out + self.ripple_mm * np.cos(self.ripple_waves[0] * u + self.ripple_waves[1] * v)
        for k, (hz, lobes, _) in enumerate(DRUM if self.drum_nm else ()):
            part = np.polyval(_BESSEL[k], q) * (1.0, u, u * u - v * v)[lobes]
            out = out + 1e-6 * self.drum_nm * np.sin(2 * math.pi * hz * t + k) * part
        return np.asarray(out)

    def vertex_z_mm(self, t: Any) -> Any:
        """The ring rests: the vertex sinks as the bowl deepens."""
        return (1e3 * self.sag_mm - self.sag_um(t)) * 1e-3

    def kelvin_at(self, t: float) -> float:
        return self.kelvin * math.sin(2 * math.pi * t / 1200.0)

    def trace(self, t: Any) -> tuple[Array, Array, Array, Array, NDArray[np.bool_]]:
        """Screen coordinates, place on the mirror and whether it is inside the rim, of every pixel.

        `t` is one time, or that of each row, (height, 1).
        """
        now = float(np.mean(t))
        # The paper's bench: a camera that looks at the mirror's centre, a screen opposite to it
        alpha = math.radians(self.alpha_deg)
        cosine = math.cos(alpha)
        sine = math.sin(alpha)
        pinhole = (self.a_mm + 0.060 * self.kelvin_at(now)) * np.array([cosine, 0.0, sine])
        forward = -np.array([cosine, 0.0, sine])
        right = np.array([sine, 0.0, -cosine])
        down = np.array([0.0, -1.0, 0.0])
        # The rays of the pixels
        row, column = np.mgrid[: self.height, : self.width].astype(float)
        scale = self.pixel_um * 1e-3 / self.focal_mm
        across = (column - (self.width - 1) / 2) * scale
        along = (row - (self.height - 1) / 2) * scale
        ray = forward + across[..., None] * right + along[..., None] * down
        # Where they meet the film, by fixed-point iteration: each round leaves a thirtieth of the
        # height's error, and the heights of the last frame are a good start
        known = self._height.shape == row.shape
        low = self.vertex_z_mm(t)
        h = self._height if known else np.zeros(row.shape)
        for _ in range(3 if known else 8):
            reach = (low + h - pinhole[2]) / ray[..., 2]
            x = pinhole[0] + reach * ray[..., 0]
            y = pinhole[1] + reach * ray[..., 1]
            h = np.where(np.hypot(x, y) < 1.05 * RADIUS_MM, self.film_mm(x, y, t), h)
        self._height = h
        # Reflected at the film's normal, by central differences
        e = 0.25
        slope_x = (self.film_mm(x + e, y, t) - self.film_mm(x - e, y, t)) / (2 * e)
        slope_y = (self.film_mm(x, y + e, t) - self.film_mm(x, y - e, t)) / (2 * e)
        normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        back = ray - 2 * np.sum(ray * normal, axis=-1, keepdims=True) * normal
        # Where the reflections meet the screen
        into = np.array([cosine, 0.0, -sine])  # the screen
        origin = -self.b_mm * into
        place = np.stack([x, y, low + h], axis=-1)
        far = ((origin - place) @ into) / (back @ into)
        hit = place + far[..., None] * back - origin
        s_x = hit @ np.array([-sine, 0.0, -cosine])
        s_y = hit @ np.array([0.0, 1.0, 0.0])
        if self.air_um:
            s_x = s_x + 1e-3 * self._air[0].at(now, x, y)
            s_y = s_y + 1e-3 * self._air[1].at(now, x, y)
        return s_x, s_y, x, y, np.hypot(x, y) <= RADIUS_MM

    def frame(self, t: float, pattern: Any, gain: float = 1.0) -> NDArray[Any]:
        """What the camera sees of a pattern, a function of s_x and s_y from the low edge that gives
        0 to 1.
        """
        rows = (
            t + self.rolling_s * np.linspace(-0.5, 0.5, self.height)[:, None]
            if self.rolling_s
            else t
        )
        s_x, s_y, x, y, inside = self.trace(rows)
        level = np.clip(pattern(s_x + self.side_mm / 2, s_y + self.side_mm / 2), 0, 1)
        lit = level + self.bend * np.sin(math.pi * level) ** 2
        if self.brightness:
            lit = lit * (1 + self._light.at(t, s_x, s_y))
        shown = np.maximum(np.abs(s_x), np.abs(s_y)) < self.side_mm / 2
        lit = np.where(shown, 0.02 + 0.98 * lit * (1 - self.dim_per_s * t), 0.02)
        if self._dust.shape != x.shape:
            self._dust = np.ones(x.shape)
            for spot_x, spot_y in self._spots:
                self._dust *= 1 - 0.6 * np.exp(
                    -((x - spot_x) ** 2 + (y - spot_y) ** 2) / (2 * 6.0**2)
                )
        lit = lit * self._dust * self._backlight(rows)
        room = self.ambient_adu * (1 + 0.3 * x / RADIUS_MM + 0.2 * math.sin(0.05 * t))
        corner = 1 - 0.1 * (x**2 + y**2) / RADIUS_MM**2
        counts = 5 + np.where(inside, room + 190 * gain * lit * corner, 0.0)
        counts += self._random.normal(0, self.noise_adu, counts.shape)
        full = 2**self.bits - 1
        return np.asarray(
            np.rint(counts * full / 255).clip(0, full), np.uint8 if self.bits == 8 else np.uint16
        )

    def _backlight(self, t: Any) -> Any:
        """Light of an exposure whose middle is `t`, over the mean."""
        if not self.backlight_hz:
            return 1.0
        begin, end = (self.backlight_hz * (t + side * EXPOSURE_S / 2) for side in (-1, 1))
        lit = [
            np.floor(turns) * DUTY + np.minimum(turns - np.floor(turns), DUTY)
            for turns in (begin, end)
        ]
        return (lit[1] - lit[0]) / (DUTY * self.backlight_hz * EXPOSURE_S)

    def move_dust(self) -> None:
        self._spots = self._random.uniform(-0.9, 0.9, (self.dust, 2)) * RADIUS_MM
        self._dust = np.ones((0, 0))

    def crossed(
        self, t: float, shift_x: float = 0.0, shift_y: float = 0.0, gain: float = 1.0
    ) -> NDArray[Any]:
        """A frame of the crossed pattern, which has been shown since the frame before."""
        rate = 2 * math.pi * self.crossed_periods / self.side_mm
        keep = math.exp(-(t - self._shown_s) / self.sticking_s)
        self._burnt, self._shown_s = (
            keep * self._burnt + (1 - keep) * np.exp([1j * shift_x, 1j * shift_y]),
            t,
        )

        def pattern(s_x: Array, s_y: Array) -> Array:
            turns = [rate * s - math.pi for s in (s_x, s_y)]
            shown = (
                0.5 + self.contrast * (np.cos(turns[0] + shift_x) + np.cos(turns[1] + shift_y)) / 4
            )
            if self.sticking:
                stuck = [
                    self.contrast * np.real(b * np.exp(1j * turn))
                    for b, turn in zip(self._burnt, turns, strict=True)
                ]
                shown = shown * (1 - self.sticking * (0.5 + (stuck[0] + stuck[1]) / 4))
            return np.asarray(shown)

        return self.frame(t, pattern, gain)

    def _laser(self, t: float) -> dict[str, float]:
        """The reading of a row, against the film at rest."""
        if math.isnan(self.laser_um):
            return {}
        return {
            "displacement_um": float(
                self.sag_um(t) - 1e3 * self.sag_mm + self._random.normal(0, self.laser_um)
            )
        }

    def _table(self, kind: str) -> dict[str, Any]:
        pattern = {"steps": 4, "periods": PERIODS, "period_mm": self.side_mm / PERIODS}
        return {"schema": "membrane-capture/1", "kind": kind, "pattern": pattern}

    def write_reference(self, folder: Path, t: float = 0.0, frame_s: float = 0.0) -> None:
        """Write the 18 frames of a full set, one every `frame_s`; with 0 the film is at rest."""
        folder.mkdir(parents=True)
        rows = []
        for k, (name, row, pattern) in enumerate(_full(self.side_mm / PERIODS)):
            at_s = t + frame_s * k
            cv2.imwrite(str(folder / f"{name}.png"), self.frame(at_s, pattern))
            rows.append({"file": f"{name}.png", **row, **self._laser(at_s)})
        table = self._table("full")
        table["geometry"] = {"a_mm": self.a_mm, "b_mm": self.b_mm, "alpha_deg": self.alpha_deg}
        table["camera"] = {
            "width_px": self.width,
            "height_px": self.height,
            "focal_mm": self.focal_mm,
            "pixel_um": self.pixel_um,
            "noise_adu": self.noise_adu * (2**self.bits - 1) / 255,
            "bits": self.bits,
        }
        table["mirror"] = {"radius_mm": RADIUS_MM, "analysis_radius_mm": 475.0}
        table["frames"] = rows
        (folder / "capture.toml").write_text(tomli_w.dumps(table))

    def write_track(
        self,
        folder: Path,
        times: Array,
        step_every_s: float = 10.0,
        dust_every: int = 25,
        first_steps: int = 5,
    ) -> None:
        """Write a tracking set beside `full`: first steps, then a pattern that stands still from
        step to step.
        """
        folder.mkdir(parents=True)
        rows, step, stepped_s = [], -1, -math.inf
        for k, t in enumerate(times):
            if self.dust and k % dust_every == dust_every - 1:
                self.move_dust()
            if k < first_steps or t - stepped_s >= step_every_s:
                step, stepped_s = step + 1, float(t)
            shift_x, shift_y = 2 * math.pi * (step % 5) / 5, 2 * math.pi * (2 * step % 5) / 5
            cv2.imwrite(str(folder / f"t{k}.png"), self.crossed(float(t), shift_x, shift_y))
            rows.append(
                {
                    "file": f"t{k}.png",
                    "role": "crossed",
                    "shift_x_rad": shift_x,
                    "shift_y_rad": shift_y,
                    "time_s": float(t),
                    **self._laser(float(t)),
                }
            )
        table = self._table("track") | {"reference": "../full", "frames": rows}
        table["pattern"]["crossed"] = {
            "periods": self.crossed_periods,
            "period_mm": self.side_mm / self.crossed_periods,
            "contrast": self.contrast,
        }
        (folder / "capture.toml").write_text(tomli_w.dumps(table))

    def height_um(self, t: float, x: Array, y: Array) -> Array:
        """The true height above the vertex."""
        zero = np.zeros(1)
        return 1e3 * (self.film_mm(x, y, t) - self.film_mm(zero, zero, t))


def _full(period_mm: float) -> Any:
    """Names, rows and patterns of a full set."""
    rate = 2 * math.pi / period_mm
    for axis in ("x", "y"):

        def along(s_x: Array, s_y: Array, axis: str = axis) -> Array:
            return s_x if axis == "x" else s_y

        for k in range(4):

            def wave(s_x: Array, s_y: Array, k: int = k, along: Any = along) -> Array:
                return np.asarray(
                    0.5 + 0.5 * np.cos(rate * along(s_x, s_y) - math.pi + k * math.pi / 2)
                )

            yield f"{axis}{k}", {"role": "sin", "axis": axis, "index": k}, wave
        for bit in range(1, 5):

            def gray(s_x: Array, s_y: Array, bit: int = bit, along: Any = along) -> Array:
                half = np.clip(np.floor(2 * along(s_x, s_y) / period_mm), 0, 15).astype(int)
                return np.asarray(((half ^ (half >> 1)) >> (4 - bit)) & 1, float)

            yield f"{axis}g{bit}", {"role": "gray", "axis": axis, "index": bit}, gray
    yield "white", {"role": "white"}, lambda s_x, _: np.ones_like(s_x)
    yield "black", {"role": "black"}, lambda s_x, _: np.zeros_like(s_x)
