"""The screen as measured: where a fraction of it lies in mm, and what grey value it showed.

Both are curves through calibration points; the code behind knows only the curves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

FloatArray = NDArray[np.float64]


class ScreenShape(Protocol):
    """Position on the screen plane of a fraction of the pattern."""

    def screen_mm(self, screens: FloatArray) -> FloatArray:
        """Screen coordinates (2, N) in mm of fractions (2, N); NaN off the screen."""
        ...


@dataclass(frozen=True)
class RectangularScreen:
    """A flat screen with square corners and an even raster; (0.5, 0.5) is its origin."""

    width_mm: float
    height_mm: float

    def screen_mm(self, screens: FloatArray) -> FloatArray:
        """Screen coordinates (2, N) in mm of fractions (2, N)."""
        size = np.array([[self.width_mm], [self.height_mm]])
        return np.asarray(np.where((screens >= 0) & (screens <= 1), (screens - 0.5) * size, np.nan))


@dataclass(frozen=True)
class MeasuredScreen:
    """A flat screen on which the raster was measured at points.

    Between the points it is linear on triangles: no assumption on the projector's lens, and the error is the
    sagitta of the distortion over one cell.
    """

    points_screens: FloatArray
    points_mm: FloatArray

    @cached_property
    def _interpolate(self) -> LinearNDInterpolator:
        return LinearNDInterpolator(self.points_screens.T, self.points_mm.T)

    def screen_mm(self, screens: FloatArray) -> FloatArray:
        """Screen coordinates (2, N) in mm of fractions (2, N); NaN outside the measured points."""
        return np.asarray(self._interpolate(screens.T).T)


@dataclass(frozen=True)
class DisplayResponse:
    """Grey value shown against grey value seen, `camera_adu` rising."""

    camera_adu: FloatArray
    display_levels: FloatArray

    def __post_init__(self) -> None:
        """Refuse a curve that cannot be read backwards."""
        if len(self.camera_adu) != len(self.display_levels) or not np.all(np.diff(self.camera_adu) > 0):
            raise ValueError("display response: camera values must rise with every display value")

    def shown_levels(self, frames: FloatArray, black: FloatArray, white: FloatArray) -> FloatArray:
        """Levels the screen showed, (N, ...), from frames (N, ...), black and white (...) as seen.

        The curve is that of a bright pixel; each pixel's own gain and stray light are taken out by stretching its
        levels so that black and white are 0 and the curve's end. NaN where white is not above black.
        """
        low, high = self._levels(black), self._levels(white)
        span = np.where(high > low, high - low, np.nan)
        return np.asarray((self._levels(frames) - low) * (self.display_levels[-1] / span))

    def _levels(self, adu: FloatArray) -> FloatArray:
        return np.asarray(np.interp(adu, self.camera_adu, self.display_levels))
