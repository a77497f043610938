"""The error that a hold would have had without its feed-forward."""

import numpy as np
from scipy import signal

from membrane_ctrl.model.arrays import Column


class WithoutFeedforward:
    """Adds to the error what the feed-forward's flow prevented, from consecutive blocks.

    The mirror's centre nearly integrates the flow. A speed v without feed-forward reaches the error
    through the closed loop of a PI controller,

        e / v = s / (s^2 + Kp s + Kp / Ti),

    here by the bilinear transform. Dead time and pump lag (0.26 s together) are ignored: they
    hardly change the effect of a disturbance of tens of seconds, and make the benefit appear
    slightly too small.

    Parameters
    ----------
    kp_per_s, ti_s : float
        Gains of the run's loop: Kp in 1/s, Ti in s.
    period_s : float
        Time from one tick to the next.
    """

    def __init__(self, kp_per_s: float, ti_s: float, period_s: float) -> None:
        loop = [1.0, kp_per_s, kp_per_s / ti_s]
        self._numerator, self._denominator = signal.bilinear([1.0, 0.0], loop, 1 / period_s)
        self._state = np.zeros(2)

    def estimate_kept_away_um(self, feedforward_um_per_s: Column) -> Column:
        """(n,) µm by which the error would have been larger; gaps count as zero flow."""
        flow = np.nan_to_num(np.asarray(feedforward_um_per_s, dtype=np.float64))
        kept, self._state = signal.lfilter(self._numerator, self._denominator, flow, zi=self._state)
        return np.asarray(kept, dtype=np.float64)
