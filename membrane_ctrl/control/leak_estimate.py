"""The mirror's loss of gas, from the pump's flow and the motion of the centre. Pure.

Balance of gas, as speed of the centre:  dy/dt = v - leak + w,  and the feed-forward is -w as far
as it is known, so

    leak = mean of (v - feed-forward - dy/dt)

The mean of dy/dt is a difference of two readings: the laser's noise falls with the window, not
with its root.
"""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode

# Long compared with the loop (6.5 s), short compared with a leak that somebody opens.
WINDOW_S = 60.0
# Before this the readings' noise and the pump's lag are a tenth of the leak.
FIRST_S = 10.0
# The loop moves the flow by 0.15 µm/s (standard deviation) and the pump's least running flow is 0.3
# µm/s: with less than this to make up for, the pump stops and starts, and in the end the band of 2
# µm is lost
# (docs/explanation/control.md).
TOO_TIGHT_UM_PER_S = 0.4
# A warning stands until the leak is clearly above the limit again.
TOO_TIGHT_END_UM_PER_S = 0.45
# With a shorter mean, weather alone could cause the warning.
JUDGE_S = 30.0
# A reading so far from its filtered value is a jump of film or laser: no gas moves the film so
# fast.
JUMP_UM = 10.0


@dataclass(slots=True)
class LeakEstimate(StateNode):
    """Mean loss of gas (leak and bleed together) over the last minute, or over a shorter record."""

    mean_um_per_s: float = 0.0
    elapsed_s: float = 0.0
    last_um: float = math.nan
    warned: bool = False

    @property
    def leak_um_per_s(self) -> float:
        """Estimate; NaN until there is one, and while nothing is seen."""
        if self.elapsed_s >= FIRST_S and math.isfinite(self.last_um):
            return self.mean_um_per_s
        return math.nan

    @property
    def too_tight(self) -> bool:
        """Whether the mirror loses too little gas to be held within the band."""
        if self.elapsed_s >= JUDGE_S:
            threshold_um_per_s = TOO_TIGHT_END_UM_PER_S if self.warned else TOO_TIGHT_UM_PER_S
            self.warned = self.mean_um_per_s < threshold_um_per_s
        return self.warned

    def update(
        self, pumped_um_per_s: float, displacement_um: float, filtered_um: float, dt_s: float
    ) -> None:
        """Take a step: what the pump added, and what arrived.

        Parameters
        ----------
        pumped_um_per_s : float
            Flow without the feed-forward's share.
        displacement_um, filtered_um : float
            The reading, as read and behind the loop's filter.
        dt_s : float
            Time since the last step.
        """
        jumps = abs(displacement_um - filtered_um) > JUMP_UM
        if math.isfinite(self.last_um) and not jumps:
            self.add_loss(pumped_um_per_s - (filtered_um - self.last_um) / dt_s, filtered_um, dt_s)
        self.last_um = displacement_um if jumps else filtered_um  # where the filter will be

    def add_loss(self, loss_um_per_s: float, centre_um: float, dt_s: float) -> None:
        """Take a step whose loss is known.

        Parameters
        ----------
        loss_um_per_s : float
            Mean rate at which the film lost gas in the step, by the estimate of the centre.
        centre_um : float
            Displacement at its end.
        dt_s : float
            Time since the last step.
        """
        self.elapsed_s = min(self.elapsed_s + dt_s, WINDOW_S)
        self.mean_um_per_s += dt_s / self.elapsed_s * (loss_um_per_s - self.mean_um_per_s)
        self.last_um = centre_um

    def skip_step(self) -> None:
        """Skip a step without a reading."""
        self.last_um = math.nan
