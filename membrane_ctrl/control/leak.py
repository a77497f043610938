"""How fast the mirror loses gas, from what the pump gives and the centre does.

Balance of gas, as speed of the centre:  dy/dt = v - leak + w,  and the feed-forward is -w as far as it is known, so

    leak = mean of (v - feed-forward - dy/dt)

The mean of dy/dt is a difference of two readings: the laser's noise falls with the window, not with its root.
"""

from __future__ import annotations

import math

# Long against the loop (6.5 s) and short against a leak that somebody opens.
WINDOW_S = 60.0

# Before this the readings' noise and the pump's lag are a tenth of the leak.
FIRST_S = 10.0

# The loop moves the flow by 0.15 um/s (standard deviation) and the pump's least running flow is 0.3 um/s: with less
# than this to make up for, the pump stops and starts, and in the end the band of 2 um is lost (docs/control.md).
TOO_TIGHT_UM_PER_S = 0.4

# A warning that is given is kept until the leak is clearly above the limit again.
TOO_TIGHT_END_UM_PER_S = 0.45

# As a mean over less than this the weather alone could give the warning.
JUDGE_S = 30.0


class LeakEstimate:
    """Mean loss of gas (leak and bleed together) over the last minute, or over all there is until then."""

    def __init__(self) -> None:
        self._mean_um_per_s = 0.0
        self._elapsed_s = 0.0
        self._last_um = math.nan
        self._warned = False

    @property
    def leak_um_per_s(self) -> float:
        """Estimate; NaN until there is one."""
        return self._mean_um_per_s if self._elapsed_s >= FIRST_S else math.nan

    @property
    def too_tight(self) -> bool:
        """Whether the mirror loses too little gas to be held within the band."""
        if self._elapsed_s >= JUDGE_S:
            self._warned = self._mean_um_per_s < (TOO_TIGHT_END_UM_PER_S if self._warned else TOO_TIGHT_UM_PER_S)
        return self._warned

    def update(self, flow_um_per_s: float, feedforward_um_per_s: float, filtered_um: float, dt_s: float) -> None:
        """Take one step into the mean."""
        if math.isfinite(self._last_um):
            speed_um_per_s = (filtered_um - self._last_um) / dt_s
            self._elapsed_s = min(self._elapsed_s + dt_s, WINDOW_S)
            loss_um_per_s = flow_um_per_s - feedforward_um_per_s - speed_um_per_s
            self._mean_um_per_s += dt_s / self._elapsed_s * (loss_um_per_s - self._mean_um_per_s)
        self._last_um = filtered_um

    def pause(self) -> None:
        """Nothing was seen in this step: leave it out."""
        self._last_um = math.nan
