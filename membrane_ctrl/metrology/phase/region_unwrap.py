"""The wrapped phase made continuous over connected regions of a picture."""

import math

import numpy as np

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray


@compile_kernel
def _flood_region(phase, mask, out, region, queue):  # type: ignore[no-untyped-def]
    """Breadth-first walk: each pixel takes the period nearest to the neighbour that reached it.

    Fills `out` and `region`, with `queue` as memory for the pixels to visit; returns the number of
    regions.
    """
    height, width = phase.shape
    count = 0
    for seed in range(height * width):
        if not mask[seed // width, seed % width] or region[seed // width, seed % width] >= 0:
            continue
        # The next region begins at the first pixel that no walk has reached.
        head = 0
        tail = 1
        queue[0] = seed
        region[seed // width, seed % width] = count
        out[seed // width, seed % width] = phase[seed // width, seed % width]
        while head < tail:
            row = queue[head] // width
            column = queue[head] % width
            head += 1
            for k in range(4):  # the four neighbours
                r = row + (k == 0) - (k == 1)
                c = column + (k == 2) - (k == 3)
                if r < 0 or c < 0 or r >= height or c >= width:
                    continue
                if not mask[r, c] or region[r, c] >= 0:
                    continue
                # The whole periods between the wrapped phase and the neighbour's continuous one.
                step = phase[r, c] - out[row, column]
                periods = math.floor(step / (2 * math.pi) + 0.5)
                out[r, c] = phase[r, c] - 2 * math.pi * periods
                region[r, c] = count
                queue[tail] = r * width + c
                tail += 1
        count += 1
    return count


def unwrap_regions(wrapped_rad: FloatArray, mask: BoolArray) -> tuple[FloatArray, IntArray]:
    """Continuous phase of each connected region, up to whole periods.

    Parameters
    ----------
    wrapped_rad : (H, W) array
        Phase, of which neighbours must differ by less than half a period.
    mask : (H, W) bool array
        Where the phase is valid.

    Returns
    -------
    phase_rad : (H, W) array
        NaN outside the mask.
    region : (H, W) int array
        Number of the region; -1 outside the mask.
    """
    out = np.full(wrapped_rad.shape, np.nan)
    region = np.full(wrapped_rad.shape, -1, np.int64)
    _flood_region(
        np.ascontiguousarray(wrapped_rad), mask, out, region, np.empty(mask.size, np.int64)
    )
    return out, region


def tear_share(phase_rad: FloatArray) -> float:
    """Share of neighbours whose continuous phases (H, W) differ by more than half a period.

    0 if the phase does not depend on the way of the walk. NaN is left out.
    """
    down = np.diff(phase_rad, axis=0)
    right = np.diff(phase_rad, axis=1)
    steps = np.concatenate([down.ravel(), right.ravel()])
    steps = steps[np.isfinite(steps)]
    if steps.size:
        return float(np.mean(np.abs(steps) > math.pi))
    return 0.0
