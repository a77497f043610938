"""From a tick's raw inputs to the observation that safety judges and the reading that the loop may use."""

from __future__ import annotations

import math

from firmware_iface.roles import BenchCommand, BenchReading
from membrane_ctrl.config import LimitsConfig
from membrane_ctrl.safety import Observation
from membrane_ctrl.tick import TickInputs


class Observer:
    """Remembers what is needed to see stale, frozen and jumping input.

    Attributes
    ----------
    reading : BenchReading or None
        This tick's reading.
    displacement_um : float
        The laser reading that the loop may use; NaN if there is none in this tick.
    """

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits
        self._last_read_s = math.nan
        self._last_advance_s = math.nan
        self._stamp: tuple[int, float] | None = None
        self._good_um = math.nan
        self._jumps = 0
        self._same_um, self._same_since_s = math.nan, math.nan
        self._commanded = (0.0, 0.0)  # the last two pump commands, newest first
        self.reading: BenchReading | None = None
        self.displacement_um = math.nan

    def wrote(self, command: BenchCommand) -> None:
        """Note the command of the tick that just ended, to compare it with its read-back."""
        self._commanded = (command.pump_fraction, self._commanded[0])

    def observe(
        self, inputs: TickInputs, error_um: float, tick_error: str, overdue: str, unfit: str, laser_lies: str
    ) -> Observation:
        """One tick's observation."""
        reading = self.reading = inputs.reading
        now_s = inputs.now_s
        if math.isnan(self._last_read_s):  # ages count from the first tick
            self._last_read_s = self._last_advance_s = now_s
        if reading is not None:
            self._last_read_s = now_s
            stamp = (reading.sample_counter, reading.device_time_s)
            if self._stamp is None or (stamp[0] != self._stamp[0] and stamp[1] != self._stamp[1]):
                self._last_advance_s = now_s
                self._stamp = stamp
        advance_age_s = now_s - self._last_advance_s
        self.displacement_um = self._gate(reading, fresh=advance_age_s == 0)
        return Observation(
            link_up=inputs.link_up,
            reading_age_s=now_s - self._last_read_s,
            advance_age_s=advance_age_s,
            same_s=self._same_s(now_s),
            displacement_um=_good_quality_um(reading),
            displacement_valid=math.isfinite(self.displacement_um),
            jumps=self._jumps,
            error_um=error_um,
            gauge_pressure_pa=reading.gauge_pressure_pa if reading else math.nan,
            pump_mismatch=self._mismatch(reading),
            watchdog_tripped=reading.watchdog_tripped if reading else False,
            board_faults=reading.latched_faults if reading else 0,
            lateness_ms=inputs.lateness_ms,
            dead_tasks=inputs.dead_tasks,
            tick_error=tick_error,
            overdue=overdue,
            unfit=unfit,
            laser_lies=laser_lies,
        )

    def _gate(self, reading: BenchReading | None, fresh: bool) -> float:
        """The displacement if it is finite, good, new, and within reach of the last good one; else NaN.

        After ten refused jumps in a row the new place is believed: the safety table has spoken by then
        (displacement_jump), and the film may really have moved while nothing valid was seen.
        """
        value_um = _good_quality_um(reading)
        if not fresh or not math.isfinite(value_um):
            return math.nan
        if abs(value_um - self._good_um) > self._limits.step_max_um and self._jumps < 10:
            self._jumps += 1
            return math.nan
        self._jumps = 0
        self._good_um = value_um
        return value_um

    def _same_s(self, now_s: float) -> float:
        """How long the valid readings have been equal to the last bit."""
        if math.isfinite(self.displacement_um) and self.displacement_um != self._same_um:
            self._same_um, self._same_since_s = self.displacement_um, now_s
        return 0.0 if math.isnan(self._same_since_s) else now_s - self._same_since_s

    def _mismatch(self, reading: BenchReading | None) -> float:
        """How far the read-back is from both of the last two commands: one tick of transport is no mismatch."""
        if reading is None or not math.isfinite(reading.pump_fraction):
            return 0.0  # no reading has its own rules
        return min(abs(reading.pump_fraction - command) for command in self._commanded)


def _good_quality_um(reading: BenchReading | None) -> float:
    if reading is None or reading.displacement_quality != 0:
        return math.nan
    return reading.displacement_um
