"""The display's response, measured with a grey ramp, and the levels that make its light linear."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_iface.roles import Pattern

FloatArray = NDArray[np.float64]

RAMP_LEVELS = tuple(round(255 * step / 16) for step in range(17))  # a cubic between 17 points is off by < 0.2 %
# Light of the levels in between, of the whole; less is a ramp that saw nothing
_LEAST_SWING_ADU = 10.0
# A step back by more than this share of the whole is no noise: something moved, or the display adapts its light
_LARGEST_STEP_BACK = 0.02


@dataclass(frozen=True, slots=True)
class DisplayResponse:
    """Light against level."""

    levels: FloatArray  # (K,), rising, first 0 and last 255
    light: FloatArray  # (K,), 0..1, strictly rising

    @property
    def gamma(self) -> float:
        """Exponent of the power law that is nearest to the middle half of the ramp; for people."""
        middle = (self.light > 0.1) & (self.light < 0.9)
        x, y = np.log(self.levels[middle] / 255.0), np.log(self.light[middle])
        return float(np.sum(x * y) / np.sum(x * x))

    def levels_of(self, light: ArrayLike) -> NDArray[np.uint8]:
        """Levels that give this light (0..1), to the nearest of 256."""
        from scipy.interpolate import PchipInterpolator

        level = np.arange(256.0)
        curve = PchipInterpolator(self.levels, self.light)(level)  # monotone where the ramp is
        wanted = np.clip(np.asarray(light, np.float64), 0.0, 1.0)
        return np.asarray(np.rint(np.interp(wanted, curve, level)), np.uint8)


def linear_response() -> DisplayResponse:
    """A display whose light is its level."""
    return DisplayResponse(np.array([0.0, 255.0]), np.array([0.0, 1.0]))


def measured_response(levels: ArrayLike, seen_adu: ArrayLike) -> DisplayResponse:
    """The response from a ramp.

    Raises ValueError if the camera saw no ramp, with the remedy.

    Parameters
    ----------
    levels : (K,) array
        What was shown, rising, from 0 to 255.
    seen_adu : (K,) array
        What the camera saw, unsaturated.
    """
    shown, seen = np.asarray(levels, np.float64), np.asarray(seen_adu, np.float64)
    if (
        shown.shape != seen.shape
        or shown.size < 3
        or shown[0] != 0
        or shown[-1] != 255
        or np.any(np.diff(shown) <= 0)
    ):
        raise ValueError("a ramp has rising levels from 0 to 255, and one reading each")
    swing_adu = seen[-1] - seen[0]
    if not np.isfinite(seen).all() or swing_adu < _LEAST_SWING_ADU:
        raise ValueError(f"the camera sees no ramp ({swing_adu:.1f} counts from black to white); exposure, aim?")
    light = (seen - seen[0]) / swing_adu
    if np.min(np.diff(light)) < -_LARGEST_STEP_BACK:
        raise ValueError("the light falls where the level rises: switch off the display's dynamic contrast")
    if np.count_nonzero(light > 0.995) > 2:
        raise ValueError("the ramp saturates; lower the camera's exposure_ms")
    rising = np.maximum.accumulate(light) + 1e-9 * np.arange(light.size)
    return DisplayResponse(shown, (rising - rising[0]) / (rising[-1] - rising[0]))


# Patterns as the pixels of a screen (docs/interfaces.md section 2).

_GRAY_BITS = 4


@dataclass(frozen=True, slots=True)
class ScreenRaster:
    """The screen's pixels, and the pattern region on them: a square centred on O'.

    Raises ValueError if the region does not fit on the screen.
    """

    width_px: int
    height_px: int
    pixel_mm: float  # pitch
    periods: int
    period_mm: float
    centre_px: tuple[float, float] | None = None  # (column, row) of O'; None: the middle of the screen

    def __post_init__(self) -> None:
        (column, row), half_px = self.centre, self.half_side_mm / self.pixel_mm
        room_px = min(column + 0.5, row + 0.5, self.width_px - 0.5 - column, self.height_px - 0.5 - row)
        if half_px > room_px:
            raise ValueError(
                f"the pattern of {self.periods} x {self.period_mm:g} mm needs {2 * half_px:.0f} pixels of "
                f"{self.pixel_mm:g} mm, the screen has {2 * room_px:.0f}; lower period_mm or periods"
            )

    @property
    def centre(self) -> tuple[float, float]:
        """O' as (column, row); pixel centres are at integers."""
        return self.centre_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)

    @property
    def half_side_mm(self) -> float:
        """Half the side of the pattern region."""
        return self.periods * self.period_mm / 2

    def from_low_edge_mm(self, axis: str) -> FloatArray:
        """Distance s from the low edge of the region, of each column ("x") or row ("y": s grows upward)."""
        column, row = self.centre
        if axis == "x":
            pixels = np.arange(self.width_px, dtype=np.float64) - column
        else:
            pixels = row - np.arange(self.height_px, dtype=np.float64)
        return np.asarray(pixels * self.pixel_mm + self.half_side_mm, np.float64)


def pattern_light(pattern: Pattern, raster: ScreenRaster) -> NDArray[np.float32]:
    """Light (0..1) of every pixel, (height, width); dark outside the region.

    Raises ValueError for a role or Gray bit that is unknown.
    """
    inside = {axis: _inside(raster.from_low_edge_mm(axis), 2 * raster.half_side_mm) for axis in "xy"}
    lit = {axis: inside[axis].astype(np.float32) for axis in "xy"}
    if pattern.role in ("white", "black"):
        return np.outer(lit["y"], lit["x"]) * np.float32(pattern.role == "white")
    profile = _profile(pattern, raster.from_low_edge_mm(pattern.axis), raster.period_mm)
    lit[pattern.axis] *= profile.astype(np.float32)
    return np.outer(lit["y"], lit["x"])


def checkerboard(width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Black and white pixel by pixel: what no scaler passes on."""
    return np.asarray(np.indices((height_px, width_px)).sum(axis=0) % 2 * 255, np.uint8)


def _inside(s_mm: FloatArray, side_mm: float) -> NDArray[np.bool_]:
    return (s_mm >= 0) & (s_mm < side_mm)


def _profile(pattern: Pattern, s_mm: FloatArray, period_mm: float) -> FloatArray:
    if pattern.role == "sin":  # phi = 2 pi s / T - pi
        phi = 2 * math.pi * s_mm / period_mm - math.pi
        return np.asarray(0.5 + 0.5 * np.cos(phi + pattern.shift_rad))
    if pattern.role == "gray" and 1 <= pattern.index <= _GRAY_BITS:
        v2 = np.floor(2 * s_mm / period_mm).astype(np.int64)
        return np.asarray((v2 ^ (v2 >> 1)) >> (_GRAY_BITS - pattern.index) & 1, np.float64)
    raise ValueError(f"pattern {pattern.name!r}: role must be sin, gray (bit 1..{_GRAY_BITS}), white or black")
