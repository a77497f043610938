"""Absolute phase: complementary Gray code (the paper's eq. 2), and its distance on the screen from O'.

The wrapped phase starts at -pi on each period's low edge, so that the order K1 = floor(s / T) jumps exactly where
the phase does and cannot be trusted there. K2, from the fourth bit, jumps half a period away: eq. 2 takes K2 near
the ends of a period and K1 in the middle, and each is used only where it is a quarter period away from its jumps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from membrane_ctrl.config import PatternConfig

FloatArray = NDArray[np.float64]


def gray_orders(gray: ArrayLike, white: ArrayLike, black: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Fringe orders from the Gray-code frames.

    Parameters
    ----------
    gray : (4, ...) array
        Intensities of the bits, most significant first.
    white, black : (...) array
        Highest and lowest level at each pixel; the threshold is their mean, pixel by pixel.

    Returns
    -------
    k1, k2 : (...) int arrays
        floor(s / T) from bits 1-3 and floor((V2 + 1) / 2) from all four, V2 = floor(2 s / T).
    """
    threshold = (np.asarray(white, float) + np.asarray(black, float)) / 2
    bits = (np.asarray(gray, float) > threshold).astype(np.int64)
    binary = np.bitwise_xor.accumulate(bits, axis=0)  # Gray to binary: each bit is the xor of all above it
    k1 = 4 * binary[0] + 2 * binary[1] + binary[2]
    v2 = 2 * k1 + binary[3]
    return k1, (v2 + 1) // 2


def absolute_phase(wrapped_rad: FloatArray, k1: NDArray[np.int64], k2: NDArray[np.int64]) -> FloatArray:
    """The paper's eq. 2: phase counted from the low edge's -pi."""
    order = np.where(wrapped_rad <= -math.pi / 2, k2, np.where(wrapped_rad >= math.pi / 2, k2 - 1, k1))
    return wrapped_rad + 2 * math.pi * order


def centre_phase_rad(pattern: PatternConfig) -> float:
    """Absolute phase at O': there s is half the region, where phi = 2 pi s / T - pi gives pi (periods - 1)."""
    return math.pi * (pattern.periods - 1)


def mm_per_rad(pattern: PatternConfig) -> float:
    """T / (2 pi)."""
    return pattern.period_mm / (2 * math.pi)


def screen_mm(absolute_rad: FloatArray, pattern: PatternConfig) -> FloatArray:
    """Distance from O' on the screen, the paper's O'A = T phi / (2 pi) with phi relative to O'."""
    return (absolute_rad - centre_phase_rad(pattern)) * mm_per_rad(pattern)


def inside_pattern(absolute_rad: FloatArray, pattern: PatternConfig) -> NDArray[np.bool_]:
    """Whether the phase is one the pattern has; a wrong Gray bit at its rim is not."""
    return np.abs(absolute_rad - centre_phase_rad(pattern)) <= math.pi * pattern.periods
