"""The frames of one set in memory, and their means over bins."""

import math
from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.metrology.numerics.compiled import kernel, split
from membrane_ctrl.metrology.phase.bin_phasors import Binner, StepCombination, arctan2, still
from membrane_ctrl.metrology.phase.phase_steps import AXES, step_design, step_weights
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, IntArray, Singles

_ENOUGH_BINS = 50_000  # for the terms and for the checks of the frames; more only cost time
_LARGEST_BIN_PX = 4  # curvature of the phase over a larger bin is no longer small


@dataclass(frozen=True)
class FrameStack:
    """Frames of a capture set in the order of their patterns."""

    frames: Image  # (frames, height, width): uint8 or uint16
    patterns: tuple[Pattern, ...]  # what each frame should show; sinusoids with their phase step
    displacement_um: FloatArray  # (frames,): laser reading at each, NaN without
    unusable: dict[int, str]  # frames that hold no picture
    # (2, frames): level and swing of the light of each sinusoid about 1, where the frames' light is
    # known to differ
    light: FloatArray | None = None
    # (frames, height): of the light of each row, where bands of a backlight are known
    gain: FloatArray | None = None

    def sinusoids(self, axis: str) -> list[int]:
        """Frames that show the sinusoids of an axis."""
        return [k for k, p in enumerate(self.patterns) if p.role == "sin" and p.axis == axis]

    def gray(self, axis: str) -> list[int]:
        """Frames that show the Gray bits of an axis, most significant first; empty for fringes
        alone.
        """
        return [k for k, p in enumerate(self.patterns) if p.role == "gray" and p.axis == axis]

    def single(self, role: str) -> int | None:
        """The white or the black frame."""
        return next((k for k, p in enumerate(self.patterns) if p.role == role), None)

    def shifts_rad(self, frames: list[int]) -> FloatArray:
        """Phase steps of sinusoids."""
        return np.array([self.patterns[k].shift_rad for k in frames])

    def design(self, frames: list[int]) -> FloatArray:
        """`phase.step_design` of sinusoids (N, 3)."""
        return step_design(
            self.shifts_rad(frames), None if self.light is None else self.light[:, frames]
        )

    def weights(self, frames: list[int]) -> FloatArray:
        """`phase.step_weights` of sinusoids (3, N). Raises ValueError if they do not determine a
        phase.
        """
        return step_weights(
            self.shifts_rad(frames), None if self.light is None else self.light[:, frames]
        )

    def reordered(self, order: list[int]) -> "FrameStack":
        """The same with other pictures for the patterns: frame k shows what `order[k]` did."""
        gain = None if self.gain is None else self.gain[order]
        return replace(self, frames=self.frames[order], light=None, gain=gain)

    @property
    def readings_um(self) -> FloatArray:
        """Laser readings of the sinusoids, x and then y."""
        return self.displacement_um[[k for axis in AXES for k in self.sinusoids(axis)]]

    @property
    def mean_reading_um(self) -> float:
        """Their mean, to which a figure refers; NaN unless all have one."""
        return float(np.mean(self.readings_um))

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width."""
        return self.frames.shape[1], self.frames.shape[2]


@dataclass(frozen=True)
class Binned:
    """Frames as means over bins."""

    bin_px: int  # side of a bin
    means: Singles  # (frames, rows, columns): in the frames' units
    saturated: BoolArray  # (frames, rows, columns): bins with a saturated pixel

    def reordered(self, order: list[int]) -> "Binned":
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


# Phase, modulation and closure of every pixel: the full result's pass over the frames.


@dataclass(frozen=True)
class PixelPhases:
    """One axis at n pixels."""

    phase_rad: FloatArray  # (n,): absolute phase, the period nearest to the reference
    swing_adu: Singles  # (n,): fringe amplitude
    rest_adu: (
        Singles  # (n,): root of the sum of squares that the sinusoid leaves; 0 for three frames
    )
    saturated: BoolArray  # (n,): whether a frame is saturated there


@kernel
def _phases(  # type: ignore[no-untyped-def]
    frames, index, fade, weights, design, turn, mirror, slope, reference, limit, out, start, stop
):
    """Rows of `out` (2, n): swing (negative where saturated) and rest; `reference` (n,) is replaced
    by the phase.
    """
    steps, height = fade.shape
    for p in range(start, stop):
        place = index[p]
        row = place // (frames.shape[1] // height)
        mean = 0.0
        c = 0.0
        s = 0.0
        top = 0.0
        for k in range(steps):
            value = float(frames[k, place])
            top = max(top, value)
            value *= fade[k, row]
            mean += weights[0, k] * value
            c += weights[1, k] * value
            s += weights[2, k] * value
        rest = 0.0
        for k in range(steps):
            left = (
                float(frames[k, place]) * fade[k, row]
                - mean * design[k, 0]
                - c * design[k, 1]
                - s * design[k, 2]
            )
            rest += left * left
        c, s = still(c, s, slope[p], turn, mirror)
        wrapped = arctan2(s, c)
        reference[p] = wrapped + 2 * math.pi * math.floor(
            (reference[p] - wrapped) / (2 * math.pi) + 0.5
        )
        swing = math.sqrt(c * c + s * s)
        out[0, p] = -swing if top >= limit else swing
        out[1, p] = math.sqrt(rest)


def pixel_phases(
    frames: Image,
    design: FloatArray,
    combined: StepCombination,
    index: IntArray,
    sensitivity_rad_per_um: FloatArray,
    reference_rad: FloatArray,
    full_scale_adu: int,
    gain: FloatArray | None = None,
) -> PixelPhases:
    """Phases of one axis.

    Parameters
    ----------
    frames : (N, height, width) array
        The axis' usable sinusoids.
    design : (N, 3) array
        Their steps and light (`phase.step_design`).
    combined : StepCombination
        Motion of the film between them (`motion.combine_steps` for bins of one pixel).
    index : (n,) int array
        Pixels, counted row by row.
    sensitivity_rad_per_um : (n,) array
        Change of phase per µm of displacement; zeros if no motion is corrected.
    reference_rad : (n,) array
        Absolute phase to within half a period; not changed.
    gain : (N, height) array, optional
        Of the light of the rows of each frame.
    """
    flat = frames.reshape(len(frames), -1)
    phase = reference_rad.copy()
    out = np.empty((2, index.size), np.float32)
    fade = np.ones(frames.shape[:2]) if gain is None else 1 / gain
    fixed = (fade, np.linalg.pinv(design), design, combined.turn, combined.mirror)

    def run(start: int, stop: int) -> None:
        _phases(
            flat,
            index,
            *fixed,
            sensitivity_rad_per_um,
            phase,
            float(full_scale_adu),
            out,
            start,
            stop,
        )

    split(run, index.size)
    return PixelPhases(phase, np.abs(out[0]), out[1], np.signbit(out[0]))
