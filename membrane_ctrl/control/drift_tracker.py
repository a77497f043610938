"""Tracker of a slow drift in noisy readings: value and rate, with fading memory. Pure.

Least squares of a straight line through all readings, each weighted by exp(-age / T). For readings
a step dt apart, with beta = exp(-dt / T) and r = reading - prediction (Morrison, Introduction to
Sequential Smoothing and Prediction, 1969, degree-1 polynomial with fading memory):

    value += (1 - beta^2) r,    rate += (1 - beta)^2 r / dt

Both poles lie at beta: critically damped. A steady drift is tracked without error (a single lag
would trail by rate x T). After a sudden onset of a drift v the tracker trails by v t exp(-t / T):
at most v T / e. Noise of standard deviation sigma per reading becomes sigma sqrt(1.25 dt / T).
"""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode


@dataclass(slots=True)
class DriftTracker(StateNode):
    """Value and rate of a drift that is initially 0; T (`time_constant_s`) may change."""

    time_s: float = math.nan
    value_um: float = 0.0
    rate_um_per_s: float = 0.0

    def begin(self, time_s: float) -> None:
        """Set drift and rate to 0 at this time.

        An initially short time constant would find an old drift sooner, but its noise would move a
        still mirror.
        """
        self.time_s = time_s
        self.value_um = 0.0
        self.rate_um_per_s = 0.0

    def drift_at(self, time_s: float, time_constant_s: float) -> float:
        """Return the value expected at a time.

        Parameters
        ----------
        time_s : float
            Not before the last reading's.
        time_constant_s : float
            T of value and rate; a rate is used for so long and no longer.

        Returns
        -------
        float
            In µm.
        """
        return self.value_um + self.rate_um_per_s * min(time_s - self.time_s, time_constant_s)

    def add_reading(self, reading_um: float, time_s: float, time_constant_s: float) -> None:
        """Use a reading.

        Parameters
        ----------
        reading_um : float
            Relative to the reference, at which the drift was 0.
        time_s : float
            Later than that of the last reading.
        time_constant_s : float
            T of value and rate.
        """
        # The gains of the module's equations
        dt_s = time_s - self.time_s
        beta = math.exp(-dt_s / time_constant_s)
        expected_um = self.drift_at(time_s, time_constant_s)
        residual_um = reading_um - expected_um
        self.value_um = expected_um + (1.0 - beta**2) * residual_um
        self.rate_um_per_s += (1.0 - beta) ** 2 * residual_um / dt_s
        self.time_s = time_s
