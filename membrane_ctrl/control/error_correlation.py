"""Tests whether the errors of a loop that predicts are as a right model leaves them. Pure.

Such a loop removes an error within the pump's dead time, its lag and some of its own time
constants. Errors further apart than this horizon are then uncorrelated. If the pump responds
otherwise than assumed, the loop swings, and they are correlated (T. J. Harris, Assessment of
control loop performance, Can. J. Chem. Eng. 67, 1989).
"""

import math
from collections import deque
from dataclasses import dataclass, field

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig
from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.model.state_tree import Count, StateNode

# The horizon in time constants of the loop's own pole, and in ticks
_POLES = 4.0
_TICKS = 2.0
# Means over half a horizon are correlated at these distances: 1 to 4 horizons.
_PARTS = 2
_DISTANCES = (2, 3, 4, 6, 8)
_MEMORY_HORIZONS = 80.0
_MEMORY_LEAST_S = 60.0
_HORIZONS_LEAST = 40


@dataclass(slots=True)
class ErrorCorrelationState(StateNode):
    """The present mean, the last ones, and their mean products by distance."""

    time_s: float = 0.0
    total_um: float = 0.0
    count: Count = 0
    means_um: deque[float] = field(default_factory=deque)
    mean_um: float = 0.0
    products_um2: list[float] = field(default_factory=lambda: [0.0] * (1 + len(_DISTANCES)))
    samples: Count = 0


class ErrorCorrelation:
    """Correlation of the errors beyond the horizon, in the last minutes.

    Parameters
    ----------
    loop, estimator
        The tick rate; the wanted pole, dead time and lag.
    memory : ErrorCorrelationState, optional
        From the snapshot of an earlier controller; else nothing has been seen.
    """

    def __init__(
        self,
        loop: LoopConfig,
        estimator: EstimatorConfig,
        memory: ErrorCorrelationState | None = None,
    ) -> None:
        self.memory = memory or ErrorCorrelationState()
        own_s = max(1.0 / estimator.gain_per_s, estimator.pump_lag_s / 3.0)
        pump_s = estimator.pump_delay_s + estimator.pump_lag_s
        self.horizon_s = pump_s + _POLES * own_s + _TICKS / loop.rate_hz

    def reset(self) -> None:
        """Forget everything."""
        self.memory.start_afresh()

    def skip(self) -> None:
        """Leave out a tick: what comes later is not compared with what was before it."""
        memory = self.memory
        memory.time_s = memory.total_um = 0.0
        memory.count = 0
        memory.means_um.clear()

    def step(self, error_um: float, dt_s: float) -> None:
        """Add a tick.

        Parameters
        ----------
        error_um : float
            Error of the estimate; NaN for a tick without one.
        dt_s : float
            Time since the last tick.
        """
        memory = self.memory
        memory.time_s += dt_s
        if math.isfinite(error_um):
            memory.total_um += error_um
            memory.count += 1
        # A mean over a part of the horizon is one sample.
        if memory.time_s < self.horizon_s / _PARTS - 1e-9 or memory.count == 0:
            return
        memory.samples += 1
        memory_s = max(_MEMORY_LEAST_S, _MEMORY_HORIZONS * self.horizon_s)
        # Its mean and its products with earlier samples are running means; at first all samples
        # weigh the same.
        share = max(lag_step_fraction(memory.time_s, memory_s), 1.0 / memory.samples)
        mean_um = memory.total_um / memory.count
        memory.mean_um += share * (mean_um - memory.mean_um)
        memory.means_um.appendleft(mean_um - memory.mean_um)
        if len(memory.means_um) > _DISTANCES[-1] + 1:
            memory.means_um.pop()
        for place, distance in enumerate((0, *_DISTANCES)):
            if distance < len(memory.means_um):
                product_um2 = memory.means_um[0] * memory.means_um[distance]
                memory.products_um2[place] += share * (product_um2 - memory.products_um2[place])
        memory.time_s = memory.total_um = 0.0
        memory.count = 0

    @property
    def largest(self) -> float:
        """The largest correlation, of either sign; NaN while too little is known."""
        variance_um2, *products_um2 = self.memory.products_um2
        if self.memory.samples < _PARTS * _HORIZONS_LEAST or variance_um2 <= 0.0:
            return math.nan
        return max(abs(product_um2) for product_um2 in products_um2) / variance_um2
