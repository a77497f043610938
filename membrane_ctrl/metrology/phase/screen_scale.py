"""Absolute phase and distance on the screen: O'A = T phi / (2 pi), phi counted from O'."""

import math

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import BoolArray, FloatArray


def centre_phase_rad(pattern: PatternConfig) -> float:
    """Absolute phase at O': there s is half the region, where phi = 2 pi s / T - pi gives pi
    (periods - 1).
    """
    return math.pi * (pattern.periods - 1)


def mm_per_rad(pattern: PatternConfig) -> float:
    """T / (2 pi)."""
    return pattern.period_mm / (2 * math.pi)


def screen_mm(absolute_rad: FloatArray, pattern: PatternConfig) -> FloatArray:
    """Distance from O' on the screen, the paper's O'A = T phi / (2 pi) with phi relative to O'."""
    return (absolute_rad - centre_phase_rad(pattern)) * mm_per_rad(pattern)


def inside_pattern(
    absolute_rad: FloatArray, pattern: PatternConfig, margin_rad: float = 0.0
) -> BoolArray:
    """Whether the phase lies in the pattern; one from a wrong Gray bit at its rim does not."""
    return np.asarray(
        np.abs(absolute_rad - centre_phase_rad(pattern)) <= math.pi * pattern.periods - margin_rad
    )
