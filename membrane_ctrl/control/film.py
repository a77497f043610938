"""Checks that laser, gauge, pump and camera agree about the film; first without the camera. Pure.

gauge   w ~ p^(1/3) (Hencky), so a change of gauge pressure is a change of sag. Both are the film's own: weather,
        temperature and leak move laser and gauge alike, so a difference comes from a sensor or its
        mount.
nominal the pressure that a mirror of this kind has at the laser's reading, known within a factor:
units and scale.
gas     a creeping laser makes the loop pump against it. That looks like a growing leak; a camera that sees the
        film unmoved distinguishes the two.
"""  # noqa: E501

import math
from dataclasses import dataclass, field
from enum import IntEnum

from membrane_ctrl.config.schema import LimitsConfig, MirrorConfig
from membrane_ctrl.control.filters import LowPass, smoothing
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode

# 0.5 Pa of noise per sample are then 0.7 µm at 10 Hz and 2.3 µm at 1 Hz
SMOOTH_S = 10.0
# A mean of 50 of the gauge's readings is good to 1.4 µm; ten-second means of fewer are not much
# better when warm.
_KNOWN_S = 5.0
_KNOWN_READINGS = 50
WARM_S = 3 * SMOOTH_S
# Creep of 10 µm/min is 20 µm ahead of this reference; the 2 µm/min of a mount that warms up are 4
# µm.
SINCE_MINUTES_S = 120.0
# Climate moves the gauge against laser and optics: a day of +-10 % relative humidity by +-235 µm,
# of +-2 K by +-41 µm of the gauge's zero (1 Pa/K) and +-114 µm of a film that follows the air
# before its ring does. All of it in phase, +-390 µm, is 99 µm ahead of a reference of an hour. A
# drift must be faster than
# 0.033 µm/s to
# reach 120 µm there.
SINCE_HOUR_S = 3600.0
# That climate is up to 624 µm ahead of this reference (from the day's highest to its lowest); so is
# any drift faster than 29 µm/h, which therefore ends at 700 µm and somewhat more.
SINCE_DAY_S = 86_400.0
# Of the limit within a day: the climate of a controlled laboratory (+-1 K, +-5 %, 220 µm) stays
# below it.
DRIFTING_SHARE = 1 / 3
# A notice ends only when the two are clearly nearer again.
DRIFTING_OVER_SHARE = 0.8 * DRIFTING_SHARE
# Of the limit within minutes: gusts, doors and setpoints use 0.17 of it in hours, 0.1 K of the
# gauge 0.1 more
_DOUBTED_SHARE = 0.35
# On a long way the sag's own uncertainty matters (pre-strain, an offset of the laser's zero).
LAW_SHARE = 0.3
# Film, laser's zero and Young's modulus are known well enough for this; a wrong unit is off by ten.
NOMINAL_FACTOR = 2.0
NOMINAL_SLACK_PA = 20.0
NOMINAL_S = 1.0
# Below this the film is slack, and the gauge's zero is a large part of its reading.
TAUT_PA = 100.0

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


def _known(seen_s: float, readings: int) -> bool:
    """Whether the means are good enough for a reference: until there is one, nothing tells what a
    jump was.
    """
    return seen_s >= WARM_S or (seen_s >= _KNOWN_S and readings >= _KNOWN_READINGS)


@dataclass(slots=True)
class SinceState(StateNode):
    """A reference of laser, trim and gauge that follows slowly while laser and gauge agree."""

    laser_um: float = math.nan
    trim_um: float = 0.0
    root: float = math.nan  # cube root of the gauge pressure
    share: float = 0.0  # of what may be between them


@dataclass(frozen=True, slots=True)
class _Since:
    """Compares changes of sag against such a reference."""

    sensor: str  # of the displacement
    follow_s: float
    limit_um: float

    def apart(
        self,
        memory: SinceState,
        laser_um: float,
        trim_um: float,
        root: float,
        sag_um: float,
        dt_s: float,
    ) -> str:
        """Both readings, if they contradict each other; `root` is the cube root of the gauge
        pressure.
        """
        if math.isnan(memory.laser_um):
            memory.laser_um = laser_um
            memory.trim_um = trim_um
            memory.root = root
        by_laser_um, trimmed_um = laser_um - memory.laser_um, trim_um - memory.trim_um
        by_gauge_um = (sag_um - by_laser_um) * (root / memory.root - 1)
        # A laser drift that the shape loop has compensated has not moved the film.
        apart_um = min(abs(by_laser_um - by_gauge_um), abs(by_laser_um - trimmed_um - by_gauge_um))
        memory.share = apart_um / (
            self.limit_um + LAW_SHARE * min(abs(by_laser_um), abs(by_gauge_um))
        )
        if memory.share > 1.0:
            return f"{self.sensor} {by_laser_um:+.0f} µm, gauge {by_gauge_um:+.0f} µm"
        share = smoothing(dt_s, self.follow_s)
        memory.laser_um += share * by_laser_um
        memory.trim_um += share * trimmed_um
        memory.root += share * (root - memory.root)
        return ""


@dataclass(slots=True)
class LeakGrowth(StateNode):
    """Whether the film takes far more gas than it used to."""

    usual: LowPass = field(default_factory=LowPass)
    flow: LowPass = field(default_factory=LowPass)
    still_s: float = 0.0
    stands_s: float = 0.0

    def reset(self) -> None:
        """Forget the usual consumption."""
        self.usual.reset(math.nan)
        self.flow.reset(math.nan)
        self.moves()

    def moves(self) -> None:
        """The setpoint ramps: the mean includes the ramp's gas,
        with the error of the pump's map.
        """
        self.still_s = 0.0
        self.stands_s = 0.0

    def step(self, leak_um_per_s: float, flow_um_per_s: float, most: float, dt_s: float) -> str:
        """Process one tick of a held mirror and return any problem. NaN for unknown values.

        The leak is the inner loop's estimate, without the feed-forward's share, and a faulty
        thermometer shifts it; a film that really takes more gas gets more. `most`: times the usual
        consumption; infinite if a camera sees the film stand still.
        """
        if not (math.isfinite(leak_um_per_s) and math.isfinite(flow_um_per_s)):
            return ""
        flow_um_per_s = self.flow.update(flow_um_per_s, dt_s, FLOW_MEAN_S)
        takes_um_per_s = min(leak_um_per_s, flow_um_per_s)
        self.still_s += dt_s
        if self.still_s < LEAK_STANDS_S:
            return ""
        usual_um_per_s = max(self.usual.value, 0.0)
        excess_um_per_s = (most - 1) * max(usual_um_per_s, LEAK_LEAST_UM_PER_S)
        if not takes_um_per_s > usual_um_per_s + excess_um_per_s:
            self.stands_s = 0.0
            # the larger of the two, as a faulty thermometer may shift the estimate down for long
            known = math.isfinite(self.usual.value)
            takes_um_per_s = max(leak_um_per_s, flow_um_per_s) if known else leak_um_per_s
            self.usual.update(takes_um_per_s, dt_s, LEAK_REFERENCE_S)
            return ""
        self.stands_s += dt_s
        if self.stands_s < LEAK_STANDS_S:
            return ""
        return (
            f"the film takes {takes_um_per_s:.1f} µm/s of gas; it used to take "
            f"{usual_um_per_s:.1f} µm/s"
        )


@dataclass(slots=True)
class FilmMonitorState(StateNode):
    """Means of one displacement, trim and gauge, and the references that they are compared with."""

    laser: LowPass = field(default_factory=LowPass.with_early_mean)
    trim: LowPass = field(default_factory=LowPass.with_early_mean)
    root: LowPass = field(
        default_factory=LowPass.with_early_mean
    )  # of the cube root of the gauge pressure
    seen_s: float = 0.0
    readings: Count = 0
    minutes: SinceState = field(default_factory=SinceState)
    hour: SinceState = field(default_factory=SinceState)
    day: SinceState = field(default_factory=SinceState)
    # sensor and gauge have moved apart over hours, as by climate or a slow drift
    drifting: bool = False


class FilmMonitor:
    """Compares one displacement, by the laser or by the optics, with the gauge on every tick with a
    driven pump.

    Parameters
    ----------
    limits : LimitsConfig
    mirror : MirrorConfig
    sensor : str
        The displacement's sensor, for the message.
    memory : FilmMonitorState, optional
    """

    def __init__(
        self,
        limits: LimitsConfig,
        mirror: MirrorConfig,
        sensor: str = "laser",
        memory: FilmMonitorState | None = None,
    ) -> None:
        self.memory = memory or FilmMonitorState()
        self._limits = limits
        self._sag_um, self._pressure_pa = 1e3 * mirror.sag_mm, mirror.pressure_pa
        self._minutes = _Since(sensor, SINCE_MINUTES_S, limits.laser_gauge_apart_max_um)
        self._hour = _Since(sensor, SINCE_HOUR_S, limits.laser_gauge_drift_max_um)
        self._day = _Since(sensor, SINCE_DAY_S, limits.laser_gauge_day_max_um)

    def reset(self) -> None:
        """Forget everything."""
        self.memory.start_afresh()

    def step(self, dt_s: float, laser_um: float, trim_um: float, gauge_pressure_pa: float) -> str:
        """Process one tick and return both readings if they contradict each other. NaN without a
        good reading.

        `trim_um` is the shape loop's addition to the setpoint: the laser's drift as seen by the
        camera.
        """
        # Both or none: two means that started together do not differ because of the film's motion.
        if not (math.isfinite(laser_um) and math.isfinite(gauge_pressure_pa)):
            return ""
        memory = self.memory
        laser_um = memory.laser.update(laser_um, dt_s, SMOOTH_S)
        trim_um = memory.trim.update(
            trim_um, dt_s, SMOOTH_S
        )  # a knock that the optics have found moves both alike
        # The mean of the root always follows the mean of the sag; the mean of the pressure does
        # not.
        root = memory.root.update(math.cbrt(gauge_pressure_pa), dt_s, SMOOTH_S)
        memory.seen_s += dt_s
        memory.readings += 1
        if strange := self._not_nominal(laser_um, root**3):
            return strange
        sag_um = self._sag_um + laser_um
        if not _known(memory.seen_s, memory.readings) or not (self._taut or root**3 > TAUT_PA):
            return ""
        spans = (
            (self._minutes, memory.minutes),
            (self._hour, memory.hour),
            (self._day, memory.day),
        )
        contradictions = [
            since.apart(kept, laser_um, trim_um, root, sag_um, dt_s) for since, kept in spans
        ]
        memory.drifting = memory.day.share > (
            DRIFTING_OVER_SHARE if memory.drifting else DRIFTING_SHARE
        )
        return next(filter(None, contradictions), "")

    @property
    def drifting(self) -> bool:
        """Sensor and gauge have moved apart over hours, as by climate or a slow drift."""
        return self.memory.drifting

    @property
    def doubted(self) -> bool:
        """Laser and gauge are further apart than by noise or drift, though within the limit."""
        return self.memory.minutes.share > _DOUBTED_SHARE

    @property
    def drift_um(self) -> float:
        """How far sensor and gauge have moved apart within a day, µm; 0 without a reference."""
        return self.memory.day.share * self._limits.laser_gauge_day_max_um

    @property
    def _taut(self) -> bool:
        """There is a reference: from now on, a gauge that falls to
        zero does not mean a slack film.
        """
        return math.isfinite(self.memory.minutes.root)

    def _not_nominal(self, laser_um: float, gauge_pa: float) -> str:
        if self._pressure_pa == 0.0 or self.memory.seen_s < NOMINAL_S:
            return ""
        wanted_pa = self._pressure_pa * max(1 + laser_um / self._sag_um, 0.0) ** 3
        if (
            wanted_pa / NOMINAL_FACTOR - NOMINAL_SLACK_PA
            <= gauge_pa
            <= NOMINAL_FACTOR * wanted_pa + NOMINAL_SLACK_PA
        ):
            return ""
        return f"the gauge reads {gauge_pa:.0f} Pa; this sag needs about {wanted_pa:.0f} Pa"


# Laser against optics, with the gauge pressure as arbiter.
#
# All three see the sag of the mirror film change: the laser as d, the camera as sag, the gauge as
# pressure, which for a Hencky film (w ~ p^(1/3)) is dw = w / (3 p) dp. The gauge is too noisy to
# hold a mirror with (0.5 Pa are 10 µm), but its mean over ten seconds is good to about a
# micrometre, and knows nothing of mounts and cameras.
#
# Changes are compared with references that follow slowly while all agree, so that slow drift (a
# laser's mount, a gauge's zero, creep) does not count as a contradiction; the shape loop handles
# it.

# A laser's mount at 2 µm/min is then 4 µm ahead of its reference: less than the limit of 10 µm.
REFERENCE_S = 120.0
# The second reference finds optics that drift by 0.034 µm/s or more: 20 µm ahead of it. Climate
# moves the gauge by at most 0.028 µm/s (see SINCE_HOUR_S), 17 µm ahead of it; in the usual phase 13
# µm, less than the 2/3 of 20 µm with which a gauge that climate moves would side with the wrong
# one.
SLOW_REFERENCE_S = 600.0
# Of the limit between laser and optics.
SLOW_SHARE = 2.0
# The gauge must be nearer to one of them by this factor to speak.
CLEARER = 2.0
# A laser without a reading for this long is not compared; its mean then begins with its next
# reading.
LASER_GAP_S = 2.0
# While the film moves, optics lag behind the laser by a figure or a cycle; the speed is a mean over
# this.
SPEED_S = 2.0


class Liar(IntEnum):
    """Which sensor contradicts the others."""

    NOBODY = 0
    UNSURE = 1
    LASER = 2
    OPTICS = 3


@dataclass(frozen=True, slots=True)
class Changes(StateNode):
    """Changes of sag since the reference, as seen by the three, µm."""

    laser_um: float
    optics_um: float
    gauge_um: float

    def __str__(self) -> str:
        """Format the changes as one line."""
        return (
            f"laser {self.laser_um:+.1f} µm, camera {self.optics_um:+.1f} µm, gauge "
            f"{self.gauge_um:+.1f} µm"
        )

    def judge(self) -> Liar:
        """Which of laser and optics the gauge contradicts: it must be clearly nearer to the other
        one.
        """
        to_laser_um, to_optics_um = (
            abs(self.gauge_um - self.laser_um),
            abs(self.gauge_um - self.optics_um),
        )
        if to_optics_um * CLEARER < to_laser_um:
            return Liar.LASER
        if to_laser_um * CLEARER < to_optics_um:
            return Liar.OPTICS
        return Liar.UNSURE


@dataclass(slots=True)
class ReferenceMeans(StateNode):
    """Means of laser, optics and gauge that follow the present ones
    while laser and optics agree.
    """

    laser_um: float = math.nan
    optics_um: float = math.nan
    gauge_pa: float = math.nan

    @property
    def known(self) -> bool:
        """Whether there is one."""
        return math.isfinite(self.laser_um)

    def begin(self, means: tuple[float, float, float]) -> None:
        """Place it at the present means of laser (µm), optics (µm) and gauge (Pa)."""
        self.laser_um, self.optics_um, self.gauge_pa = means

    def follow(
        self, means: tuple[float, float, float], dt_s: float, time_constant_s: float
    ) -> None:
        """Move it towards the present means."""
        share = smoothing(dt_s, time_constant_s)
        self.laser_um += share * (means[0] - self.laser_um)
        self.optics_um += share * (means[1] - self.optics_um)
        self.gauge_pa += share * (means[2] - self.gauge_pa)

    def changes(self, means: tuple[float, float, float], sag_um: float) -> Changes:
        """Changes of sag since the reference; the gauge's by Hencky's law: the sag goes with the
        cube root.

        `sag_um` is that of the mirror at displacement 0.
        """
        gauge_um = (sag_um + self.laser_um) * (math.cbrt(means[2] / self.gauge_pa) - 1)
        return Changes(means[0] - self.laser_um, means[1] - self.optics_um, gauge_um)


@dataclass(slots=True)
class PlausibilityState(StateNode):
    """Means of laser, gauge and optics, the references that they are compared with, and the
    verdict.
    """

    laser: LowPass = field(default_factory=LowPass.with_early_mean)
    gauge: LowPass = field(default_factory=LowPass.with_early_mean)
    optics: LowPass = field(default_factory=LowPass.with_early_mean)
    fast: ReferenceMeans = field(default_factory=ReferenceMeans)
    slow: ReferenceMeans = field(default_factory=ReferenceMeans)
    speed_um_per_s: LowPass = field(default_factory=LowPass)
    age_s: float = 0.0
    readings: Count = 0
    figure_s: float = math.nan
    laser_gap_s: float = 0.0
    slow_wrong: bool = False  # the verdict is the slow reference's
    liar: Liar = Liar.NOBODY
    changes: Changes = Changes(math.nan, math.nan, math.nan)


class PlausibilityCheck:
    """Judges on every tick, also while the film moves; NOBODY without a camera, as two sensors can
    only disagree.

    Laser and camera may be `limit_um` apart (`shape.disagreement_max_um`) within minutes, and
    `SLOW_SHARE` times as much within a quarter of an hour; there only the camera is found wrong,
    for a laser's mount that drifts so slowly is what the camera corrects. `changes` are NaN until
    there is a reference.

    Parameters
    ----------
    limit_um : float
    sag_um : float
        Of the mirror at displacement 0, by which a change of pressure is a change of sag.
    figure_lag_s : float
        By how much a figure may be older than the laser's reading of the same tick.
    memory : PlausibilityState, optional
    """

    def __init__(
        self,
        limit_um: float,
        sag_um: float,
        figure_lag_s: float = 0.0,
        memory: PlausibilityState | None = None,
    ) -> None:
        self._limit_um, self._sag_um, self._figure_lag_s = limit_um, sag_um, figure_lag_s
        self._slow_limit_um = SLOW_SHARE * limit_um
        self.memory = memory or PlausibilityState()

    @property
    def liar(self) -> Liar:
        """The verdict."""
        return self.memory.liar

    @property
    def changes(self) -> Changes:
        """Changes of sag by which it was reached."""
        return self.memory.changes

    def reset(self) -> None:
        """Forget everything: the mirror is not held."""
        self.memory.start_afresh()

    def rebase(self) -> None:
        """Compare from the present means on: the sensor that was found wrong is used again in its
        new place.
        """
        memory = self.memory
        means = (memory.laser.value, memory.optics.value, memory.gauge.value)
        if not all(map(math.isfinite, means)):
            self.reset()
            return
        memory.fast.begin(means)
        memory.slow.begin(means)
        self._clear_verdict()

    def _clear_verdict(self) -> None:
        self.memory.liar = Liar.NOBODY
        self.memory.slow_wrong = False

    @property
    def watching(self) -> bool:
        """Whether it has had readings since the last `reset`."""
        return math.isfinite(self.memory.laser.value)

    @property
    def judges(self) -> bool:
        """Whether it would tell a moved laser from a moved film."""
        return self.memory.fast.known

    @property
    def slow_wrong(self) -> bool:
        """Whether the verdict is on a slow drift: what the sensor showed is wrong since a quarter
        of an hour.
        """
        return self.memory.slow_wrong

    def step(
        self,
        dt_s: float,
        displacement_um: float,
        gauge_pa: float,
        estimate: ShapeEstimate | None,
        blind: bool = False,
    ) -> Liar:
        """Process one tick of a held mirror; NaN without a good reading; the estimate only in its
        tick of arrival.

        `blind`: the last one is old. A camera that saw nothing of what moved is not accused of it.
        """
        memory = self.memory
        self._take_laser(displacement_um, dt_s)
        if math.isfinite(gauge_pa):
            memory.gauge.update(gauge_pa, dt_s, SMOOTH_S)
        if (
            estimate is not None
            and estimate.verdict != "rejected"
            and math.isfinite(estimate.sag_um)
        ):
            since_s = 0.0 if math.isnan(memory.figure_s) else estimate.time_s - memory.figure_s
            memory.optics.update(estimate.sag_um, max(since_s, 0.0), SMOOTH_S)
            memory.figure_s = estimate.time_s
        means = (memory.laser.value, memory.optics.value, memory.gauge.value)
        laser_present = memory.laser_gap_s <= LASER_GAP_S
        if laser_present and not blind and all(map(math.isfinite, means)):
            memory.age_s += dt_s
            memory.readings += 1
            self._judge(means, dt_s)
        return memory.liar

    def _take_laser(self, displacement_um: float, dt_s: float) -> None:
        """Update the laser's mean; after a gap it begins with the first reading, for the film may
        have moved.
        """
        memory = self.memory
        if not math.isfinite(displacement_um):
            memory.laser_gap_s += dt_s
            return
        if memory.laser_gap_s > LASER_GAP_S:
            memory.laser = LowPass.with_early_mean()
        memory.laser_gap_s = 0.0
        mean_um = memory.laser.update(displacement_um, dt_s, SMOOTH_S)
        memory.speed_um_per_s.update((displacement_um - mean_um) / SMOOTH_S, dt_s, SPEED_S)

    @property
    def _lag_um(self) -> float:
        """By how much optics may lag behind the laser because the film moves."""
        return self._figure_lag_s * abs(self.memory.speed_um_per_s.value)

    def _judge(self, means: tuple[float, float, float], dt_s: float) -> None:
        memory = self.memory
        if not _known(memory.age_s, memory.readings):
            return
        for reference in (memory.fast, memory.slow):
            if not reference.known:
                reference.begin(means)
        if memory.liar in (Liar.LASER, Liar.OPTICS):
            # The verdict stands until the two clearly agree again: a drifting gauge must not accuse
            # the other.
            judged = memory.slow if memory.slow_wrong else memory.fast
            limit_um = self._slow_limit_um if memory.slow_wrong else self._limit_um
            memory.changes = changes = judged.changes(means, self._sag_um)
            if abs(changes.laser_um - changes.optics_um) <= limit_um / 2 + self._lag_um:
                self._clear_verdict()
        else:
            self._judge_fast(means)
            if memory.liar == Liar.NOBODY:
                self._judge_slowly(means)
        if memory.liar == Liar.NOBODY:
            memory.fast.follow(means, dt_s, REFERENCE_S)
            memory.slow.follow(means, dt_s, SLOW_REFERENCE_S)

    def _judge_fast(self, means: tuple[float, float, float]) -> None:
        memory = self.memory
        memory.changes = changes = memory.fast.changes(means, self._sag_um)
        limit_um = (
            self._limit_um if memory.liar == Liar.NOBODY else self._limit_um / 2
        )  # and back only when clearly so
        agree = abs(changes.laser_um - changes.optics_um) <= limit_um + self._lag_um
        memory.liar = Liar.NOBODY if agree else changes.judge()

    def _judge_slowly(self, means: tuple[float, float, float]) -> None:
        """Find a camera that drifts slowly; a laser's slow drift is its mount's,
        and is corrected.
        """
        memory = self.memory
        changes = memory.slow.changes(means, self._sag_um)
        apart = abs(changes.laser_um - changes.optics_um) > self._slow_limit_um + self._lag_um
        if apart and changes.judge() == Liar.OPTICS:
            memory.liar = Liar.OPTICS
            memory.changes = changes
            memory.slow_wrong = True
