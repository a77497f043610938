"""Patterns as the pixels of a screen (docs/reference/interfaces.md section 2)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.arrays import FloatArray
from firmware_iface.optical_roles import Pattern

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
    # (column, row) of O'; None: the middle of the screen
    centre_px: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        (column, row), half_px = self.centre, self.half_side_mm / self.pixel_mm
        room_px = min(
            column + 0.5, row + 0.5, self.width_px - 0.5 - column, self.height_px - 0.5 - row
        )
        if half_px > room_px:
            raise ValueError(
                f"the pattern of {self.periods} x {self.period_mm:g} mm needs {2 * half_px:.0f} "
                f"pixels of {self.pixel_mm:g} mm, the screen has {2 * room_px:.0f}; lower "
                "period_mm or periods"
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
        """Distance s from the low edge of the region, of each column ("x") or row ("y": s grows
        upward).
        """
        column, row = self.centre
        if axis == "x":
            pixels = np.arange(self.width_px, dtype=np.float64) - column
        else:
            pixels = row - np.arange(self.height_px, dtype=np.float64)
        return np.asarray(pixels * self.pixel_mm + self.half_side_mm, np.float64)


def compute_pattern_light(pattern: Pattern, raster: ScreenRaster) -> NDArray[np.float32]:
    """Return the light of every pixel of a screen that shows a pattern.

    Parameters
    ----------
    pattern : Pattern
        Role, axis, index and phase step.
    raster : ScreenRaster
        The screen's pixels, and the pattern's region on it.

    Returns
    -------
    (height, width) float32 array
        From 0 to 1; dark outside the region.

    Raises
    ------
    ValueError
        An unknown role or Gray bit.
    """
    side_mm = 2 * raster.half_side_mm
    s_mm = {axis: raster.from_low_edge_mm(axis) for axis in "xy"}
    inside = {axis: _is_inside(s_mm[axis], side_mm) for axis in "xy"}
    lit = {axis: inside[axis].astype(np.float32) for axis in "xy"}
    if pattern.role == "white":
        return np.outer(lit["y"], lit["x"])
    if pattern.role == "black":
        return np.zeros((lit["y"].size, lit["x"].size), dtype=np.float32)
    if pattern.role == "crossed":
        # The mean of a wave along x and one along y
        period_mm = side_mm / pattern.index
        shifts_rad = {"x": pattern.shift_rad, "y": pattern.shift_y_rad}
        for axis, shift_rad in shifts_rad.items():
            sine = Pattern("sin", axis, shift_rad=shift_rad)
            wave = _pattern_profile(sine, s_mm[axis], period_mm)
            lit[axis] = 0.5 * wave.astype(np.float32)
        return np.add.outer(lit["y"], lit["x"]) * np.outer(inside["y"], inside["x"])
    # Stripes: the light changes along one axis alone
    profile = _pattern_profile(pattern, s_mm[pattern.axis], raster.period_mm)
    lit[pattern.axis] *= profile.astype(np.float32)
    return np.outer(lit["y"], lit["x"])


def make_checkerboard(width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Black and white pixel by pixel, which no scaler reproduces.

    Parameters
    ----------
    width_px, height_px : int
        Size of the panel.

    Returns
    -------
    ndarray of uint8, shape (height_px, width_px)
        Levels 0 and 255; the upper left pixel is black.
    """
    return np.asarray(np.indices((height_px, width_px)).sum(axis=0) % 2 * 255, np.uint8)


def _is_inside(s_mm: FloatArray, side_mm: float) -> NDArray[np.bool_]:
    return (s_mm >= 0) & (s_mm < side_mm)


def _pattern_profile(pattern: Pattern, s_mm: FloatArray, period_mm: float) -> FloatArray:
    if pattern.role == "sin":  # phi = 2 pi s / T - pi
        phi = 2 * math.pi * s_mm / period_mm - math.pi
        return np.asarray(0.5 + 0.5 * np.cos(phi + pattern.shift_rad))
    if pattern.role == "gray" and 1 <= pattern.index <= _GRAY_BITS:
        half_period = np.floor(2 * s_mm / period_mm).astype(np.int64)
        gray_code = half_period ^ (half_period >> 1)
        bit = gray_code >> (_GRAY_BITS - pattern.index) & 1
        return np.asarray(bit, np.float64)
    raise ValueError(
        f"pattern {pattern.name!r}: role must be sin, gray (bit 1..{_GRAY_BITS}), white or black"
    )
