"""The time a display needs from the command until a frame may be exposed.

After a step a panel's light stays constant for a latency L (queue, refresh, scan) and then
approaches its end as exp(-(t - L) / tau). Frames exposed at known times after the step give both;
the wait ends when less than one of 256 levels remains: L + tau ln 256. Doubling an observed
settle time would double the latency too.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from firmware_iface.image_blocks import block_means

_LEFT = 1.0 / 256.0  # of the step: one level
_FIT_FROM = 0.6  # of the step; below, noise bends the logarithm
_FIT_TO = 1.0 / 32.0
_NOISE_SIGMAS = 4.0
_LEAST_POINTS = 3


@dataclass(frozen=True, slots=True)
class Settling:
    """Result of the measurement."""

    settle_s: float  # from the command to the start of an exposure
    latency_s: (
        float  # of the model; NaN if the display was too fast for the camera to see the transition
    )
    tau_s: float


def share_left(frame: ArrayLike, before: ArrayLike, after: ArrayLike) -> float:
    """Return the remaining share of a step: the worst block's difference from the end, over the
    largest step.

    Parameters
    ----------
    frame : (H, W) array
        The frame to judge.
    before : (H, W) array
        A frame from before the step.
    after : (H, W) array
        A frame from long after the step.

    Returns
    -------
    float
        0 once the display has settled, 1 before the step.
    """
    end = block_means(after)
    step = np.abs(block_means(before) - end)
    # the worst block except a thousandth, to exclude glints and dead pixels
    return float(
        np.quantile(np.abs(block_means(frame) - end), 0.999)
        / max(float(np.quantile(step, 0.999)), 1e-9)
    )


def fit_settling(delay_s: ArrayLike, left: ArrayLike, noise: float = 0.0) -> Settling:
    """Fit latency and time constant of the display, and the time to wait.

    An exponential is fitted to the shares between `_FIT_FROM` and the floor of the noise,

        left(t) = exp(-(t - latency) / tau)

    and the wait is the time at which it falls to `_LEFT`.

    Parameters
    ----------
    delay_s : (k,) array
        Starts of the exposures after the command, of any number of steps.
    left : (k,) array
        Remaining shares of the step (`share_left`).
    noise : float
        Value of `left` at the end.

    Raises
    ------
    ValueError
        The display does not settle.
    """
    delays = np.asarray(delay_s, np.float64)
    shares = np.asarray(left, np.float64)
    order = np.argsort(delays)
    delays, shares = delays[order], shares[order]
    # Four cases, from the fastest display to the slowest: settled in the first frame; never
    # settled; a transition too short for a fit, which is bounded; and the fit of the exponential.
    floor = max(_FIT_TO, _NOISE_SIGMAS * noise)
    unsettled = np.flatnonzero(shares > floor)
    if unsettled.size == 0:  # faster than the first frame; its remainder decays at least as fast
        still = max(float(shares[0]), _LEFT)
        return Settling(float(delays[0]) * math.log(_LEFT) / math.log(still), math.nan, math.nan)
    if unsettled[-1] == len(delays) - 1:
        raise ValueError(
            f"{100 * shares[-1]:.0f} % of a step is left after {delays[-1]:.2f} s: does the camera "
            "see the screen, and is its light steady (dynamic backlight, another lamp)?"
        )
    seen_s = float(delays[unsettled[-1] + 1])  # the first of the good frames
    falling = (shares < _FIT_FROM) & (shares > floor)
    if np.count_nonzero(falling) < _LEAST_POINTS or np.ptp(delays[falling]) <= 0:
        # too fast to fit: at most this long from _FIT_FROM to the floor, and no slower afterwards
        before = np.flatnonzero(shares[: unsettled[-1] + 1] >= _FIT_FROM)
        fell_s = seen_s - (float(delays[before[-1]]) if before.size else 0.0)
        rest_s = fell_s * max(0.0, math.log(floor / _LEFT)) / math.log(_FIT_FROM / floor)
        return Settling(seen_s + rest_s, math.nan, math.nan)
    slope, offset = np.polyfit(delays[falling], np.log(shares[falling]), 1)
    if slope >= 0:
        return Settling(2 * seen_s, math.nan, math.nan)
    tau_s = -1.0 / slope
    latency_s = -offset / slope
    settled_s = latency_s - tau_s * math.log(_LEFT)
    # The first good frame is a lower limit, for a display whose tail is slower than its start
    return Settling(max(settled_s, seen_s), float(latency_s), float(tau_s))
