"""Before a hold: does the film answer when the vent opens, the pump stands, and the pump runs?

A short scripted sequence; in each part the speed of the centre is the slope of the laser readings. What it checks
is sign and size within a factor, not calibration: a disconnected hose, a stuck valve or a laser on the wrong spot
are found, a pump that is 30 % weaker than stated is not.

Where the answer is not clear, all of it is done once more; a clear answer then is enough, otherwise the mean of both
decides. With 1 um of noise a good bench needs that in one start of a hundred.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from membrane_ctrl.config import PumpConfig
from membrane_ctrl.control.slope import Slope


@dataclass(frozen=True, slots=True)
class Part:
    """One part: commands, time to let the answer arrive (lag 0.15 s, transport 0.1 s), time to measure."""

    name: str
    pump_fraction: float
    vent_fraction: float
    wait_s: float
    measure_s: float


# First nothing: the pump has stood and the vent was shut until now. The vent costs height that the pump then has to
# bring back; little of it, 7 um. The pump last and at 0.8: what it adds is on the way to the setpoint anyway.
PARTS = (
    Part("off", 0.0, 0.0, 0.0, 1.2),
    Part("vent", 0.0, 0.08, 0.35, 0.5),
    Part("pump", 0.8, 0.0, 0.5, 1.0),
)
_RATE_HZ = 50.0  # for which the parts' times are
# At 50 Hz and with 1 um of noise the vent's speed has a standard deviation of 1.4 um/s, the pump's 0.6 um/s, and the
# means of two 1.0 and 0.4 um/s. What is clear is three of them from nothing, what decides in the end two and a half.
_VENT_CLEAR_UM_PER_S, _VENT_LEAST_UM_PER_S = 4.5, 2.5
_PUMP_CLEAR_SHARE, _PUMP_LEAST_SHARE, _PUMP_MOST_SHARE = 0.5, 0.3, 3.0


class ActuatorTest:
    """Run it by asking for the commands each tick and giving it the readings.

    Parameters
    ----------
    pump : PumpConfig
        What the pump is said to give.
    test_vent : bool
        The bench has a vent, and the mirror has the pressure to let gas out by it.
    rate_hz : float
        Tick rate. Fewer readings a second take longer to show a slope.
    """

    def __init__(self, pump: PumpConfig, test_vent: bool, rate_hz: float) -> None:
        self._pump = pump
        # the slope's standard deviation goes with rate^(-1/2) T^(-3/2): this T keeps it
        longer = (_RATE_HZ / min(rate_hz, _RATE_HZ)) ** (1 / 3)
        self._parts = [
            replace(part, measure_s=part.measure_s * longer) for part in PARTS if test_vent or part.name != "vent"
        ]
        self._before: dict[str, float] = {}
        self._speeds = {part.name: Slope() for part in self._parts}
        self._elapsed_s = 0.0

    def again(self) -> None:
        """Begin once more; what is not clear this time either is judged by the mean of both."""
        self._before = {name: slope.per_s for name, slope in self._speeds.items()}
        self._speeds = {part.name: Slope() for part in self._parts}
        self._elapsed_s = 0.0

    @property
    def is_second(self) -> bool:
        """What it says is the last word."""
        return bool(self._before)

    @property
    def duration_s(self) -> float:
        """Of all parts together."""
        return sum(part.wait_s + part.measure_s for part in self._parts)

    @property
    def part(self) -> Part | None:
        """The part that is running; None when all are done."""
        left_s = self._elapsed_s
        for part in self._parts:
            if left_s < part.wait_s + part.measure_s - 1e-9:
                return part
            left_s -= part.wait_s + part.measure_s
        return None

    def step(self, displacement_um: float, dt_s: float) -> None:
        """Take one reading (NaN: none), and let time pass."""
        part = self.part
        if part is None:
            return
        before = sum(p.wait_s + p.measure_s for p in self._parts[: self._parts.index(part)])
        if self._elapsed_s - before >= part.wait_s:
            self._speeds[part.name].add(self._elapsed_s, displacement_um)
        self._elapsed_s += dt_s

    @property
    def leak_um_per_s(self) -> float:
        """How fast the mirror sank with the pump off and the vent closed."""
        return max(0.0, -self._speeds["off"].per_s)

    def complaint(self) -> str:
        """What did not answer as it should, the first time what did not do so clearly; empty when all did."""
        speeds = {name: slope.per_s for name, slope in self._speeds.items()}
        unclear = self._judged(speeds, _VENT_CLEAR_UM_PER_S, _PUMP_CLEAR_SHARE)
        if not (unclear and self._before):
            return unclear  # a clear second answer is enough: something may have been in the beam during the first
        means = {name: (speed + self._before[name]) / 2 for name, speed in speeds.items()}
        return self._judged(means, _VENT_LEAST_UM_PER_S, _PUMP_LEAST_SHARE)

    def _judged(self, speeds: dict[str, float], vent_least_um_per_s: float, pump_least_share: float) -> str:
        if "vent" in speeds:
            vent_um_per_s = speeds["off"] - speeds["vent"]
            if vent_um_per_s < vent_least_um_per_s:
                return f"the vent lets the mirror down by only {vent_um_per_s:.1f} um/s"
        pump = self._pump
        share = (PARTS[-1].pump_fraction - pump.dead_fraction) / (1.0 - pump.dead_fraction)
        expected_um_per_s = pump.flow_full_um_per_s * share
        rise_um_per_s = speeds["pump"] - speeds["off"]
        if not pump_least_share <= rise_um_per_s / expected_um_per_s <= _PUMP_MOST_SHARE:
            return f"the pump lifts the mirror by {rise_um_per_s:.1f} um/s, not by about {expected_um_per_s:.1f} um/s"
        return ""
