"""Position and speed of the centre from noisy readings. Pure."""

import math
from dataclasses import dataclass, field

from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.model.state_tree import StateNode

# Time constants of the two filters whose difference is the speed, for a reading with little noise
FAST_S = 0.1
SLOW_S = 0.4
# A moving mirror continues for the pump's delay and lag after the flow is reduced: 0.24 s, up to
# twice that on a slow bench, unless more is known
USUAL_LATE_S = 0.4
_LATE_MOST_S = 1.0  # pulses turn within this time


@dataclass(slots=True)
class MotionState(StateNode):
    """The two lags, and for how long the reading has been lost."""

    fast: LowPass = field(default_factory=LowPass)
    slow: LowPass = field(default_factory=LowPass)
    lost_s: float = 0.0


class CentreMotion:
    """Position and speed of the centre from noisy readings: two lags, and their difference over
    their times'.
    """

    def __init__(
        self, stretch: float = 1.0, late_s: float = USUAL_LATE_S, memory: MotionState | None = None
    ) -> None:
        self.memory = memory or MotionState()
        self._fast_s = stretch * FAST_S
        self._slow_s = stretch * SLOW_S
        # from a reading to its effect: the filter is late as well
        self.coast_s = min(max(late_s, USUAL_LATE_S), _LATE_MOST_S) + self._fast_s

    def update(self, displacement_um: float, dt_s: float) -> None:
        """Take a reading; count a lost one, changing nothing else."""
        memory = self.memory
        if not math.isfinite(displacement_um):
            memory.lost_s += dt_s
            return
        memory.lost_s = 0.0
        memory.fast.update(displacement_um, dt_s, self._fast_s)
        memory.slow.update(displacement_um, dt_s, self._slow_s)

    @property
    def lost_s(self) -> float:
        """For how long the reading has been lost."""
        return self.memory.lost_s

    @property
    def position_um(self) -> float:
        """Filtered reading, as late as the faster filter."""
        return self.memory.fast.value

    @property
    def speed_um_per_s(self) -> float:
        """Filtered speed."""
        return (self.memory.fast.value - self.memory.slow.value) / (self._slow_s - self._fast_s)

    def compute_noise_per_laser(self, rate_hz: float) -> float:
        """Standard deviation of position + `coast_s` x speed for readings of 1 µm.

        It is sigma sqrt(dt / (2 T)) behind a lag.
        """
        gain = self.coast_s / (self._slow_s - self._fast_s)
        fast = (1 + gain) ** 2 / (2 * self._fast_s * rate_hz)
        slow = gain**2 / (2 * self._slow_s * rate_hz)
        both = 2 * gain * (1 + gain) / ((self._fast_s + self._slow_s) * rate_hz)
        return math.sqrt(fast + slow - both)
