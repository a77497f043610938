"""The frames of one set in memory, and their means over bins."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import Pattern
from membrane_ctrl.metrology.patterns import AXES
from membrane_ctrl.metrology.phasor import Binner

FloatArray = NDArray[np.float64]
Frames = NDArray[np.uint8] | NDArray[np.uint16]

_ENOUGH_BINS = 50_000  # for 36 terms and for the checks of the frames; more only cost time
_LARGEST_BIN_PX = 4  # curvature of the phase over a larger bin is no longer small


@dataclass(frozen=True)
class FrameStack:
    """Frames of a capture set in the order of their patterns.

    Attributes
    ----------
    frames : (frames, height, width) array
        uint8 or uint16.
    patterns : tuple of Pattern
        What each frame should show; sinusoids with their phase step.
    displacement_um : (frames,) array
        Laser reading at each, NaN without.
    unusable : dict from frame to reason
        Frames that hold no picture.
    """

    frames: Frames
    patterns: tuple[Pattern, ...]
    displacement_um: FloatArray
    unusable: dict[int, str]

    def sinusoids(self, axis: str) -> list[int]:
        """Frames that show the sinusoids of an axis."""
        return [k for k, p in enumerate(self.patterns) if p.role == "sin" and p.axis == axis]

    def gray(self, axis: str) -> list[int]:
        """Frames that show the Gray bits of an axis, most significant first; empty for fringes alone."""
        return [k for k, p in enumerate(self.patterns) if p.role == "gray" and p.axis == axis]

    def single(self, role: str) -> int | None:
        """The white or the black frame."""
        return next((k for k, p in enumerate(self.patterns) if p.role == role), None)

    def shifts_rad(self, frames: list[int]) -> FloatArray:
        """Phase steps of sinusoids."""
        return np.array([self.patterns[k].shift_rad for k in frames])

    def reordered(self, order: list[int]) -> FrameStack:
        """The same with other pictures for the patterns: frame k shows what `order[k]` did."""
        return replace(self, frames=self.frames[order])

    @property
    def readings_um(self) -> FloatArray:
        """Laser readings of the sinusoids, x and then y."""
        return self.displacement_um[[k for axis in AXES for k in self.sinusoids(axis)]]

    @property
    def mean_reading_um(self) -> float:
        """Their mean, the moment that a figure belongs to; NaN unless all have one."""
        return float(np.mean(self.readings_um))

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width."""
        return self.frames.shape[1], self.frames.shape[2]


@dataclass(frozen=True)
class Binned:
    """Frames as means over bins.

    Attributes
    ----------
    bin_px : int
        Side of a bin.
    means : (frames, rows, columns) float32 array
        In the frames' units.
    saturated : (frames, rows, columns) bool array
        Bins with a saturated pixel.
    """

    bin_px: int
    means: NDArray[np.float32]
    saturated: NDArray[np.bool_]

    def reordered(self, order: list[int]) -> Binned:
        """As `FrameStack.reordered`."""
        return replace(self, means=self.means[order], saturated=self.saturated[order])


def bin_side_px(size_px: tuple[int, int]) -> int:
    """The largest bin that leaves enough of them."""
    return int(np.clip((size_px[0] * size_px[1] / _ENOUGH_BINS) ** 0.5, 1, _LARGEST_BIN_PX))


def bin_frames(stack: FrameStack, full_scale_adu: int) -> Binned:
    """Means and saturation of each frame over bins."""
    bin_px = bin_side_px(stack.size_px)
    binner = Binner(*stack.size_px, bin_px, full_scale_adu, 1)
    shape = (len(stack.patterns), *binner.saturated.shape)
    means, saturated = np.empty(shape, np.float32), np.empty(shape, bool)
    for k, frame in enumerate(stack.frames):
        binner.clear()
        binner.add([frame], [0])
        np.multiply(binner.sums[0], 1 / bin_px**2, out=means[k], casting="unsafe")
        saturated[k] = binner.saturated > 0
    return Binned(bin_px, means, saturated)
