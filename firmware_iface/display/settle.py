"""How long a display needs from the command to show a pattern until a frame may be exposed.

After a step the light of a panel stands still for a latency L (queue, refresh, scan) and then approaches its end as
exp(-(t - L) / tau). Frames exposed at known times after the step give both; the wait is where less than one of 256
levels is left: L + tau ln 256. Doubling a settle time that was seen would double the latency too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

_LEFT = 1.0 / 256.0  # of the step: one level
_FIT_FROM, _FIT_TO = 0.6, 1.0 / 32.0  # of the step; below, noise bends the logarithm
_NOISE_SIGMAS = 4.0
_LEAST_POINTS = 3
_BLOCK_PX = 16  # the mean of 256 pixels has a sixteenth of their noise


@dataclass(frozen=True, slots=True)
class Settling:
    """What was found.

    Attributes
    ----------
    settle_s : float
        From the command to the start of an exposure.
    latency_s, tau_s : float
        Of the model; NaN where the display was too fast for the camera to see it on its way.
    """

    settle_s: float
    latency_s: float
    tau_s: float


def share_left(frame: ArrayLike, before: ArrayLike, after: ArrayLike) -> float:
    """How much of a step is left in a frame: the worst block's difference from the end, over the largest step.

    Parameters
    ----------
    frame, before, after : (H, W) arrays
        The frame, and the pictures before the step and long after it.
    """
    end = block_means(after)
    step = np.abs(block_means(before) - end)
    # the worst block but a thousandth: a glint or a dead pixel is no display
    return float(np.quantile(np.abs(block_means(frame) - end), 0.999) / max(float(np.quantile(step, 0.999)), 1e-9))


def settling(delay_s: ArrayLike, left: ArrayLike, noise: float = 0.0) -> Settling:
    """Latency, time constant and the time to wait.

    Parameters
    ----------
    delay_s : (K,) array
        Start of each exposure after the command, of any number of steps together.
    left : (K,) array
        What was left of the step (`share_left`).
    noise : float
        What `left` is when nothing is left.

    Raises
    ------
    ValueError
        If the display never settles.
    """
    delays, shares = np.asarray(delay_s, np.float64), np.asarray(left, np.float64)
    order = np.argsort(delays)
    delays, shares = delays[order], shares[order]
    floor = max(_FIT_TO, _NOISE_SIGMAS * noise)
    unsettled = np.flatnonzero(shares > floor)
    if unsettled.size == 0:  # faster than the first frame; what that had left goes no slower than the rest went
        still = max(float(shares[0]), _LEFT)
        return Settling(float(delays[0]) * math.log(_LEFT) / math.log(still), math.nan, math.nan)
    if unsettled[-1] == len(delays) - 1:
        raise ValueError(
            f"{100 * shares[-1]:.0f} % of a step is left after {delays[-1]:.2f} s: does the camera see the screen, "
            "and is its light steady (dynamic backlight, another lamp)?"
        )
    seen_s = float(delays[unsettled[-1] + 1])  # the first frame after which all are good
    falling = (shares < _FIT_FROM) & (shares > floor)
    if np.count_nonzero(falling) < _LEAST_POINTS or np.ptp(delays[falling]) <= 0:
        # too fast to fit: from _FIT_FROM to the floor in no more than this, and no slower afterwards
        before = np.flatnonzero(shares[: unsettled[-1] + 1] >= _FIT_FROM)
        fell_s = seen_s - (float(delays[before[-1]]) if before.size else 0.0)
        rest_s = fell_s * max(0.0, math.log(floor / _LEFT)) / math.log(_FIT_FROM / floor)
        return Settling(seen_s + rest_s, math.nan, math.nan)
    slope, offset = np.polyfit(delays[falling], np.log(shares[falling]), 1)
    if slope >= 0:
        return Settling(2 * seen_s, math.nan, math.nan)
    tau_s, latency_s = -1.0 / slope, offset / -slope
    # a display slower at its tail than at its start is believed
    return Settling(max(latency_s - tau_s * math.log(_LEFT), seen_s), float(latency_s), float(tau_s))


def block_means(image: ArrayLike) -> FloatArray:
    """Means of square blocks, the incomplete ones at the edges left out; of small images the pixels themselves."""
    pixels = np.asarray(image, np.float64)
    side = max(1, min(_BLOCK_PX, min(pixels.shape) // 8))
    rows, columns = (length // side for length in pixels.shape)
    blocks = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(blocks.mean(axis=(1, 3)))
