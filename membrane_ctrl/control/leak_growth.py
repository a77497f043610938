"""Detects a film that takes far more gas than usual, without the camera. Pure.

A creeping laser makes the loop pump against it, which looks like a growing leak. A camera that sees
the film unmoved distinguishes the two.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.state_tree import StateNode

LEAK_REFERENCE_S = 3600.0
# As long as the averaging time of the leak.
LEAK_STANDS_S = 60.0
# The loop moves the flow by 0.15 µm/s: of a mean over this, 0.03 µm/s.
FLOW_MEAN_S = 15.0
# Least gas taken by a mirror: a ratio to almost nothing is meaningless.
LEAK_LEAST_UM_PER_S = 0.8
# If a camera contradicts the laser, gas that agrees with the camera outvotes a gauge that sees
# nothing.
CONTRADICTED_MOST = 1.25


@dataclass(slots=True)
class LeakGrowth(StateNode):
    """Whether the film takes far more gas than before."""

    usual: LowPass = field(default_factory=LowPass)
    flow: LowPass = field(default_factory=LowPass)
    still_s: float = 0.0
    stands_s: float = 0.0

    def reset(self) -> None:
        """Forget the usual consumption."""
        self.usual.reset(math.nan)
        self.flow.reset(math.nan)
        self.note_ramp()

    def note_ramp(self) -> None:
        """The setpoint ramps: the mean includes the ramp's gas,
        with the error of the pump's map.
        """
        self.still_s = 0.0
        self.stands_s = 0.0

    def step(self, leak_um_per_s: float, flow_um_per_s: float, most: float, dt_s: float) -> str:
        """Process one tick of a held mirror.

        The leak is the inner loop's estimate, without the feed-forward's share, and a faulty
        thermometer shifts it; a film that really takes more gas gets more.

        Parameters
        ----------
        leak_um_per_s, flow_um_per_s : float
            The estimate, and the flow of the pump; NaN if unknown.
        most : float
            Times the usual consumption; infinite if a camera sees the film stand still.
        dt_s : float
            Time since the last tick.

        Returns
        -------
        str
            The problem, for people; empty without one.
        """
        if not (math.isfinite(leak_um_per_s) and math.isfinite(flow_um_per_s)):
            return ""
        # 1. What the film takes for certain: the smaller of leak and mean flow
        flow_um_per_s = self.flow.update(flow_um_per_s, dt_s, FLOW_MEAN_S)
        takes_um_per_s = min(leak_um_per_s, flow_um_per_s)
        self.still_s += dt_s
        if self.still_s < LEAK_STANDS_S:
            return ""
        # 2. Against the usual consumption; of a tight film against a least leak, so that a small
        #    one does not count as many times as much
        usual_um_per_s = max(self.usual.value, 0.0)
        excess_um_per_s = (most - 1) * max(usual_um_per_s, LEAK_LEAST_UM_PER_S)
        if not takes_um_per_s > usual_um_per_s + excess_um_per_s:
            self.stands_s = 0.0
            # the larger of the two, as a faulty thermometer may shift the estimate down for long
            known = math.isfinite(self.usual.value)
            if known:
                takes_um_per_s = max(leak_um_per_s, flow_um_per_s)
            else:
                takes_um_per_s = leak_um_per_s
            self.usual.update(takes_um_per_s, dt_s, LEAK_REFERENCE_S)
            return ""
        # 3. It must last; meanwhile the usual consumption does not follow
        self.stands_s += dt_s
        if self.stands_s < LEAK_STANDS_S:
            return ""
        return (
            f"the film takes {takes_um_per_s:.1f} µm/s of gas; before it took "
            f"{usual_um_per_s:.1f} µm/s"
        )
