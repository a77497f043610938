"""The actuator test before a hold: the vent must sink the mirror, the pump must lift it. Pure."""

from dataclasses import dataclass, field, replace

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.control.line_slope import Slope
from membrane_ctrl.model.state_tree import StateNode

_RATE_HZ = 50.0  # tick rate of the parts' times
# At 50 Hz and with 1 µm of noise the vent's speed has a standard deviation of 1.4 µm/s, the pump's
# 0.6 µm/s, and the means of two 1.0 and 0.4 µm/s. Three of them are clear; two and a half decide in
# the end.
_VENT_CLEAR_UM_PER_S = 4.5
_VENT_LEAST_UM_PER_S = 2.5
_PUMP_CLEAR_SHARE = 0.5
_PUMP_LEAST_SHARE = 0.3
_PUMP_MOST_SHARE = 3.0


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the actuator test: commands, response time (lag 0.15 s, transport 0.1 s), measuring
    time.
    """

    name: str
    pump_fraction: float
    vent_fraction: float
    wait_s: float
    measure_s: float


# The vent costs 7 µm of height, which the pump must restore. The pump comes last, at 0.8: its gas
# is needed on the way to the setpoint anyway.
PARTS = (
    Part("off", 0.0, 0.0, 0.0, 1.2),
    Part("vent", 0.0, 0.08, 0.35, 0.5),
    Part("pump", 0.8, 0.0, 0.5, 1.0),
)


@dataclass(slots=True)
class ActuatorTestState(StateNode):
    """What a test was begun with, and its slopes so far."""

    pump: PumpConfig
    test_vent: bool
    speeds: dict[str, Slope]  # by part
    before: dict[str, float] = field(default_factory=dict)  # of the first run, µm/s
    elapsed_s: float = 0.0


class ActuatorTest:
    """Does the film respond to vent and pump? Each tick executes the commands of `part` and gives
    `step` its reading.

    The speed of the centre in each part is the slope of the laser readings. The test checks sign
    and size within a
    factor: it finds a disconnected hose, a stuck valve or a laser on the wrong spot, not a pump 30
    % too weak. After an unclear response it runs again; then a clear response suffices, otherwise
    the mean of both decides. With 1 µm of noise a good bench needs the second run in one start of a
    hundred.

    Parameters
    ----------
    pump : PumpConfig
    test_vent : bool
        Whether the bench has a vent and the mirror pressure to release.
    rate_hz : float
        Tick rate; fewer readings per second take longer to show a slope.
    memory : ActuatorTestState, optional
        Of a test in progress, with this pump and vent.
    """

    def __init__(
        self,
        pump: PumpConfig,
        test_vent: bool,
        rate_hz: float,
        memory: ActuatorTestState | None = None,
    ) -> None:
        # the slope's standard deviation goes with rate^(-1/2) T^(-3/2): this T keeps it
        longer = (_RATE_HZ / min(rate_hz, _RATE_HZ)) ** (1 / 3)
        self._parts = [
            replace(part, measure_s=part.measure_s * longer)
            for part in PARTS
            if test_vent or part.name != "vent"
        ]
        self.memory = memory or ActuatorTestState(pump, test_vent, self._fresh_slopes())

    def _fresh_slopes(self) -> dict[str, Slope]:
        return {part.name: Slope() for part in self._parts}

    def again(self) -> None:
        """Start the second run; the mean of both decides if it is unclear too."""
        memory = self.memory
        memory.before = {name: slope.per_s for name, slope in memory.speeds.items()}
        memory.speeds = self._fresh_slopes()
        memory.elapsed_s = 0.0

    @property
    def is_second(self) -> bool:
        """Whether the test runs for the second and last time."""
        return bool(self.memory.before)

    @property
    def duration_s(self) -> float:
        """Total duration of all parts."""
        return sum(part.wait_s + part.measure_s for part in self._parts)

    @property
    def part(self) -> Part | None:
        """The running part; None when all are done."""
        left_s = self.memory.elapsed_s
        for part in self._parts:
            if left_s < part.wait_s + part.measure_s - 1e-9:
                return part
            left_s -= part.wait_s + part.measure_s
        return None

    def step(self, displacement_um: float, dt_s: float) -> None:
        """Take one reading (NaN: none) and advance the time."""
        part = self.part
        if part is None:
            return
        before = sum(p.wait_s + p.measure_s for p in self._parts[: self._parts.index(part)])
        if self.memory.elapsed_s - before >= part.wait_s:
            self.memory.speeds[part.name].add(self.memory.elapsed_s, displacement_um)
        self.memory.elapsed_s += dt_s

    @property
    def leak_um_per_s(self) -> float:
        """How fast the mirror sank with the pump off and the vent closed."""
        return max(0.0, -self.memory.speeds["off"].per_s)

    def failure(self) -> str:
        """What failed to respond, or in the first run to respond clearly; empty if nothing."""
        speeds = {name: slope.per_s for name, slope in self.memory.speeds.items()}
        unclear = self._judged(speeds, _VENT_CLEAR_UM_PER_S, _PUMP_CLEAR_SHARE)
        if not (unclear and self.memory.before):
            return unclear  # something may have been in the beam during the first run
        means = {name: (speed + self.memory.before[name]) / 2 for name, speed in speeds.items()}
        return self._judged(means, _VENT_LEAST_UM_PER_S, _PUMP_LEAST_SHARE)

    def _judged(
        self, speeds: dict[str, float], vent_least_um_per_s: float, pump_least_share: float
    ) -> str:
        if "vent" in speeds:
            vent_um_per_s = speeds["off"] - speeds["vent"]
            if vent_um_per_s < vent_least_um_per_s:
                return f"the vent lets the mirror down by only {vent_um_per_s:.1f} µm/s"
        expected_um_per_s = pump_curve.PumpCurve(self.memory.pump).flow(PARTS[-1].pump_fraction)
        rise_um_per_s = speeds["pump"] - speeds["off"]
        if not pump_least_share <= rise_um_per_s / expected_um_per_s <= _PUMP_MOST_SHARE:
            return (
                f"the pump lifts the mirror by {rise_um_per_s:.1f} µm/s, not by about "
                f"{expected_um_per_s:.1f} µm/s"
            )
        return ""
