"""The actuator test before a hold: the vent must sink the mirror, the pump must lift it. Pure.

Three parts follow each other, each with one command: everything off (the film's own speed), vent a
little open, pump at most of its flow. A response is awaited: a part ends as soon as the film's
speed has changed clearly, and the test fails if it has not after the part's longest time. A slow
pump or a weak vent takes longer, and a dead or reversed one is found.

If it is wanted, a fourth part identifies dead time and lag of the pump, which switches off and on
until they are known well enough, or the test's time is over.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.control.pump_response import (
    PumpResponse,
    Switch,
    estimate_flow,
    identify_pump_response,
)
from membrane_ctrl.controller.actuator_test_part import Part
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.state_tree import ArrayShape, Count, StateNode

_RATE_HZ = 50.0  # tick rate of the parts' times
# A change of speed is clear beyond so many standard deviations: judged in some ten independent
# windows, noise alone then passes two dead actuators in a thousand.
_CLEAR_SIGMAS = 3.5
# Slower than this no vent lowers the mirror in time, and gusts change the speed by as much.
_VENT_LEAST_UM_PER_S = 1.0
_PUMP_CLEAR_SHARE = 0.5
# At the end of the longest time: a pump that is still accelerating, or weaker than its curve.
_PUMP_LEAST_SHARE = 0.3
_PUMP_MOST_SHARE = 3.0
# A pump that lifts the mirror by this share of its curve, and by so many standard deviations, is
# given so much more time: it is slow, or its gas of before the test has hidden its beginning.
_PUMP_LATE_SHARE = 0.15
_PUMP_LATE_SIGMAS = 3.0
_PUMP_LATE_S = 3.0
# A pump whose curve is only assumed may be this many times as strong: a laser that reads inches as
# centimetres, or micrometres as nanometres, is further off.
_ASSUMED_MOST_SHARE = 8.0
# Such a pump may also be as weak as the leak: it passes at the end of its time if it lifts the
# mirror clearly, and has more time unless the mirror sinks by more than this. A mirror that rose
# with everything off shows nothing by rising.
_SINKS_SIGMAS = 1.0
_ROSE_SIGMAS = 2.5
# In that time its speed is measured over so many seconds.
_LATE_WINDOW_MOST_S = 5.0
# A straight line that leaves more than this was disturbed: by something in the beam, or a door.
_UNSTEADY_NOISES = 2.0
_UNSTEADY_LEAST_UM = 2.0
_NOISE_LEAST_UM = 0.3  # gusts and the laser's resolution
_OFF_REPEATS = 2
# A line with a step in it fits the readings better than one without, by this chi-square: the laser
# has jumped. Noise alone does so in a few of ten thousand tests.
_STEP_CHI2 = 20.0
_MEDIAN_STEP = 0.954  # median of the difference of two readings, in units of the noise of one
# All changes of speed are measured from that with everything off. With 1 µm of noise it has
# 0.4 µm/s after the part's measuring time; a noisier laser takes longer.
_OFF_SIGMA_MOST_UM_PER_S = 0.6
# A speed is measured over all readings after a part's waiting time, but at most over so many
# seconds: noise averages out, and the beginning of a slow response is left behind.
_VENT_WINDOW_MOST_S = 2.0
_PUMP_WINDOW_MOST_S = 2.5
_SWITCH_SHARE = 0.5
_SWITCH_RANGE_S = (1.0, 2.0)
# Readings count from here on: until then the vent may still be closing.
_VENT_CLOSED_S = 1.0
# By this much the film's speed with the pump off may differ from that of the part `off`, in which
# the gas of an earlier hold may still have arrived.
_STILL_SIGMA_UM_PER_S = 1.0
# Dead time and lag together are known well enough at this standard deviation, or share of them.
_RESPONSE_SIGMA_S = 0.08
_RESPONSE_SIGMA_SHARE = 0.2


# The vent costs 7 µm of height, which the pump must restore. The pump comes last, at 0.8: its gas
# is needed on the way to the setpoint anyway. Five seconds are enough for a delay of 2 s with a lag
# of 1.5 s, and together with the other parts they are what a test took that ran twice.
PARTS = (
    Part("off", 0.0, 0.0, 0.0, 1.2, 3.0),
    Part("vent", 0.0, 0.08, 0.35, 0.5, 3.0),
    Part("pump", 0.8, 0.0, 0.5, 1.0, 5.0),
)

# Identification: the pump is off, then on for a share of the time after which it had responded
RESPONSE = Part("response", 0.8, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Speed:
    """A measured speed of the film.

    Attributes
    ----------
    um_per_s, sigma_um_per_s : float
        The slope of a straight line through readings, and its standard deviation.
    residual_um : float
        Root mean square of the readings' distance from that line.
    """

    um_per_s: float
    sigma_um_per_s: float
    residual_um: float


@dataclass(slots=True)
class ActuatorTestState(StateNode):
    """A test in progress.

    Attributes
    ----------
    pump : PumpConfig
        With which it was begun.
    test_vent : bool
        Whether it has the part `vent`.
    part : int
        Number of the running part.
    part_s : float
        How long it has run.
    readings : (n, 2) array
        Its readings: time in the part in s, displacement in µm.
    noise_um : float
        Noise of a reading, found while everything was off.
    off_um_per_s, off_sigma_um_per_s : float
        Speed while everything was off.
    off_repeats : int
        How often that part was repeated.
    reversed_s : float
        How long the pump has lowered the mirror clearly.
    total_s : float
        How long the whole test has run.
    identify : bool
        Whether it has the part `response`.
    switches : list of Switch
        When the pump was switched, by the time of the part `pump`, which continues in `response`.
    switch_s : float
        Time between switches.
    response : PumpResponse or None
        Dead time and lag, once they are identified.
    flow_um_per_s : float
        Flow of the pump at the test's command, found with the response; NaN without one.
    failure : str
        What does not respond; empty if nothing has failed.
    """

    pump: PumpConfig
    test_vent: bool
    part: Count = 0
    part_s: float = 0.0
    readings: Annotated[FloatArray, ArrayShape((-1, 2))] = field(
        default_factory=lambda: np.empty((0, 2))
    )
    noise_um: float = math.nan
    off_um_per_s: float = math.nan
    off_sigma_um_per_s: float = math.nan
    off_repeats: Count = 0
    reversed_s: float = 0.0
    total_s: float = 0.0
    identify: bool = False
    switches: list[Switch] = field(default_factory=list)
    switch_s: float = 0.0
    response: PumpResponse | None = None
    flow_um_per_s: float = math.nan
    failure: str = ""


class ActuatorTest:
    """Does the film respond to vent and pump? Each tick executes the commands of `part` and gives
    `step` its reading.

    The test checks sign and size within a factor: it finds a disconnected hose, a stuck valve or a
    laser on the wrong spot, not a pump 30 % too weak. Of a pump whose curve nobody has stated, it
    asks only that it lifts the mirror, and not `_ASSUMED_MOST_SHARE` times as fast as assumed.

    Parameters
    ----------
    pump : PumpConfig
        The curve by which the rise of the mirror is judged.
    test_vent : bool
        Whether the bench has a vent and the mirror pressure to release.
    rate_hz : float
        Tick rate; fewer readings per second take longer to show a speed.
    identify : bool
        Whether dead time and lag of the pump are to be identified.
    memory : ActuatorTestState, optional
        Of a test in progress, with this pump and vent.
    assumed : bool
        Whether the pump's curve is assumed, not stated.
    """

    def __init__(
        self,
        pump: PumpConfig,
        test_vent: bool,
        rate_hz: float,
        identify: bool = False,
        memory: ActuatorTestState | None = None,
        assumed: bool = False,
    ) -> None:
        self._assumed = assumed
        # A speed's standard deviation goes with rate^(-1/2) T^(-3/2): this T keeps it.
        longer = (_RATE_HZ / min(rate_hz, _RATE_HZ)) ** (1 / 3)
        self._parts = [
            _lengthen(part, longer) for part in PARTS if test_vent or part.name != "vent"
        ]
        self.memory = memory or ActuatorTestState(pump, test_vent, identify=identify)
        if self.memory.identify:
            self._parts.append(RESPONSE)

    @property
    def part(self) -> Part | None:
        """The running part; None when the test is over."""
        number = self.memory.part
        if number >= len(self._parts):
            return None
        part = self._parts[number]
        switched_off = part.name == RESPONSE.name and not self.memory.switches[-1].on
        return replace(part, pump_fraction=0.0) if switched_off else part

    @property
    def response(self) -> PumpResponse | None:
        """Dead time and lag of the pump; None if they were not identified."""
        return self.memory.response

    @property
    def stronger_pump(self) -> PumpConfig | None:
        """A straight line for a pump that is much stronger than its assumed curve; else None.

        Dead zone and stall of the assumed pump are not those of such a pump: at the least flow that
        they allow, it may give several times the leak.
        """
        memory = self.memory
        most_um_per_s = _PUMP_MOST_SHARE * self._expected_um_per_s
        if not self._assumed or not memory.flow_um_per_s > most_um_per_s:
            return None
        return memory.pump.model_copy(
            update={
                "flow_full_um_per_s": memory.flow_um_per_s / PARTS[-1].pump_fraction,
                "dead_fraction": 0.0,
                "start_fraction": 0.0,
                "stall_fraction": 0.0,
            }
        )

    @property
    def longest_s(self) -> float:
        """The longest time of all parts, without repeats and without the time of a late pump."""
        return sum(part.longest_s for part in self._parts)

    @property
    def failure(self) -> str:
        """What does not respond; empty if nothing has failed."""
        return self.memory.failure

    @property
    def _expected_um_per_s(self) -> float:
        """How fast the pump should lift the mirror, by its curve."""
        return pump_curve.PumpCurve(self.memory.pump).flow(PARTS[-1].pump_fraction)

    @property
    def leak_um_per_s(self) -> float:
        """How fast the mirror sank with the pump off and the vent closed."""
        return max(0.0, -self.memory.off_um_per_s)

    def step(self, displacement_um: float, dt_s: float) -> None:
        """Take one reading and advance the time.

        Parameters
        ----------
        displacement_um : float
            NaN: none.
        dt_s : float
            Time since the last tick.
        """
        part = self.part
        if part is None:
            return
        memory = self.memory
        if math.isfinite(displacement_um):
            reading = [[memory.part_s, displacement_um]]
            memory.readings = np.concatenate((memory.readings, reading))
        memory.part_s += dt_s
        memory.total_s += dt_s
        if memory.part_s < part.wait_s + part.measure_s - 1e-9:
            return
        # From the shortest time of a part on, each tick judges it: it passes, fails, or continues
        # to its longest time
        match part.name:
            case "off":
                self._judge_off(part)
            case "vent":
                self._judge_vent(part)
            case "pump":
                self._judge_pump(part, dt_s)
            case "response":
                self._switch_pump(dt_s)

    def _judge_off(self, part: Part) -> None:
        """Measure the film's own speed, and the noise of a reading."""
        memory = self.memory
        # Differences of successive readings show the noise without the film's motion
        values_um = memory.readings[:, 1]
        steps_um = np.diff(values_um)
        noise_um = float(np.sqrt(np.mean(steps_um**2) / 2)) if steps_um.size else math.inf
        memory.noise_um = max(noise_um, _NOISE_LEAST_UM)
        speed = self._measure(0.0)
        # A laser whose readings jump again and again is only noisy: it is judged by its line.
        jumped = memory.off_repeats < _OFF_REPEATS and _has_step(memory.readings)
        if speed is None or not self._is_straight(speed) or jumped:
            if memory.off_repeats >= _OFF_REPEATS:
                self._fail("its readings jump by micrometres with pump and vent off")
                return
            memory.off_repeats += 1
            self._begin_part(memory.part)
            return
        # A noisy laser needs longer for the same error of the speed
        is_last = memory.part_s >= part.longest_s - 1e-9
        if speed.sigma_um_per_s > _OFF_SIGMA_MOST_UM_PER_S and not is_last:
            return
        memory.off_um_per_s = speed.um_per_s
        memory.off_sigma_um_per_s = speed.sigma_um_per_s
        self._begin_part(memory.part + 1)

    def _judge_vent(self, part: Part) -> None:
        """Pass once the open vent lowers the mirror clearly faster than before; fail at the end."""
        memory = self.memory
        from_s = max(part.wait_s, memory.part_s - _VENT_WINDOW_MOST_S)
        speed = self._measure(from_s)
        if speed is None:
            self._fail_late(part, "no reading while the vent is open")
            return
        # A jump of the laser spoils the line until it has left the window: a line from the jump on
        jump_s = _find_step(self._choose_readings(from_s))
        after_jump = None if jump_s is None else self._measure(jump_s)
        if self._lets_down(speed) or (after_jump is not None and self._lets_down(after_jump)):
            self._begin_part(memory.part + 1)
            return
        sinks_um_per_s = memory.off_um_per_s - speed.um_per_s
        sigma_um_per_s = self._sigma_of_change(speed)
        self._fail_late(
            part,
            f"the vent, {part.vent_fraction:.0%} open for {memory.part_s:.1f} s, lets the mirror "
            f"down by only {sinks_um_per_s:.1f} ± {sigma_um_per_s:.1f} µm/s",
        )

    def _lets_down(self, speed: Speed) -> bool:
        """Whether the open vent lets the mirror down clearly."""
        lets_down = False
        sinks_um_per_s = self.memory.off_um_per_s - speed.um_per_s
        least_um_per_s = max(_VENT_LEAST_UM_PER_S, _CLEAR_SIGMAS * self._sigma_of_change(speed))
        if sinks_um_per_s >= least_um_per_s and self._is_straight(speed):
            lets_down = True
        return lets_down

    def _judge_pump(self, part: Part, dt_s: float) -> None:
        """Compare the rise of the mirror with that by the pump's curve."""
        # 1. The speed over the newest readings, and the pump's share of it
        memory = self.memory
        is_last = memory.part_s >= part.longest_s - 1e-9
        late = self._assumed and memory.part_s > part.longest_s
        window_most_s = _LATE_WINDOW_MOST_S if late else _PUMP_WINDOW_MOST_S
        from_s = max(part.wait_s, memory.part_s - window_most_s)
        speed = self._measure(from_s)
        if speed is None:
            self._fail_late(part, "no reading while the pump runs")
            return
        rises_um_per_s = speed.um_per_s - memory.off_um_per_s
        sigma_um_per_s = self._sigma_of_change(speed)
        expected_um_per_s = self._expected_um_per_s
        share = rises_um_per_s / expected_um_per_s
        least_share = _PUMP_LEAST_SHARE if is_last else _PUMP_CLEAR_SHARE
        is_large = abs(rises_um_per_s) >= _CLEAR_SIGMAS * sigma_um_per_s
        is_clear = is_large and self._is_straight(speed)
        found = (
            f"the pump, at {part.pump_fraction:.0%} for {memory.part_s:.1f} s, lifts the mirror by "
            f"{rises_um_per_s:.1f} ± {sigma_um_per_s:.1f} µm/s"
        )
        if not self._assumed:
            found += f", not by about {expected_um_per_s:.1f} µm/s"
        elif share > _ASSUMED_MOST_SHARE:
            found += f": more than {_ASSUMED_MOST_SHARE:g} times as fast as a usual pump"
        else:
            found += ": less than the readings show clearly"
        # 2. Clear and straight: much too fast is a wrong curve, unless the curve is only assumed;
        #    fast enough passes. A jump of the laser looks like either, and is waited for
        if is_clear:
            most_share = _ASSUMED_MOST_SHARE if self._assumed else _PUMP_MOST_SHARE
            jumped = share > _PUMP_MOST_SHARE and _has_step(self._choose_readings(from_s))
            if share > most_share and not jumped:
                self._fail(found)
                return
            if share >= least_share and not jumped:
                self._begin_response()
                return
        # 3. At the end, a pump of unknown size need only lift the mirror
        if is_last and self._assumed and self._lifts_mirror(speed, from_s):
            self._begin_response()
            return
        # 4. A mirror that sinks clearly is behind a reversed pump
        memory.reversed_s = memory.reversed_s + dt_s if is_clear and share < 0.0 else 0.0
        # Noise may look like a reversed pump for a moment.
        if memory.reversed_s > 1.2 * part.measure_s:
            self._fail(found)
            return
        # 5. Too slow: a pump that is just coming gets more time, all others fail at the end
        is_coming = (
            share >= _PUMP_LATE_SHARE and rises_um_per_s >= _PUMP_LATE_SIGMAS * sigma_um_per_s
        )
        # Behind a dead pump most mirrors sink
        is_coming |= self._assumed and not _is_sinking(speed)
        if is_coming and memory.part_s < part.longest_s + _PUMP_LATE_S - 1e-9:
            return
        self._fail_late(part, found)

    def _lifts_mirror(self, speed: Speed, from_s: float) -> bool:
        """Whether the mirror rises clearly while the pump runs, whatever the pump's size.

        It rises by itself, or much faster than with everything off. The former needs no comparison,
        but a mirror that rose with everything off shows nothing by it.
        """
        memory = self.memory
        if not self._is_straight(speed) or _has_step(self._choose_readings(from_s)):
            return False
        rose = memory.off_um_per_s > _ROSE_SIGMAS * memory.off_sigma_um_per_s
        if not rose and speed.um_per_s >= _CLEAR_SIGMAS * speed.sigma_um_per_s:
            return True
        change_um_per_s = speed.um_per_s - memory.off_um_per_s
        least_sigmas = _CLEAR_SIGMAS if _is_sinking(speed) else _PUMP_LATE_SIGMAS
        return change_um_per_s >= least_sigmas * self._sigma_of_change(speed)

    def _begin_response(self) -> None:
        """End the part `pump`: switch the pump off to identify it, if there is time for it."""
        memory = self.memory
        least_s, most_s = _SWITCH_RANGE_S
        memory.switch_s = min(max(_SWITCH_SHARE * memory.part_s, least_s), most_s)
        if not memory.identify or not self._has_time_to_switch():
            self._begin_part(len(self._parts))
            return
        memory.switches = [Switch(0.0, on=True), Switch(memory.part_s, on=False)]
        memory.part += 1

    def _has_time_to_switch(self) -> bool:
        """Whether the pump can be switched off and on once more within the test's longest time; a
        late pump has more time for its first switch.
        """
        most_s = self.longest_s if self.memory.switches else self.longest_s + _PUMP_LATE_S
        return self.memory.total_s + 2.0 * self.memory.switch_s <= most_s

    def _switch_pump(self, dt_s: float) -> None:
        """Switch the pump when it is time to; identify it at the end of each time on."""
        memory = self.memory
        last = memory.switches[-1]
        if memory.part_s < last.at_s + memory.switch_s - 1e-9:
            return
        if last.on:
            # The first reading of a part is taken a tick after the part's command
            readings = memory.readings.copy()
            readings[:, 0] += dt_s
            readings = readings[readings[:, 0] >= _VENT_CLOSED_S]
            memory.response = identify_pump_response(
                readings,
                memory.switches,
                memory.noise_um,
                memory.off_um_per_s,
                math.hypot(memory.off_sigma_um_per_s, _STILL_SIGMA_UM_PER_S),
                self._expected_um_per_s,
            )
            if self._is_response_known() or not self._has_time_to_switch():
                if memory.response is not None:
                    memory.flow_um_per_s = estimate_flow(
                        readings, memory.switches, memory.response, memory.off_um_per_s
                    )
                self._begin_part(len(self._parts))
                return
        memory.switches.append(Switch(memory.part_s, on=not last.on))

    def _is_response_known(self) -> bool:
        response = self.memory.response
        if response is None:
            return False
        return response.sum_sigma_s <= max(
            _RESPONSE_SIGMA_S, _RESPONSE_SIGMA_SHARE * response.sum_s
        )

    def _measure(self, from_s: float) -> Speed | None:
        """Speed by the readings of the running part from a time on; None without three readings."""
        memory = self.memory
        chosen = self._choose_readings(from_s)
        if len(chosen) < 3:
            return None
        # Least squares of a line; the sigma by the noise of the part "off", because a bent path
        # would make the residuals of this one too large
        time_s = chosen[:, 0] - chosen[:, 0].mean()
        height_um = chosen[:, 1] - chosen[:, 1].mean()
        spread_s2 = float(time_s @ time_s)
        slope_um_per_s = float(time_s @ height_um) / spread_s2
        residual_um = height_um - slope_um_per_s * time_s
        return Speed(
            slope_um_per_s,
            memory.noise_um / math.sqrt(spread_s2),
            float(np.sqrt(np.mean(residual_um**2))),
        )

    def _choose_readings(self, from_s: float) -> FloatArray:
        """Readings of the running part from a time on."""
        readings = self.memory.readings
        return readings[readings[:, 0] >= from_s - 1e-9]

    def _sigma_of_change(self, speed: Speed) -> float:
        """Standard deviation of a speed's difference from that with everything off."""
        return math.hypot(speed.sigma_um_per_s, self.memory.off_sigma_um_per_s)

    def _is_straight(self, speed: Speed) -> bool:
        """Whether readings follow a line, but for noise and the onset of a flow."""
        most_um = max(_UNSTEADY_NOISES * self.memory.noise_um, _UNSTEADY_LEAST_UM)
        return speed.residual_um <= most_um

    def _begin_part(self, number: int) -> None:
        memory = self.memory
        memory.part = number
        memory.part_s = 0.0
        memory.readings = np.empty((0, 2))

    def _fail_late(self, part: Part, found: str) -> None:
        """End the test if the part has lasted for its longest time."""
        if self.memory.part_s >= part.longest_s - 1e-9:
            self._fail(found)

    def _fail(self, found: str) -> None:
        self.memory.failure = found
        self._begin_part(len(self._parts))


def _is_sinking(speed: Speed) -> bool:
    """Whether the mirror sinks, as far as the readings show it."""
    return speed.um_per_s < -_SINKS_SIGMAS * speed.sigma_um_per_s


def _has_step(readings: FloatArray) -> bool:
    """Whether a line with a step at one of the readings fits them much better than a line."""
    return _find_step(readings) is not None


def _find_step(readings: FloatArray) -> float | None:
    """Time of the first reading after a step, if a line with one fits much better than a line.

    `readings` (n, 2): time in s and displacement in µm. The noise is that of the median difference
    between readings, which a single step does not change.
    """
    if len(readings) < 4:
        return None
    differences_um = np.abs(np.diff(readings[:, 1]))
    noise_um = max(float(np.median(differences_um)) / _MEDIAN_STEP, _NOISE_LEAST_UM)
    time_s = readings[:, 0] - readings[:, 0].mean()
    # Columns: a step before each reading but the first; all without their mean and slope
    steps = np.tri(len(readings), len(readings) - 1, -1)
    columns = np.column_stack((readings[:, 1], steps))
    columns -= columns.mean(axis=0)
    columns -= np.outer(time_s, time_s @ columns / (time_s @ time_s))
    residual_um, steps = columns[:, 0], columns[:, 1:]
    gained_um2 = (residual_um @ steps) ** 2 / (steps**2).sum(axis=0)
    largest = int(gained_um2.argmax())
    if float(gained_um2[largest]) <= _STEP_CHI2 * noise_um**2:
        return None
    return float(readings[largest + 1, 0])


def _lengthen(part: Part, factor: float) -> Part:
    """A part for a slower tick rate."""
    measure_s = part.measure_s * factor
    # Two windows after each other must fit.
    longest_s = max(part.longest_s, part.wait_s + 2.2 * measure_s)
    return replace(part, measure_s=measure_s, longest_s=longest_s)
