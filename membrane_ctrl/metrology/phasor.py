"""Sums of pixels over square bins, and the phase of the bins against a reference: the fast path of a cycle.

The phasor of a bin is linear in the frames, so the frames are summed over each bin first, each read once and in
the order of its memory; the phase steps are then combined on 1/16 of the numbers. For surfaces of 36 terms nothing
is lost by 4 x 4 bins. Colour filters do no harm: a pixel's gain scales its phasor and leaves its phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.jit import kernel
from membrane_ctrl.metrology.threads import split

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16]

_BLOCK = 512
_NEVER = np.uint32(2**32 - 1)  # above any pixel
FOLLOWED_ROWS = 5  # of `track`: absolute phase, its cosine and sine, change (rad), modulation (ADU)


@kernel
def _bin_rows(frame, bin_px, full_scale, sums, saturated, start, stop):  # type: ignore[no-untyped-def]
    """Sums and counts of saturated pixels of the bin rows [start, stop), into `sums` and onto `saturated`."""
    width = sums.shape[1] * bin_px
    line = np.empty(width, np.uint32)
    hits = np.empty(width, np.uint32)
    for row in range(start, stop):
        for column in range(width):
            line[column] = 0
            hits[column] = 0
        for k in range(row * bin_px, row * bin_px + bin_px):
            for column in range(width):
                value = np.uint32(frame[k, column])
                line[column] += value
                hits[column] += np.uint32(value >= full_scale)
        for b in range(sums.shape[1]):
            total = np.uint32(0)
            hit = np.uint32(0)
            for column in range(b * bin_px, b * bin_px + bin_px):
                total += line[column]
                hit += hits[column]
            sums[row, b] = total
            saturated[row, b] += hit


class Binner:
    """Sums frames over bins into memory of its own, taken once.

    Parameters
    ----------
    height_px, width_px : int
        Size of the frames; what does not fill a bin at the right and lower edge is left out.
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

    def __init__(self, height_px: int, width_px: int, bin_px: int, full_scale_adu: int, slots: int) -> None:
        self._size = (height_px, width_px)
        self.bin_px = bin_px
        self._full_scale = np.uint32(full_scale_adu)
        shape = (height_px // bin_px, width_px // bin_px)
        self.sums = np.zeros((slots, *shape), np.uint32)
        self.saturated = np.zeros(shape, np.uint32)

    def clear(self) -> None:
        """Forget the saturation counts, at the start of a cycle."""
        self.saturated[:] = 0

    def add(self, frame: Image, slot: int, *, watch_saturation: bool = True) -> None:
        """Sum one frame into a slot. Raises ValueError for a wrong size or type of pixel.

        Saturation is watched in sinusoids only: a white or Gray frame loses nothing by it.
        """
        if frame.shape != self._size:
            raise ValueError(f"frame is {frame.shape[::-1]} pixels (width, height), not {self._size[::-1]}")
        if frame.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"frame has {frame.dtype} pixels, not uint8 or uint16")
        pixels = np.ascontiguousarray(frame)
        sums = self.sums[slot]
        full_scale = self._full_scale if watch_saturation else _NEVER

        def run(start: int, stop: int) -> None:
            _bin_rows(pixels, self.bin_px, full_scale, sums, self.saturated, start, stop)

        split(run, sums.shape[0])


@dataclass(frozen=True)
class StepCombination:
    """How the frames of one axis become a phasor.

    Attributes
    ----------
    cosine, sine : (N,) arrays
        Weights of the frames' bin sums for C and S (per pixel: divided by the bin's area).
    turn, mirror : complex
        First-order effect of the film's motion per radian and unit of sensitivity (see `motion`); 0 without.
    """

    cosine: FloatArray
    sine: FloatArray
    turn: complex = 0j
    mirror: complex = 0j


@kernel
def arctan2(y, x):  # type: ignore[no-untyped-def]
    """Angle in [-pi, pi] without a branch, so that loops over it use vector units; (0, 0) gives 0.

    The ratio of the smaller to the larger is halved in angle once, tan(a/2) = t / (1 + sqrt(1 + t^2)), which leaves
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
def _track(sums, index, cosine, sine, turn, mirror, slope, last, out, start, stop):  # type: ignore[no-untyped-def]
    """Phase of each point, counted from the last one."""
    block = np.empty((2, _BLOCK))
    for first in range(start, stop, _BLOCK):
        count = min(_BLOCK, stop - first)
        for p in range(count):
            block[0, p] = 0.0
            block[1, p] = 0.0
        for k in range(cosine.size):
            for p in range(count):
                value = float(sums[k, index[first + p]])
                block[0, p] += cosine[k] * value
                block[1, p] += sine[k] * value
        for p in range(count):
            n = first + p
            c0, s0 = block[0, p], block[1, p]
            # z - i q (turn z - mirror conj z), the film's motion taken out to first order
            ur = turn.real * c0 - turn.imag * s0 - (mirror.real * c0 + mirror.imag * s0)
            ui = turn.real * s0 + turn.imag * c0 - (mirror.imag * c0 - mirror.real * s0)
            c = c0 + slope[n] * ui
            s = s0 - slope[n] * ur
            size = math.sqrt(c * c + s * s)
            scale = 1 / (size + 1e-300)
            change = arctan2(s * last[1, n] - c * last[2, n], c * last[1, n] + s * last[2, n])
            out[0, n] = last[0, n] + change
            out[1, n] = c * scale
            out[2, n] = s * scale
            out[3, n] = change
            out[4, n] = size


def track(
    sums: NDArray[np.uint32],
    index: NDArray[np.int64],
    steps: StepCombination,
    sensitivity_rad_per_um: FloatArray,
    last: FloatArray,
    out: FloatArray,
) -> None:
    """Phases of the points against their reference.

    Parameters
    ----------
    sums : (N, bins) uint32 array
        Bin sums of the N frames of one axis.
    index : (n,) int array
        Bin of each point.
    sensitivity_rad_per_um : (n,) array
        Change of phase per um of displacement.
    last, out : (FOLLOWED_ROWS, n) arrays
        Rows of the cycle before, from which the change is counted (unambiguous below pi), and of this one.
    """
    fixed = (sums, index, steps.cosine, steps.sine, steps.turn, steps.mirror, sensitivity_rad_per_um, last, out)

    def run(start: int, stop: int) -> None:
        _track(*fixed, start, stop)

    split(run, index.size)
