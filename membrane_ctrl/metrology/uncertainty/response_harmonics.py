"""Waves that a response which is not linear leaves in the phases, where a frame is left out.

N even steps cancel all harmonics of the fringes up to N - 2. If a frame is left out, the others are
fewer and uneven: the second harmonic of a panel's gamma then leaves waves in the phase, at one to
four times the phase of the fringes. No film and no error of the bench has such waves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray

_ORDERS = (1, 2, 3, 4)  # of the fringes' phase
_LEAST_SHARE = 0.6  # of the residuals' power; noise of 6000 points gives 0.001
_LINEAR = (0.9, 1.1)  # exponents of a response that is about linear


@dataclass(frozen=True)
class ResponseHarmonics:
    """Waves of the response in the phases of one axis.

    Attributes
    ----------
    axis : "x" or "y"
        The axis with the largest waves.
    used, taken : int
        Number of its frames that are used, and that were taken.
    share : float
        Part of the residuals' mean square that the waves explain.
    """

    axis: str
    used: int
    taken: int
    share: float

    def describe(self) -> str:
        """The cause and its remedy in words."""
        return (
            f"the response of panel and camera is not linear, and the {self.used} of {self.taken} "
            f"frames along {self.axis} that are left do not cancel its harmonics, which explain "
            f"{self.share:.0%} of what the fit leaves: take the set again"
        )


def find_response_harmonics(
    bench: TrialBench, used: Sequence[int], taken: Sequence[int], exponent: float
) -> ResponseHarmonics | None:
    """Find waves of the response; None if all frames are used, or if they do not explain the
    residuals.

    Parameters
    ----------
    bench : TrialBench
        Some points of the set, with their residuals.
    used, taken : (2,) ints
        Number of sinusoids along x and y that are used, and that were taken.
    exponent : float
        Exponent of the response; NaN if unknown.
    """
    # A straight response makes none, and all steps together cancel them.
    is_linear = _LINEAR[0] <= exponent <= _LINEAR[1]
    if is_linear or math.isnan(exponent):
        return None
    power = np.sum(bench.residual_mm**2, axis=1)
    axis = int(np.argmax(power))
    if used[axis] >= taken[axis]:
        return None
    # Share of the residuals that waves at multiples of the fringes' phase explain.
    left = bench.residual_mm[axis] - _fit_waves(bench, axis)
    share = 1 - float(left @ left) / float(power[axis])
    if share < _LEAST_SHARE:
        return None
    return ResponseHarmonics(AXES[axis], used[axis], taken[axis], share)


def _fit_waves(bench: TrialBench, axis: int) -> FloatArray:
    """Least squares (n,) for the residuals of an axis by waves of its phase."""
    phase_rad = bench.screen_mm[axis] / screen_scale.mm_per_rad(bench.optics.pattern)
    columns = [np.ones_like(phase_rad)]
    for order in _ORDERS:
        columns += [np.cos(order * phase_rad), np.sin(order * phase_rad)]
    table = np.stack(columns, axis=1)
    amplitudes = np.linalg.lstsq(table, bench.residual_mm[axis], rcond=None)[0]
    return np.asarray(table @ amplitudes)
