"""Bounded asymmetric relay about the holding flow. Pure.

Asymmetric, because the mirror sinks no faster than it leaks and the pump must not stall (its least
flow is the lower end), while most of the pump's range is above. The amplitude starts small and
grows while the mirror overshoots its threshold by little, so that a pump three times stronger or
slower than configured stays within the same bounds.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.control.experiments.centre_motion import CentreMotion, MotionState
from membrane_ctrl.control.experiments.experiment import BenchSample, ExperimentEnd, Finished
from membrane_ctrl.control.experiments.operating_point import OperatingPoint, describe_bleed_remedy
from membrane_ctrl.model.state_tree import Count, StateNode

THRESHOLD_SHARE = 0.25  # of the excursion limit
OVERSHOOT_SHARE = 0.2
_GROWTH = 1.6
_FIRST_MAX_UM_PER_S = 1.5
_OVERSHOOT_LEAST_UM = 0.2  # smaller ones are noise
# A half cycle of 5 µm takes this long if leak + bleed are 0.06 µm/s, where no mirror can be held.
_PATIENCE_S = 90.0


@dataclass(slots=True)
class HalfCycle(StateNode):
    """What a relay has found in one direction."""

    amplitude_um_per_s: float
    speed_um_per_s: float


@dataclass(slots=True)
class RelayState(StateNode):
    """Where a relay is, and the amplitudes that it has found."""

    up: HalfCycle
    down: HalfCycle
    motion: MotionState = field(default_factory=MotionState)
    rises: bool = True
    time_s: float = 0.0
    since_switch_s: float = 0.0
    overshoot_um: float = 0.0
    at_centre_s: float = math.nan
    crossings: Count = 0

    @property
    def direction(self) -> int:
        """1 upwards, -1 downwards."""
        return 1 if self.rises else -1


def begin_relay(around: OperatingPoint) -> RelayState:
    """The state of a relay that begins."""
    first = min(around.holding_flow_um_per_s, _FIRST_MAX_UM_PER_S)
    return RelayState(HalfCycle(first, first), HalfCycle(first, first))


class Relay:
    """Switches between a high and a low flow whenever the centre
    leaves a band about `centre_um`.
    """

    def __init__(
        self,
        around: OperatingPoint,
        centre_um: float,
        duration_s: float = 120.0,
        memory: RelayState | None = None,
    ) -> None:
        self.memory = memory or begin_relay(around)
        self._around = around
        self._centre_um = centre_um
        self._duration_s = duration_s
        self._threshold_um = THRESHOLD_SHARE * around.limit_um
        self._motion = CentreMotion(around.stretch, around.late_s, self.memory.motion)

    @property
    def crossings(self) -> int:
        """How often it has switched."""
        return self.memory.crossings

    def step(self, measurement: BenchSample, dt_s: float) -> float | Finished:
        """One tick of the relay."""
        memory = self.memory
        self._motion.update(measurement.displacement_um, dt_s)
        if memory.time_s >= self._duration_s:
            return Finished(ExperimentEnd.COMPLETED, f"{memory.crossings} crossings")
        # 1. Where the mirror is, and what this half cycle has shown: how far it came past the
        #    threshold after the last switch, and when it passed the centre
        memory.time_s += dt_s
        memory.since_switch_s += dt_s
        off_um = self._motion.position_um - self._centre_um
        # beyond the threshold on the side it came from, for the delay after a switch
        memory.overshoot_um = max(
            memory.overshoot_um, -memory.direction * off_um - self._threshold_um
        )
        if math.isnan(memory.at_centre_s) and memory.direction * off_um > 0:
            memory.at_centre_s = memory.time_s
        # 2. Switch beyond the threshold; a mirror that does not get there ends the experiment
        around = self._around
        if memory.direction * off_um > self._threshold_um:
            self._switch_relay()
        elif memory.since_switch_s > _PATIENCE_S:
            way = "rise" if memory.rises else "sink"
            open_bleed = describe_bleed_remedy(
                around.holding_flow_um_per_s, around.least_flow_um_per_s
            )
            remedy = "check the pump, its tube and the leak"
            if not memory.rises:
                remedy = open_bleed
            still = (
                f"the mirror did not {way} by {self._threshold_um:g} µm in {_PATIENCE_S:g} s: "
                f"{remedy}"
            )
            return Finished(ExperimentEnd.NO_RESPONSE, still)
        # 3. The flow of this half cycle, about the one that holds the mirror
        half = memory.up if memory.rises else memory.down
        return around.within(
            around.holding_flow_um_per_s + memory.direction * half.amplitude_um_per_s
        )

    def _switch_relay(self) -> None:
        """Reverse; adapt the flow of the previous half cycle, whose overshoot is now known."""
        memory = self.memory
        if memory.rises:
            half, before = memory.up, memory.down
        else:
            half, before = memory.down, memory.up
        wanted_um = OVERSHOOT_SHARE * self._around.limit_um
        # the guard stops anything that would coast further, however short the true delay
        fastest_um_per_s = wanted_um / self._motion.coast_s
        if memory.time_s > memory.at_centre_s:
            half.speed_um_per_s = self._threshold_um / (memory.time_s - memory.at_centre_s)
        # Overshoot is proportional to the amplitude: scale it to the wanted one, in bounded steps
        if memory.crossings > 0:
            by_overshoot = wanted_um / max(memory.overshoot_um, _OVERSHOOT_LEAST_UM)
            factor = min(by_overshoot, fastest_um_per_s / before.speed_um_per_s)
            before.amplitude_um_per_s *= min(max(factor, 1 / _GROWTH), _GROWTH)
        memory.rises = not memory.rises
        memory.overshoot_um = 0.0
        memory.since_switch_s = 0.0
        memory.at_centre_s = math.nan
        memory.crossings += 1
