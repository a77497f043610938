"""Turns a tick's inputs into the observation that safety judges and the reading that the loop may use."""

import math

from firmware_iface.roles import BenchCommand, BenchReading
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller import safety, tick
from membrane_ctrl.model.shape_estimate import ShapeEstimate

_SLACK_PA = 20.0  # below it a slack film's gauge may repeat its zero for hours


class _Repeats:
    """How long a value has been bit-identical."""

    def __init__(self) -> None:
        self._value = self._since_s = math.nan

    def same_s(self, value: float, now_s: float) -> float:
        """Add a value and return the time in seconds; NaN changes nothing."""
        if math.isfinite(value) and value != self._value:
            self._value, self._since_s = value, now_s
        return 0.0 if math.isnan(self._since_s) else now_s - self._since_s


class _Jumps:
    """Refuses values impossibly far from the last good one; accepts the new place after ten in a row.

    By then the safety table has tripped, and the film may indeed have moved unseen.
    """

    def __init__(self, step_max: float) -> None:
        self._step_max = step_max
        self._good = math.nan
        self.count = 0

    def refuse(self, value: float) -> bool:
        """Whether a value is a jump; NaN is not."""
        if not math.isfinite(value):
            return False
        if abs(value - self._good) > self._step_max and self.count < 10:
            self.count += 1
            return True
        self.count = 0
        self._good = value
        return False


_FIGURE_S, _FIGURES = 1.0, 5  # a figure older than this, and than so many intervals, shows nothing
_JUMPED = 5  # figures in a row that no film can show; one or two are bad figures
_REPEATS = 3  # no two figures have the same noise
_CAMERA_STARTS_S = 900.0  # compiling on a slow machine, and the self-test of screen and camera


class _Figures:
    """The centre as figures of the mirror show it: what a bench without a laser is held by.

    Displacement 0 is a sag of `optics.mirror.sag_mm`. `missing` tells why there is no displacement, if so.
    """

    def __init__(self, config: Config) -> None:
        self._zero_um = 1e3 * config.optics.mirror.sag_mm
        self._fresh_s = max(_FIGURE_S, _FIGURES / config.shape.track_rate_hz)
        self._jumps = _Jumps(config.limits.step_max_um)
        self._um = self._time_s = self._first_s = math.nan
        self._repeats = 0
        self._refused = ""
        self.waited_s = 0.0  # for the first figure
        self.missing = ""

    def look(self, now_s: float, figure: ShapeEstimate | None) -> float:
        """Displacement in um by the newest figure; NaN if that is too old."""
        if math.isnan(self._first_s):
            self._first_s = now_s
        if math.isnan(self._um):
            self.waited_s = min(now_s - self._first_s, _CAMERA_STARTS_S)
        if figure is not None:
            self._take(figure, now_s)
        age_s = now_s - self._time_s
        self.missing = ""
        if age_s <= self._fresh_s and self._repeats < _REPEATS and self._jumps.count < _JUMPED:
            return self._um
        if self._repeats >= _REPEATS:
            self.missing = "the camera repeats one figure to the last bit"
        elif math.isnan(age_s):
            self.missing = f"no figure of the mirror yet{self._refused}"
        else:
            self.missing = f"no figure of the mirror for {age_s:.1f} s{self._refused}"
        return math.nan

    def _take(self, figure: ShapeEstimate, now_s: float) -> None:
        um = figure.sag_um - self._zero_um
        if figure.verdict == "rejected":
            self._refused = f": {figure.reason}"
        elif figure.kind == "full":
            self._refused = ": it has only been anchored"  # which shows another sag than the frames after it
        elif not math.isfinite(um):
            self._refused = ": it is not finite"
        elif not figure.time_s <= now_s or figure.time_s <= self._time_s:
            self._refused = ": its time is wrong"
        elif self._jumps.refuse(um):
            self._refused = f": the sag jumped by {um - self._um:+.0f} um"
        else:
            self._repeats = self._repeats + 1 if um == self._um else 0
            self._um, self._time_s, self._refused = um, figure.time_s, ""


class Observer:
    """Detects stale, frozen and jumping input.

    Attributes
    ----------
    reading : BenchReading or None
        This tick's reading.
    displacement_um : float
        The displacement that the loop may use, by the laser, or by figures on a bench held without one; NaN without.
    gauge_pressure_pa : float
        The gauge reading; NaN without one or for a jump. The limits judge jumps too.
    commanded : tuple of float
        The last two pump commands, newest first.
    """

    def __init__(self, config: Config) -> None:
        limits = config.limits
        self._figures: _Figures | None = _Figures(config) if config.by_optics else None
        self._last_read_s = math.nan
        self._last_advance_s = math.nan
        self._stamp: tuple[int, float] | None = None
        self._laser_jumps, self._gauge_jumps = _Jumps(limits.step_max_um), _Jumps(limits.gauge_step_max_pa)
        self._laser_repeats, self._gauge_repeats = _Repeats(), _Repeats()
        self.commanded = (0.0, 0.0)
        self.reading: BenchReading | None = None
        self.displacement_um = self.gauge_pressure_pa = math.nan

    def wrote(self, command: BenchCommand) -> None:
        """Note the tick's command for comparison with the next read-backs."""
        self.commanded = (command.pump_fraction, self.commanded[0])

    def look(self, inputs: tick.TickInputs) -> None:
        """Take the tick's reading and find what is new or a jump."""
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
        if self._figures is None:
            self.displacement_um = self._gate(reading, fresh=self._last_advance_s == now_s)
        else:
            self.displacement_um = self._figures.look(now_s, inputs.estimate)
        gauge_pa = reading.gauge_pressure_pa if reading else math.nan
        self.gauge_pressure_pa = math.nan if self._gauge_jumps.refuse(gauge_pa) else gauge_pa

    @property
    def unseen(self) -> str:
        """Why there is no displacement in this tick; empty if there is one."""
        if math.isfinite(self.displacement_um):
            return ""
        if self._figures is not None:
            return self._figures.missing
        return f"no valid laser reading (quality {self.reading.displacement_quality if self.reading else 'unknown'})"

    @property
    def waited_s(self) -> float:
        """How long a camera that is needed took to give its first figure, so far; 0 with a laser."""
        return 0.0 if self._figures is None else self._figures.waited_s

    def observe(self, inputs: tick.TickInputs, error_um: float) -> safety.Observation:
        """Return what the inputs show, after `look`; the control code fills in what it knows itself."""
        reading, now_s = self.reading, inputs.now_s
        gauge_pa = reading.gauge_pressure_pa if reading else math.nan
        return safety.Observation(
            link_up=inputs.link_up,
            reading_age_s=now_s - self._last_read_s,
            advance_age_s=now_s - self._last_advance_s,
            same_s=self._laser_repeats.same_s(self.displacement_um, now_s),
            displacement_um=_good_quality_um(reading) if self._figures is None else self.displacement_um,
            unseen_film="" if self._figures is None else self._figures.missing,
            displacement_valid=math.isfinite(self.displacement_um),
            jumps=self._laser_jumps.count,
            error_um=error_um,
            gauge_pressure_pa=gauge_pa,
            gauge_same_s=self._gauge_same_s(gauge_pa, now_s),
            gauge_jumps=self._gauge_jumps.count,
            pump_mismatch=self._mismatch(reading),
            watchdog_tripped=reading.watchdog_tripped if reading else False,
            board_faults=reading.latched_faults if reading else 0,
            foreign=reading.foreign if reading else 0,
            lateness_ms=inputs.lateness_ms,
            dead_tasks=inputs.dead_tasks,
            vent_fraction=reading.vent_fraction if reading else math.nan,
        )

    def _gate(self, reading: BenchReading | None, fresh: bool) -> float:
        """The displacement if it is finite, good, new, and within reach of the last good one; else NaN."""
        value_um = _good_quality_um(reading)
        if not fresh or not math.isfinite(value_um) or self._laser_jumps.refuse(value_um):
            return math.nan
        return value_um

    def _gauge_same_s(self, gauge_pa: float, now_s: float) -> float:
        """How long the gauge of a taut film has repeated one value; 0 in a tick without one."""
        same_s = self._gauge_repeats.same_s(gauge_pa, now_s)
        return same_s if abs(gauge_pa) > _SLACK_PA else 0.0

    def _mismatch(self, reading: BenchReading | None) -> float:
        """Distance of the read-back from the nearer of the last two commands: a tick of transport is no mismatch."""
        if reading is None:
            return 0.0  # missing readings have rules of their own
        if not math.isfinite(reading.pump_fraction):
            return math.inf  # the pump's state is unknown
        return min(abs(reading.pump_fraction - command) for command in self.commanded)


def _good_quality_um(reading: BenchReading | None) -> float:
    if reading is None or reading.displacement_quality != 0:
        return math.nan
    return reading.displacement_um
