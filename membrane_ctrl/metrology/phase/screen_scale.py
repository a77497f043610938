"""Absolute phase and distance on the screen: O'A = T phi / (2 pi), phi counted from O'."""

import math

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import BoolArray, FloatArray


def centre_phase_rad(pattern: PatternConfig) -> float:
    """Absolute phase at O', the middle of the pattern.

    There s is half the pattern, where phi = 2 pi s / T - pi gives pi (periods - 1).
    """
    return math.pi * (pattern.periods - 1)


def mm_per_rad(pattern: PatternConfig) -> float:
    """Distance on the screen of one radian of phase, T / (2 pi)."""
    return pattern.period_mm / (2 * math.pi)


def screen_mm(absolute_rad: FloatArray, pattern: PatternConfig) -> FloatArray:
    """Place on the screen that a phase shows (paper, eq. 3).

    Parameters
    ----------
    absolute_rad : (...) array
        Absolute phase of one axis, counted from -pi at the low edge.
    pattern : PatternConfig
        The pattern.

    Returns
    -------
    (...) array
        O'A = T phi / (2 pi) in mm from O', along that axis, with phi relative to O'.
    """
    return (absolute_rad - centre_phase_rad(pattern)) * mm_per_rad(pattern)


def inside_pattern(
    absolute_rad: FloatArray, pattern: PatternConfig, margin_rad: float = 0.0
) -> BoolArray:
    """Whether a phase lies in the pattern; one from a wrong Gray bit at its rim does not.

    Parameters
    ----------
    absolute_rad : (...) array
        Absolute phase of one axis.
    pattern : PatternConfig
        The pattern.
    margin_rad : float
        Width of the pattern's border that does not count.

    Returns
    -------
    (...) bool array
    """
    from_centre_rad = np.abs(absolute_rad - centre_phase_rad(pattern))
    half_width_rad = math.pi * pattern.periods
    return np.asarray(from_centre_rad <= half_width_rad - margin_rad)
