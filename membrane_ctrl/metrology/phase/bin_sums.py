"""Sums of frames over square bins of pixels: the first step of the live cycle.

The phasor of a bin is linear in the frames, so the frames are summed over each bin first, each
read once and in the order of its memory; the phase steps are then combined on 1/16 of the numbers.
For surfaces of Zernike terms nothing is lost by 4 x 4 bins. Colour filters do no harm: a pixel's
gain scales its phasor and leaves its phase.

One small loop a function: the compiler finds vector instructions for each of these, and for none
of their union.
"""

from collections.abc import Container, Sequence

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.metrology.numerics.threads import split_over_threads
from membrane_ctrl.model.arrays import Image

_NEVER = np.uint32(2**32 - 1)  # above any pixel
FOLLOWED_ROWS = 5  # of `phase_change.update_phases`
_NARROW_BIN_PX = 16  # bins up to here: the sum of their 256 pixels of 8 bits fits 16 bits


@compile_kernel
def _add_lines(frame, first, last, line):  # type: ignore[no-untyped-def]
    """Sum of the rows [first, last) into `line`."""
    for c in range(line.size):
        line[c] = frame[first, c]
    for row in range(first + 1, last):
        for c in range(line.size):
            line[c] += frame[row, c]


@compile_kernel
def _find_peak(frame, first, last, width):  # type: ignore[no-untyped-def]
    """Largest pixel of these rows."""
    top = frame[first, 0]
    for row in range(first, last):
        for c in range(width):
            value = frame[row, c]
            top = value if value > top else top
    return top


@compile_kernel
def _halve_line(line, out):  # type: ignore[no-untyped-def]
    """Sums of pairs."""
    for b in range(out.size):
        out[b] = line[2 * b] + line[2 * b + 1]


@compile_kernel
def _fold_line(line, bin_px, out):  # type: ignore[no-untyped-def]
    """Sums of `bin_px` neighbours."""
    for b in range(out.size):
        total = np.uint32(0)
        for c in range(b * bin_px, b * bin_px + bin_px):
            total += np.uint32(line[c])
        out[b] = total


@compile_kernel
def _count_saturated(frame, first, last, bin_px, full_scale, out):  # type: ignore[no-untyped-def]
    """Add the saturated pixels of each bin to `out`."""
    for row in range(first, last):
        for b in range(out.size):
            for c in range(b * bin_px, b * bin_px + bin_px):
                if frame[row, c] >= full_scale:
                    out[b] += np.uint32(1)


@compile_kernel
def _bin_rows(frame, bin_px, full_scale, line, sums, saturated, start, stop):  # type: ignore[no-untyped-def]
    """Sums of the bin rows [start, stop) into `sums`; their saturated pixels are added to
    `saturated`.

    `line` (2, width) is memory of a type that holds the sum of a bin's pixels.
    """
    width = line.shape[1]
    for row in range(start, stop):
        # The bin's rows first, then its columns, by halves as long as possible.
        first = row * bin_px
        last = first + bin_px
        _add_lines(frame, first, last, line[0])
        here = line[0]
        there = line[1]
        side = bin_px
        while side % 2 == 0 and side > 2:
            side //= 2
            _halve_line(here, there[: sums.shape[1] * side])
            here, there = there, here
        if side == 2:
            _halve_line(here, sums[row])
        else:
            _fold_line(here, side, sums[row])
        # Most rows have no saturated pixel.
        if _find_peak(frame, first, last, width) >= full_scale:
            _count_saturated(frame, first, last, bin_px, full_scale, saturated[row])


class Binner:
    """Sums frames over bins into memory of its own, taken once.

    Parameters
    ----------
    height_px, width_px : int
        Size of the frames; incomplete bins at the right and lower edge are omitted.
    bin_px : int
        Side of a bin.
    full_scale_adu : int
        Value from which a pixel counts as saturated.
    slots : int
        Frames kept at a time.

    Attributes
    ----------
    sums : (slots, rows, columns) uint32 array
        Sum of each bin of each frame.
    white_adu : int
        Value from which a pixel counts as saturated; may be changed between frames.
    saturated : (rows, columns) uint32 array
        Saturated pixels of each bin over the frames since `clear`.
    """

    def __init__(
        self, height_px: int, width_px: int, bin_px: int, full_scale_adu: int, slots: int
    ) -> None:
        self._size = (height_px, width_px)
        self.bin_px = bin_px
        self.white_adu = full_scale_adu
        shape = (height_px // bin_px, width_px // bin_px)
        self.sums = np.zeros((slots, *shape), np.uint32)
        self.saturated = np.zeros(shape, np.uint32)

    def clear_saturation(self) -> None:
        """Forget the saturation counts, at the start of a cycle."""
        self.saturated[:] = 0

    def sum_frames(
        self, frames: Sequence[Image], slots: Sequence[int], watched: Container[int] | None = None
    ) -> None:
        """Sum frames into slots.

        Parameters
        ----------
        frames : sequence of (height, width) arrays
            uint8 or uint16.
        slots : sequence of int
            Where each frame goes.
        watched : container of int, optional
            Slots that are checked for saturation, by default all: it does not harm white or Gray.

        Raises
        ------
        ValueError
            A frame has another size or type of pixel; nothing is summed then.
        """
        for frame in frames:
            if frame.shape != self._size:
                raise ValueError(
                    f"frame is {frame.shape[::-1]} pixels (width, height), not {self._size[::-1]}"
                )
            if frame.dtype not in (np.uint8, np.uint16):
                raise ValueError(f"frame has {frame.dtype} pixels, not uint8 or uint16")
        # From which value a pixel of each frame counts as saturated.
        limits = []
        for slot in slots:
            is_watched = watched is None or slot in watched
            limits.append(np.uint32(self.white_adu) if is_watched else _NEVER)
        width = self.sums.shape[2] * self.bin_px

        def run(start: int, stop: int) -> None:
            """Sum a range of the rows of bins, of all frames."""
            for frame, slot, limit in zip(frames, slots, limits, strict=True):
                # Memory for sums over a bin: 16 bits use more vector units, where they suffice.
                sum_type = "uint32"
                if frame.dtype == np.uint8 and self.bin_px <= _NARROW_BIN_PX:
                    sum_type = "uint16"
                line = np.empty((2, width), sum_type)
                pixels = np.ascontiguousarray(frame)
                _bin_rows(
                    pixels, self.bin_px, limit, line, self.sums[slot], self.saturated, start, stop
                )

        # A single frame is not split: waking a thread costs more than half a frame.
        least_rows = 0
        if len(frames) == 1:
            least_rows = self._size[0] + 1
        split_over_threads(run, self.sums.shape[1], least_rows)
