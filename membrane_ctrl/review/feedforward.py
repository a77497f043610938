"""What the feed-forward was worth: the error there would have been without it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Column = NDArray[np.float64]


class WithoutFeedforward:
    """Adds to the error what the feed-forward's flow kept away, from blocks that come in their order.

    The mirror's centre is nearly an integrator of the flow. A speed v that is not fed forward reaches the error
    through the closed loop of a PI controller,

        e / v = s / (s^2 + Kp s + Kp / Ti),

    here by the bilinear transform. Dead time and pump lag (0.26 s together) are left out: they hardly change what a
    disturbance of tens of seconds does, and make the benefit look a little smaller than it is.

    Parameters
    ----------
    kp_per_s, ti_s : float
        Of the loop as run.
    period_s : float
        Of the tick.
    """

    def __init__(self, kp_per_s: float, ti_s: float, period_s: float) -> None:
        self._numerator, self._denominator = signal.bilinear(
            [1.0, 0.0], [1.0, kp_per_s, kp_per_s / ti_s], 1 / period_s
        )
        self._state = np.zeros(2)

    def kept_away_um(self, feedforward_um_per_s: Column) -> Column:
        """(n,) um by which the error would have been larger; gaps count as no flow."""
        flow = np.nan_to_num(np.asarray(feedforward_um_per_s, dtype=np.float64))
        kept, self._state = signal.lfilter(self._numerator, self._denominator, flow, zi=self._state)
        return np.asarray(kept, dtype=np.float64)
