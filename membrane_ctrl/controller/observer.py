"""Turns a tick's inputs into the observation that safety judges and the reading that the loop may
use.
"""

import math
from dataclasses import dataclass, field

from firmware_iface.roles import NO_ANSWER, NO_READING, BenchCommand, BenchReading
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller import tick
from membrane_ctrl.controller.figure_gate import FigureGate, FigureGateState
from membrane_ctrl.controller.jumps import JumpGate
from membrane_ctrl.controller.link_report import LinkReport
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.model.reason import NO_REASON, Reason, WhyCode, make_reason
from membrane_ctrl.model.state_tree import StateNode

_SLACK_PA = 20.0  # below it a slack film's gauge may repeat its zero for hours


@dataclass(slots=True)
class Repeats(StateNode):
    """How long a value has been bit-identical."""

    value: float = math.nan
    since_s: float = math.nan

    def same_s(self, value: float, now_s: float) -> float:
        """Add a value, and return for how long it has been the same.

        Parameters
        ----------
        value : float
            NaN changes nothing.
        now_s : float
            Time of the value.
        """
        if math.isfinite(value) and value != self.value:
            self.value = value
            self.since_s = now_s
        return 0.0 if math.isnan(self.since_s) else now_s - self.since_s


@dataclass(slots=True)
class ObserverState(StateNode):
    """The last inputs, as far as the next ones are judged by them."""

    last_read_s: float = math.nan
    last_advance_s: float = math.nan
    stamp: tuple[int, float] | None = None  # sample counter and device time of the last sample
    laser_jumps: JumpGate = field(default_factory=JumpGate)
    gauge_jumps: JumpGate = field(default_factory=JumpGate)
    laser_repeats: Repeats = field(default_factory=Repeats)
    gauge_repeats: Repeats = field(default_factory=Repeats)
    commanded: tuple[float, float] = (0.0, 0.0)  # the last two pump commands, newest first
    figures: FigureGateState = field(default_factory=FigureGateState)


class Observer:
    """Detects stale, frozen and jumping input.

    Attributes
    ----------
    reading : BenchReading or None
        This tick's reading.
    laser_um : float
        The laser's reading, if it is new, of good quality and no jump; NaN without one, or on a
        bench that uses none.
    displacement_um : float
        The displacement that the loop may use: the laser's, or that of the figures if the loop may
        follow the optics and the laser has none; NaN without either.
    guard_um : float
        The displacement by which range and limits are judged: like `displacement_um`, with figures
        of a few seconds ago as well.
    optics_guard_um : float
        The displacement by figures of a few seconds ago, beside a laser as well; NaN unless the
        loop may follow the optics.
    gauge_pressure_pa : float
        The gauge reading; NaN without one or for a jump. The limits judge jumps too.
    repeats_sample : bool
        The answer is good, but it has the sample of an earlier tick: the sensor is slower than the
        loop.
    optics_replace_laser : bool
        Those two are by figures: the laser is missing or stuck, or not used.
    figures : FigureGate
        The figures that may be used.
    link : LinkReport
        This tick's, of the links to the devices.
    """

    def __init__(self, config: Config, memory: ObserverState | None = None) -> None:
        self.memory = memory or ObserverState()
        limits = config.limits
        self._by_optics = config.by_optics
        self._follows_optics = config.estimates_centre and config.shape.enabled
        self._stuck_s = limits.stuck_s
        self._step_max_um = limits.step_max_um
        self._gauge_step_max_pa = limits.gauge_step_max_pa
        self.figures = FigureGate(config, self.memory.figures)
        self._laser_same_s = 0.0
        self.reading: BenchReading | None = None
        self.laser_um = self.displacement_um = self.guard_um = self.gauge_pressure_pa = math.nan
        self.optics_guard_um = math.nan
        self.repeats_sample = False
        self.optics_replace_laser = False
        self.link = LinkReport()

    def note_command(self, command: BenchCommand) -> None:
        """Note the tick's command for comparison with the next read-backs."""
        self.memory.commanded = (command.pump_fraction, self.memory.commanded[0])

    @property
    def commanded(self) -> tuple[float, float]:
        """The last two pump commands, newest first."""
        return self.memory.commanded

    def observe_inputs(self, inputs: tick.TickInputs, may_follow_optics: bool = True) -> None:
        """Take the tick's reading and find what is new or a jump.

        Parameters
        ----------
        inputs : TickInputs
            Reading, figure and link of the tick.
        may_follow_optics : bool
            Whether the estimate uses the figures; otherwise they replace no laser.
        """
        reading = self.reading = inputs.reading
        self.link = inputs.link
        now_s = inputs.now_s
        memory = self.memory
        if math.isnan(memory.last_read_s):  # ages count from the first tick
            memory.last_read_s = now_s
            memory.last_advance_s = now_s
        # 1. Age of the last answer, and of the last one with a new sample
        if reading is not None:
            memory.last_read_s = now_s
            # Counter and device time must both advance: a device that hangs may still count
            stamp = (reading.sample_counter, reading.device_time_s)
            if memory.stamp is None or (
                stamp[0] != memory.stamp[0] and stamp[1] != memory.stamp[1]
            ):
                memory.last_advance_s = now_s
                memory.stamp = stamp
        # 2. The laser: a repeated sample or a jump is no reading
        uses_laser = not self._by_optics
        fresh = memory.last_advance_s == now_s
        self.repeats_sample = uses_laser and not fresh and math.isfinite(_good_quality_um(reading))
        self.laser_um = self._gate_displacement(reading, fresh=fresh and uses_laser)
        same_s = memory.laser_repeats.same_s(self.laser_um, now_s)
        self._laser_same_s = same_s if math.isfinite(self.laser_um) else 0.0
        # 3. The figure; it replaces a missing laser if the loop may follow it
        self.figures.judge_figure(now_s, inputs.estimate, self.moving_laser_um)
        self.displacement_um = self.guard_um = self.laser_um
        self.optics_replace_laser = False
        may_follow = self._follows_optics and may_follow_optics
        self.optics_guard_um = self.figures.guard_um if may_follow else math.nan
        if may_follow and math.isnan(self.moving_laser_um):
            self._replace_laser_by_optics()
        # 4. The gauge, without jumps that no film can cause
        gauge_pa = reading.gauge_pressure_pa if reading else math.nan
        self.gauge_pressure_pa = (
            math.nan if memory.gauge_jumps.is_jump(gauge_pa, self._gauge_step_max_pa) else gauge_pa
        )

    def _replace_laser_by_optics(self) -> None:
        """Let the figures show the displacement; a stuck laser stays where they show none."""
        if self.laser_stuck and math.isnan(self.figures.guard_um):
            return
        self.displacement_um = self.figures.loop_um
        self.guard_um = self.figures.guard_um
        self.optics_replace_laser = math.isfinite(self.guard_um)

    @property
    def laser_stuck(self) -> bool:
        """The laser repeats one value to the last bit, which no film does."""
        return self._laser_same_s > self._stuck_s

    @property
    def moving_laser_um(self) -> float:
        """The laser's reading; NaN also while it is stuck."""
        return math.nan if self.laser_stuck else self.laser_um

    @property
    def missing_reason(self) -> Reason:
        """Why there is no displacement in this tick; `NO_REASON` if there is one."""
        if math.isfinite(self.displacement_um):
            return NO_REASON
        if self._by_optics:
            return self.figures.explain_unseen()
        if not self._has_answer(self.reading):
            why = self.link.explain_silence("displacement")
            shown = f"no valid answer: {why}" if why else "no valid answer"
            return make_reason(WhyCode.NO_READING, shown)
        assert self.reading is not None  # otherwise there is no answer
        quality = self.reading.displacement_quality
        return make_reason(WhyCode.NO_READING, f"no valid laser reading (quality {quality})")

    @property
    def waited_s(self) -> float:
        """How long a camera that is needed took to give its first figure, so far;
        0 with a laser.
        """
        return self.figures.waited_s if self._by_optics else 0.0

    def make_observation(self, inputs: tick.TickInputs, error_um: float) -> Observation:
        """Return what the inputs show, after `observe_inputs`; the controller adds what its parts
        have found.

        Parameters
        ----------
        inputs : TickInputs
            Those of `observe_inputs`.
        error_um : float
            Setpoint less process value; NaN without one.
        """
        reading, now_s = self.reading, inputs.now_s
        gauge_pa = reading.gauge_pressure_pa if reading else math.nan
        return Observation(
            link_up=inputs.link_up,
            reading_age_s=now_s - self.memory.last_read_s,
            advance_age_s=now_s - self.memory.last_advance_s,
            same_s=self._laser_same_s,
            displacement_um=self.displacement_um if self._by_optics else _good_quality_um(reading),
            optics_guard_um=self.optics_guard_um,
            displacement_valid=math.isfinite(self.displacement_um),
            jumps=self.memory.laser_jumps.count,
            error_um=error_um,
            gauge_pressure_pa=gauge_pa,
            gauge_same_s=self._gauge_same_s(gauge_pa, now_s),
            gauge_jumps=self.memory.gauge_jumps.count,
            pump_mismatch=self._pump_mismatch(reading),
            watchdog_tripped=reading.watchdog_tripped if reading else False,
            board_faults=reading.latched_faults if reading else 0,
            foreign=reading.foreign if reading else 0,
            lateness_ms=inputs.lateness_ms,
            dead_tasks=inputs.dead_tasks,
            reading=reading or NO_READING,
            answered=self._has_answer(reading),
            link=inputs.link,
        )

    def _has_answer(self, reading: BenchReading | None) -> bool:
        """Whether the device that shows the displacement gave a valid answer in this tick."""
        if reading is None:
            return False
        return self._by_optics or reading.displacement_quality != NO_ANSWER

    def _gate_displacement(self, reading: BenchReading | None, fresh: bool) -> float:
        """The displacement if it is finite, good, new, and within reach of the last good one; else
        NaN.
        """
        value_um = _good_quality_um(reading)
        if (
            not fresh
            or not math.isfinite(value_um)
            or self.memory.laser_jumps.is_jump(value_um, self._step_max_um)
        ):
            return math.nan
        return value_um

    def _gauge_same_s(self, gauge_pa: float, now_s: float) -> float:
        """How long the gauge of a taut film has repeated one value; 0 in a tick without one."""
        same_s = self.memory.gauge_repeats.same_s(gauge_pa, now_s)
        return same_s if abs(gauge_pa) > _SLACK_PA else 0.0

    def _pump_mismatch(self, reading: BenchReading | None) -> float:
        """Distance of the read-back from the nearer of the last two commands: a tick of transport
        is no mismatch.
        """
        if reading is None:
            return 0.0  # missing readings have rules of their own
        if not math.isfinite(reading.pump_fraction):
            return math.inf  # the pump's state is unknown
        return min(abs(reading.pump_fraction - command) for command in self.commanded)


def _good_quality_um(reading: BenchReading | None) -> float:
    if reading is None or reading.displacement_quality != 0:
        return math.nan
    return reading.displacement_um
