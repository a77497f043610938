"""Sums of pixels over square bins, and the phase of the bins against a reference: the fast path of
a cycle.

The phasor of a bin is linear in the frames, so the frames are summed over each bin first, each read
once and in the order of its memory; the phase steps are then combined on 1/16 of the numbers. For
surfaces of Zernike terms nothing is lost by 4 x 4 bins. Colour filters do no harm: a pixel's gain
scales its phasor and leaves its phase.
"""

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import kernel, split, step
from membrane_ctrl.model.arrays import AnyArray, ComplexArray, FloatArray, Image, IntArray

_BLOCK = 512
_NEVER = np.uint32(2**32 - 1)  # above any pixel
FOLLOWED_ROWS = 5  # of `track`: absolute phase, its cosine and sine, change (rad), modulation (ADU)


# One small loop a function: the compiler finds vector instructions for each of these, and for none
# of their union.


@kernel
def _add_lines(frame, first, last, line):  # type: ignore[no-untyped-def]
    for c in range(line.size):
        line[c] = frame[first, c]
    for row in range(first + 1, last):
        for c in range(line.size):
            line[c] += frame[row, c]


@kernel
def _peak(frame, first, last, width):  # type: ignore[no-untyped-def]
    top = frame[first, 0]
    for row in range(first, last):
        for c in range(width):
            value = frame[row, c]
            top = value if value > top else top
    return top


@kernel
def _halve(line, out):  # type: ignore[no-untyped-def]
    for b in range(out.size):
        out[b] = line[2 * b] + line[2 * b + 1]


@kernel
def _fold(line, bin_px, out):  # type: ignore[no-untyped-def]
    for b in range(out.size):
        total = np.uint32(0)
        for c in range(b * bin_px, b * bin_px + bin_px):
            total += np.uint32(line[c])
        out[b] = total


@kernel
def _count_saturated(frame, first, last, bin_px, full_scale, out):  # type: ignore[no-untyped-def]
    for row in range(first, last):
        for b in range(out.size):
            for c in range(b * bin_px, b * bin_px + bin_px):
                if frame[row, c] >= full_scale:
                    out[b] += np.uint32(1)


@kernel
def _bin_rows(frame, bin_px, full_scale, line, sums, saturated, start, stop):  # type: ignore[no-untyped-def]
    """Sums of the bin rows [start, stop) into `sums`; their saturated pixels are added to
    `saturated`.

    `line` (2, width) is memory of a type that holds the sum of a bin's pixels.
    """
    width = line.shape[1]
    for row in range(start, stop):
        first, last = row * bin_px, row * bin_px + bin_px
        _add_lines(frame, first, last, line[0])
        here, there, side = line[0], line[1], bin_px
        while side % 2 == 0 and side > 2:
            side //= 2
            _halve(here, there[: sums.shape[1] * side])
            here, there = there, here
        if side == 2:
            _halve(here, sums[row])
        else:
            _fold(here, side, sums[row])
        if _peak(frame, first, last, width) >= full_scale:
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
    saturated : (rows, columns) uint32 array
        Saturated pixels of each bin over the frames since `clear`.
    """

    def __init__(
        self, height_px: int, width_px: int, bin_px: int, full_scale_adu: int, slots: int
    ) -> None:
        self._size = (height_px, width_px)
        self.bin_px = bin_px
        self._full_scale = np.uint32(full_scale_adu)
        shape = (height_px // bin_px, width_px // bin_px)
        self.sums = np.zeros((slots, *shape), np.uint32)
        self.saturated = np.zeros(shape, np.uint32)

    def clear(self) -> None:
        """Forget the saturation counts, at the start of a cycle."""
        self.saturated[:] = 0

    def add(
        self, frames: Sequence[Image], slots: Sequence[int], watched: Container[int] | None = None
    ) -> None:
        """Sum frames into slots.

        Raises ValueError for a frame of wrong size or type of pixel; nothing is summed then. Frame
        k goes to slots[k]. Only `watched` slots, by default all, are checked for saturation: it
        does not harm white or Gray.
        """
        for frame in frames:
            if frame.shape != self._size:
                raise ValueError(
                    f"frame is {frame.shape[::-1]} pixels (width, height), not {self._size[::-1]}"
                )
            if frame.dtype not in (np.uint8, np.uint16):
                raise ValueError(f"frame has {frame.dtype} pixels, not uint8 or uint16")
        limits = [
            self._full_scale if watched is None or slot in watched else _NEVER for slot in slots
        ]
        width = self.sums.shape[2] * self.bin_px

        def run(start: int, stop: int) -> None:
            for frame, slot, limit in zip(frames, slots, limits, strict=True):
                fits = (
                    frame.dtype == np.uint8 and self.bin_px <= 16
                )  # 256 pixels of 8 bits fit 16 bits
                line = np.empty((2, width), np.uint16 if fits else np.uint32)
                pixels = np.ascontiguousarray(frame)
                _bin_rows(
                    pixels, self.bin_px, limit, line, self.sums[slot], self.saturated, start, stop
                )

        # waking a thread costs more than half a frame
        split(run, self.sums.shape[1], self._size[0] + 1 if len(frames) == 1 else 0)


@dataclass(frozen=True)
class StepCombination:
    """How the frames of one axis become a phasor."""

    # (N,): weights of the frames' bin sums for C and S (per pixel: divided by the bin's area)
    cosine: FloatArray
    sine: FloatArray  # (N,)
    # (2,) first and second moment of the film's motion (see `motion`); 0 without
    turn: ComplexArray = field(default_factory=lambda: np.zeros(2, complex))
    mirror: ComplexArray = field(default_factory=lambda: np.zeros(2, complex))


@step
def arctan2(y, x):  # type: ignore[no-untyped-def]
    """Angle in [-pi, pi] without a branch, so that loops over it use vector units; (0, 0) gives 0.

    The ratio of the smaller to the larger is halved in angle once, tan(a/2) = t / (1 + sqrt(1 +
    t^2)), which leaves
    |t| <= tan(pi/8), where 15 terms of the series of arctan leave less than 1e-13.
    """
    ax, ay = abs(x), abs(y)
    low, high = min(ax, ay), max(ax, ay)
    ratio = low / (high + 1e-300)
    t = ratio / (1 + math.sqrt(1 + ratio * ratio))
    square = t * t
    series = 0.0
    for k in range(15, -1, -1):
        series = 1.0 / (2 * k + 1) - square * series
    angle = 2 * t * series
    angle = math.pi / 2 - angle if ay > ax else angle
    angle = math.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle


@kernel
def _combine(sums, index, weights, first, out):  # type: ignore[no-untyped-def]
    """out[p] = sum over frames of weight times bin sum."""
    for p in range(out.size):
        out[p] = 0.0
    for k in range(weights.size):
        weight = weights[k]
        for p in range(out.size):
            out[p] += weight * sums[k, index[first + p]]


@step
def still(c, s, q, turn, mirror):  # type: ignore[no-untyped-def]
    """The phasor c + i s without the film's motion, to second order (see `motion`)."""
    half = q * q / 2
    t_re, t_im = 1 - q * turn[0].imag - half * turn[1].real, q * turn[0].real - half * turn[1].imag
    m_re, m_im = (
        q * mirror[0].imag - half * mirror[1].real,
        -q * mirror[0].real - half * mirror[1].imag,
    )
    scale = 1 / (t_re * t_re + t_im * t_im - m_re * m_re - m_im * m_im)
    return scale * ((t_re - m_re) * c + (t_im - m_im) * s), scale * (
        (t_re + m_re) * s - (t_im + m_im) * c
    )


@kernel
def _still(c, s, slope, turn, mirror):  # type: ignore[no-untyped-def]
    for p in range(c.size):
        c[p], s[p] = still(c[p], s[p], slope[p], turn, mirror)


@kernel
def _angle(c, s, last_cos, last_sin, change, size):  # type: ignore[no-untyped-def]
    """Angle of c + i s relative to the last phase, and its length;
    normalises c + i s to length 1.
    """
    for p in range(c.size):
        length = math.sqrt(c[p] * c[p] + s[p] * s[p])
        scale = 1 / (length + 1e-300)
        x, y = c[p] * scale, s[p] * scale
        change[p] = arctan2(y * last_cos[p] - x * last_sin[p], x * last_cos[p] + y * last_sin[p])
        size[p] = length
        c[p] = x
        s[p] = y


@kernel
def _track(sums, index, cosine, sine, turn, mirror, slope, last, out, start, stop):  # type: ignore[no-untyped-def]
    """Phase of each point, counted from the last one, in blocks that
    stay in the first-level cache.
    """
    for first in range(start, stop, _BLOCK):
        end = min(first + _BLOCK, stop)
        c, s = out[1, first:end], out[2, first:end]
        _combine(sums, index, cosine, first, c)
        _combine(sums, index, sine, first, s)
        if turn[1] != 0:
            _still(c, s, slope[first:end], turn, mirror)
        _angle(c, s, last[1, first:end], last[2, first:end], out[3, first:end], out[4, first:end])
        for p in range(first, end):
            out[0, p] = last[0, p] + out[3, p]


def track(
    sums: Sequence[AnyArray],
    index: IntArray,
    combined: Sequence[StepCombination],
    sensitivity_rad_per_um: FloatArray,
    last: FloatArray,
    out: FloatArray,
) -> None:
    """Phases of the points against the last ones, for x and y.

    Parameters
    ----------
    sums : two (N, bins) uint32 arrays
        Bin sums of the N frames of each axis.
    index : (n,) int array
        Bin of each point.
    combined : two StepCombination
        How the frames of each axis combine.
    sensitivity_rad_per_um : (2, n) array
        Change of phase per µm of displacement.
    last, out : (2, FOLLOWED_ROWS, n) arrays
        Rows of the cycle before, from which the change is counted (unambiguous below pi), and of
        this one.
    """

    def run(start: int, stop: int) -> None:
        for k, steps in enumerate(combined):
            weights = (steps.cosine, steps.sine, steps.turn, steps.mirror)
            _track(
                sums[k], index, *weights, sensitivity_rad_per_um[k], last[k], out[k], start, stop
            )

    split(run, index.size)
