"""The frames of one capture set in memory, and their means over bins."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.metrology.phase.bin_sums import Binner
from membrane_ctrl.metrology.phase.clip_levels import ClipLevels, find_clip_levels
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.phase_steps import step_design, step_weights
from membrane_ctrl.model.arrays import BoolArray, FloatArray, Image, Singles

_ENOUGH_BINS = 50_000  # for the terms and for the checks of the frames; more only cost time
_LARGEST_BIN_PX = 4  # curvature of the phase over a larger bin is no longer small


@dataclass(frozen=True)
class FrameStack:
    """Frames of a capture set in the order of their patterns.

    Attributes
    ----------
    frames : (frames, height, width) array
        Pictures, uint8 or uint16.
    patterns : tuple of Pattern
        The pattern that each frame should show; sinusoids with their phase step.
    displacement_um : (frames,) array
        Laser reading at each, NaN without.
    unusable : dict[int, str]
        Frames that hold no picture.
    light : (2, frames) array, optional
        Level and swing of the light of each sinusoid about 1, where the frames' light is known to
        differ.
    gain : (frames, height) array, optional
        Factor of the light of each row, where bands of a backlight are known.
    before : tuple of int, optional
        The frame that was taken before each; -1: none of the set. None: the patterns were taken in
        their order.
    lag_shares : tuple[float, float]
        Shares of the previous frame's picture that each one still shows: where it is brighter than
        that one, and where it is darker.
    """

    frames: Image
    patterns: tuple[Pattern, ...]
    displacement_um: FloatArray
    unusable: dict[int, str]
    light: FloatArray | None = None
    gain: FloatArray | None = None
    before: tuple[int, ...] | None = None
    lag_shares: tuple[float, float] = (0.0, 0.0)

    def sinusoids(self, axis: str) -> list[int]:
        """Frames that show the sinusoids of an axis."""
        return [k for k, p in enumerate(self.patterns) if p.role == "sin" and p.axis == axis]

    def gray(self, axis: str) -> list[int]:
        """Frames that show the Gray bits of an axis, most significant first; empty for fringes
        alone.
        """
        return [k for k, p in enumerate(self.patterns) if p.role == "gray" and p.axis == axis]

    def find_frame(self, role: str) -> int | None:
        """The white or the black frame."""
        return next((k for k, p in enumerate(self.patterns) if p.role == role), None)

    def white_and_black(self, excluded: Collection[int]) -> tuple[int, int] | None:
        """The white and the black frame; None unless the set has both and neither is excluded."""
        white = self.find_frame("white")
        black = self.find_frame("black")
        if white is None or black is None or white in excluded or black in excluded:
            return None
        return white, black

    def frame_before(self, frame: int) -> int:
        """The frame that was taken before this one; -1: none of the set, or no picture."""
        before = frame - 1
        if self.before is not None:
            before = self.before[frame]
        if before in self.unusable:
            return -1
        return before

    @property
    def last_taken(self) -> int:
        """The frame that was taken last."""
        followed = {self.frame_before(frame) for frame in range(len(self.patterns))}
        return next(frame for frame in range(len(self.patterns)) if frame not in followed)

    def shifts_rad(self, frames: list[int]) -> FloatArray:
        """Phase steps of sinusoids."""
        return np.array([self.patterns[k].shift_rad for k in frames])

    def design(self, frames: list[int]) -> FloatArray:
        """`phase_steps.step_design` (N, 3) of sinusoids, with their light."""
        return step_design(self.shifts_rad(frames), self._light_of(frames))

    def weights(self, frames: list[int]) -> FloatArray:
        """`phase_steps.step_weights` (3, N) of sinusoids, with their light.

        Raises ValueError if they do not determine a phase.
        """
        return step_weights(self.shifts_rad(frames), self._light_of(frames))

    def _light_of(self, frames: list[int]) -> FloatArray | None:
        if self.light is None:
            return None
        return self.light[:, frames]

    def exchange_frames(self, order: list[int]) -> "FrameStack":
        """Return the set with pictures exchanged: frame k shows what `order[k]` did.

        The light of the frames is forgotten: it was measured with the wrong patterns.
        """
        gain = self.gain
        if gain is not None:
            gain = gain[order]
        new_place = {taken: frame for frame, taken in enumerate(order)}
        new_place[-1] = -1  # no frame before
        before = tuple(new_place[self.frame_before(taken)] for taken in order)
        return replace(self, frames=self.frames[order], light=None, gain=gain, before=before)

    def drop_frames(self) -> "FrameStack":
        """The set without its pictures, which take the most memory."""
        no_frames = np.empty((len(self.patterns), 0, 0), self.frames.dtype)
        return replace(self, frames=no_frames)

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


def find_frames_before(time_s: FloatArray) -> tuple[int, ...] | None:
    """Find the frame that was taken before each.

    Parameters
    ----------
    time_s : (frames,) array
        When each frame was taken, NaN without.

    Returns
    -------
    tuple of int or None
        Its number; -1 for the first. None if a time is unknown, or two are equal.
    """
    if not np.isfinite(time_s).all():
        return None
    if np.unique(time_s).size < time_s.size:
        return None
    order = np.argsort(time_s)
    before = np.full(time_s.size, -1)
    before[order[1:]] = order[:-1]
    return tuple(before.tolist())


@dataclass(frozen=True)
class Binned:
    """Frames as means over bins.

    Attributes
    ----------
    bin_px : int
        Side of a bin.
    means : (frames, rows, columns) array
        Mean of each bin, in the frames' units.
    saturated : (frames, rows, columns) bool array
        Bins with a pixel clipped at white or black.
    clip : ClipLevels
    black : (frames, rows, columns) bool array, optional
        Bins with a pixel clipped at black; None: the camera does not clip there.
    """

    bin_px: int
    means: Singles
    saturated: BoolArray
    clip: ClipLevels
    black: BoolArray | None = None

    def exchange_frames(self, order: list[int]) -> "Binned":
        """As `FrameStack.exchange_frames`."""
        black = self.black
        if black is not None:
            black = black[order]
        return replace(self, means=self.means[order], saturated=self.saturated[order], black=black)


def bin_side_px(size_px: tuple[int, int]) -> int:
    """Side of the largest bins of which there are enough, in a picture of this height and width."""
    pixels = size_px[0] * size_px[1]
    return int(np.clip((pixels / _ENOUGH_BINS) ** 0.5, 1, _LARGEST_BIN_PX))


def bin_frames(stack: FrameStack, full_scale_adu: int) -> Binned:
    """Means of each frame over bins, and which bins are clipped.

    Parameters
    ----------
    stack : FrameStack
        The frames.
    full_scale_adu : int
        Largest value of the camera's converter; the camera may clip below it
        (`find_clip_levels`).

    Returns
    -------
    Binned
        Bins of up to 4 x 4 pixels, as large as enough of them allow.
    """
    bin_px = bin_side_px(stack.size_px)

    # Where the camera clips, by the sinusoids: each pixel is bright in one of them.
    sinusoids = [k for axis in AXES for k in stack.sinusoids(axis) if k not in stack.unusable]
    clip = find_clip_levels([stack.frames[k] for k in sinusoids], full_scale_adu)

    # Means of one frame after the other; a bin is clipped if any of its pixels is.
    binner = Binner(*stack.size_px, bin_px, clip.white_adu, 1)
    shape = (len(stack.patterns), *binner.saturated.shape)
    means = np.empty(shape, np.float32)
    saturated = np.empty(shape, bool)
    for k, frame in enumerate(stack.frames):
        binner.clear_saturation()
        binner.sum_frames([frame], [0])
        np.multiply(binner.sums[0], 1 / bin_px**2, out=means[k], casting="unsafe")
        saturated[k] = binner.saturated > 0
    if clip.black_adu < 0:
        return Binned(bin_px, means, saturated, clip)
    black = _find_black_bins(stack.frames, bin_px, clip.black_adu)
    return Binned(bin_px, means, saturated | black, clip, black)


def _find_black_bins(frames: Image, bin_px: int, black_adu: int) -> BoolArray:
    """Return the bins (frames, rows, columns) with a pixel at this level or below."""
    count, height, width = frames.shape
    rows = height // bin_px
    columns = width // bin_px
    black = np.empty((count, rows, columns), bool)
    for k, frame in enumerate(frames):
        whole_bins = frame[: rows * bin_px, : columns * bin_px]
        blocks = whole_bins.reshape(rows, bin_px, columns, bin_px)
        black[k] = blocks.min(axis=(1, 3)) <= black_adu
    return black
