"""The figures by which loops are compared."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LoopFigures:
    """What a set of gains gives and costs, as predicted; or how well that is known (1 sigma)."""

    std_um: float  # of the true centre
    load_peak_um: float  # after a step of the leak
    load_recovery_s: float
    ms: float
