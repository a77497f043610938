"""Error of the figure by waves that the response of panel and camera leaves in the phases.

N even steps cancel the harmonics of the fringes up to N - 2. The others leave waves at multiples of
the fringes' phase, the strongest at N times. The fit takes a part of them for a figure: where they
are finer than two pixels they look like long waves. The residuals show their amplitudes, and the
same fit to waves of these amplitudes shows what it takes.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.uncertainty.budget import Source
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench

_DESCRIPTION = "waves that the response of panel and camera leaves in the phases"
_ORDERS = (1, 2, 3, 4)  # of the fringes' phase
_TINY = 1e-30  # instead of a division by zero


@dataclass(frozen=True)
class ResponseWaves:
    """Waves of the response in the phases.

    Attributes
    ----------
    source : Source
        The row of the budget, one effect for each axis. The response is that of the bench: two sets
        have the same waves.
    share : float
        Part of the residuals' square that the waves explain beyond chance.
    """

    source: Source
    share: float


def estimate_response_waves(bench: TrialBench, steps: int) -> ResponseWaves:
    """Estimate the waves by the residuals of some points, and what the fit takes of them.

    Parameters
    ----------
    bench : TrialBench
        n points of the set, with their residuals.
    steps : int
        Number of phase steps N.

    Returns
    -------
    ResponseWaves
    """
    orders = sorted({*_ORDERS, steps})
    scale = screen_scale.mm_per_rad(bench.optics.pattern)
    nominal = bench.geometry()
    effects = []
    explained_mm2 = 0.0
    for axis in range(2):
        # Amplitudes of the waves, by least squares.
        phase_rad = bench.screen_mm[axis] / scale
        angles = np.multiply.outer(orders, phase_rad)
        table = np.concatenate([np.cos(angles), np.sin(angles)])
        seen_mm = bench.residual_mm[axis]
        amplitudes_mm = np.linalg.lstsq(table.T, seen_mm, rcond=None)[0]
        waves_mm = amplitudes_mm @ table

        # Noise alone explains one point's share for each wave.
        left_mm2 = float(np.sum((seen_mm - waves_mm) ** 2))
        by_chance_mm2 = left_mm2 * len(table) / max(seen_mm.size - len(table), 1)
        of_axis_mm2 = max(float(waves_mm @ waves_mm) - by_chance_mm2, 0.0)
        explained_mm2 += of_axis_mm2

        # What the fit takes of them.
        off_mm = np.zeros_like(bench.screen_mm)
        off_mm[axis] = waves_mm * np.sqrt(of_axis_mm2 / max(float(waves_mm @ waves_mm), _TINY))
        solved = bench.solve(nominal, off_mm, linear=True)
        effects.append(solved - bench.surface.parameters)
    whole_mm2 = max(float(np.sum(bench.residual_mm**2)), _TINY)
    source = Source(
        "response_waves", _DESCRIPTION, float("nan"), np.stack(effects, axis=1), common=False
    )
    return ResponseWaves(source, min(explained_mm2 / whole_mm2, 1.0))
