"""From traced nodes to counts: one compiled pass over the picture, about ten nanoseconds a pixel.

Nodes stand every `step` pixels, one before the first pixel and two after the last. Between them a cubic through four
nodes (Lagrange) in each direction; with step 1 every pixel is a node and nothing is interpolated.
"""

from __future__ import annotations

from functools import cache
from math import ceil
from statistics import NormalDist

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_GOLDEN, _MIX_1, _MIX_2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_LOW_16 = np.uint64(0xFFFF)


def node_positions(pixels: int, step: int) -> FloatArray:
    """Pixel positions of the nodes along one side of the picture."""
    return np.asarray(np.arange(-1, ceil(pixels / step) + 2) * step, dtype=np.float64)


def cubic_weights(step: int) -> FloatArray:
    """Weights (step, 4) of the nodes at -1, 0, 1, 2 for the places k / step, k = 0..step-1 (Lagrange)."""
    f = np.arange(step) / step
    return np.stack(
        [
            -f * (f - 1) * (f - 2) / 6,
            (f + 1) * (f - 1) * (f - 2) / 2,
            -(f + 1) * f * (f - 2) / 2,
            (f + 1) * f * (f - 1) / 6,
        ],
        axis=1,
    )


@cache
def normal_quantiles() -> NDArray[np.float32]:
    """65536 equally likely values of a unit normal distribution: 16 random bits pick one."""
    half = [NormalDist().inv_cdf((k + 0.5) / 65536) for k in range(32768)]
    values = np.concatenate([half, -np.array(half[::-1])])
    return np.asarray(values / values.std(), dtype=np.float32)


@njit(cache=True)
def _random_64(state: np.uint64) -> np.uint64:
    """SplitMix64's output for a state that grows by `_GOLDEN` (Steele et al., 2014): four 16-bit numbers."""
    z = (state ^ (state >> np.uint64(30))) * _MIX_1
    z = (z ^ (z >> np.uint64(27))) * _MIX_2
    return z ^ (z >> np.uint64(31))


@njit(cache=True)
def _level(s_mm: float, values: FloatArray, cell_mm: float, smooth: bool) -> float:
    """Light of the screen at s from the region's low edge; the caller has made sure that 0 <= s < side."""
    place = s_mm / cell_mm
    cell = int(place)
    if not smooth:
        return float(values[min(cell, len(values) - 1)])
    fraction = place - cell
    cell %= len(values) - 1
    return float(values[cell] + fraction * (values[cell + 1] - values[cell]))


@njit(cache=True)
def _between(line: FloatArray, cell: int, w: FloatArray, k: int) -> float:
    """Value of a cubic through the nodes cell .. cell + 3, at the k-th of the places between."""
    return float(
        w[k, 0] * line[cell] + w[k, 1] * line[cell + 1] + w[k, 2] * line[cell + 2] + w[k, 3] * line[cell + 3]
    )


@njit(cache=True)
def _row_of_nodes(nodes: FloatArray, k: int, node: int, w: FloatArray, line: FloatArray) -> None:
    """Map k at one row of the picture, at the nodes' columns."""
    for c in range(nodes.shape[2]):
        line[c] = (
            w[0] * nodes[k, node, c]
            + w[1] * nodes[k, node + 1, c]
            + w[2] * nodes[k, node + 2, c]
            + w[3] * nodes[k, node + 3, c]
        )


@njit(cache=True)
def shade(
    nodes: FloatArray,
    weights: FloatArray,
    axis: int,
    radius_mm: float,
    values: FloatArray,
    cell_mm: float,
    smooth: bool,
    side_mm: float,
    scale: FloatArray,
    loss: tuple[FloatArray, FloatArray],
    noise: tuple[NDArray[np.float32], float, int],
    out: NDArray[np.uint8] | NDArray[np.uint16],
) -> None:
    """Fill `out` (H, W) with the picture of one pattern.

    Parameters
    ----------
    nodes : (3, rows, columns) array
        s_x, s_y (from the region's low edges, mm) and the distance on the film from the vertex squared (mm^2).
    weights : (step, 4) array
        Of `cubic_weights`.
    axis : int
        0: the pattern runs along s_x, 1: along s_y.
    radius_mm, side_mm : float
        Rim of the film, side of the pattern region.
    values, cell_mm, smooth
        The light, a `LevelTable`.
    scale : (4,) array
        Counts without light, counts of a white screen above that, darkness outside the region (share), full scale.
    loss : two arrays, (W,) and (H,)
        Vignetting as a sum of a part of the column and a part of the row.
    noise : tuple
        `normal_quantiles()`, standard deviation in counts, seed of this picture.
    """
    step = weights.shape[0]
    height, width = out.shape
    dark, white, leak, full = scale
    column_loss, row_loss = loss
    quantiles, sigma, seed = noise
    radius2_mm2 = radius_mm * radius_mm
    # three arrays and not rows of one: a view taken per pixel costs more than the pixel
    line_x, line_y, line_r2 = np.empty(nodes.shape[2]), np.empty(nodes.shape[2]), np.empty(nodes.shape[2])
    state, bits = np.uint64(seed) * _MIX_1, np.uint64(0)
    for row in range(height):
        _row_of_nodes(nodes, 0, row // step, weights[row % step], line_x)
        _row_of_nodes(nodes, 1, row // step, weights[row % step], line_y)
        _row_of_nodes(nodes, 2, row // step, weights[row % step], line_r2)
        for cell in range((width + step - 1) // step):
            for k in range(min(step, width - cell * step)):
                column = cell * step + k
                counts = dark
                if _between(line_r2, cell, weights, k) <= radius2_mm2:
                    s_x_mm = _between(line_x, cell, weights, k)
                    s_y_mm = _between(line_y, cell, weights, k)
                    light = leak
                    if 0.0 <= s_x_mm < side_mm and 0.0 <= s_y_mm < side_mm:
                        light = _level(s_y_mm if axis == 1 else s_x_mm, values, cell_mm, smooth)
                    counts += white * light * (1.0 - column_loss[column] - row_loss[row])
                if sigma > 0.0:
                    if column & 3 == 0:  # four 16-bit numbers from each 64-bit one
                        state += _GOLDEN
                        bits = _random_64(state)
                    counts += sigma * quantiles[bits & _LOW_16]
                    bits >>= np.uint64(16)
                out[row, column] = min(max(counts + 0.5, 0.0), full)
