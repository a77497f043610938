"""What the screen should show: levels 0..1 by place, and the frames of a set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]

STEPS, PERIODS, PERIOD_MM = 4, 8, 49.82
CROSSED_PERIODS = 32
GRAY_BITS = 4


@dataclass(frozen=True)
class Picture:
    """One picture of the screen.

    Attributes
    ----------
    role : "sin", "gray", "white", "black" or "crossed"
    axis : "x", "y" or ""
    index : int
        Phase step from 0, or Gray bit from 1.
    shift_rad : (float, float)
        Phase steps along x and y; of a sinusoid the first.
    """

    role: str
    axis: str = ""
    index: int = 0
    shift_rad: tuple[float, float] = (0.0, 0.0)

    @property
    def name(self) -> str:
        """Name of its file without ending."""
        return "_".join(part for part in (self.axis, self.role, str(self.index)) if part)

    def level(self, s_x_mm: Singles, s_y_mm: Singles) -> Singles:
        """Level 0..1 at places on the screen; 0 outside the pattern."""
        half_mm = PERIODS * PERIOD_MM / 2
        inside = (np.abs(s_x_mm) < half_mm) & (np.abs(s_y_mm) < half_mm)
        if self.role == "crossed":
            waves = _fringes(s_x_mm, PERIOD_MM * PERIODS / CROSSED_PERIODS, self.shift_rad[0])
            waves += _fringes(s_y_mm, PERIOD_MM * PERIODS / CROSSED_PERIODS, self.shift_rad[1])
            level = 0.5 + waves / 4
        elif self.role == "sin":
            place = s_x_mm if self.axis == "x" else s_y_mm
            level = 0.5 + _fringes(place, PERIOD_MM, self.shift_rad[0]) / 2
        elif self.role == "gray":
            place = s_x_mm if self.axis == "x" else s_y_mm
            half_period = np.clip(
                np.floor(2 * (place + half_mm) / PERIOD_MM), 0, 2 * PERIODS - 1
            ).astype(np.int32)
            code = half_period ^ (half_period // 2)
            level = ((code // 2 ** (GRAY_BITS - self.index)) % 2).astype(np.float32)
        else:
            level = np.full(s_x_mm.shape, float(self.role == "white"), np.float32)
        return np.asarray(np.where(inside, level, 0.0), np.float32)


def _fringes(place_mm: Singles, period_mm: float, shift_rad: float) -> Singles:
    """Cosine that is -1 at the pattern's low edge."""
    low_mm = -PERIODS * PERIOD_MM / 2
    turns = (place_mm - np.float32(low_mm)) * np.float32(1 / period_mm)
    angle = np.float32(2 * np.pi) * (turns - np.floor(turns)) + np.float32(shift_rad - np.pi)
    return np.asarray(np.cos(angle), np.float32)


def full_set() -> list[Picture]:
    """The 18 pictures of a full set, in the order of the documentation."""
    pictures = []
    for axis in ("x", "y"):
        shifts = [2 * np.pi * k / STEPS for k in range(STEPS)]
        pictures += [Picture("sin", axis, k, (shift, 0.0)) for k, shift in enumerate(shifts)]
        pictures += [Picture("gray", axis, bit) for bit in range(1, GRAY_BITS + 1)]
    return [*pictures, Picture("white"), Picture("black")]


def tracking_set(frames: int, stepped: bool = True) -> list[Picture]:
    """Crossed fringes: five steps first, then the same picture."""
    shifts = [2 * np.pi * k / 5 for k in range(5)] if stepped else []
    pictures = [Picture("crossed", index=k, shift_rad=(s, 2 * s)) for k, s in enumerate(shifts)]
    rest = range(len(pictures), frames)
    return [*pictures, *(Picture("crossed", index=k) for k in rest)]
