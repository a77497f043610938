"""Compares the film's displacement, by laser or optics, with the gauge pressure. Pure.

Two comparisons are made:

gauge     w ~ p^(1/3) (Hencky), so a change of gauge pressure is a change of sag. Both are the
          film's own: weather, temperature and leak move laser and gauge together, so a difference
          comes from a sensor or its mount.
nominal   the pressure that a mirror of this kind has at the laser's reading, known within a factor:
          units and scale.

Temperature and humidity move the film against the gauge. Where sensors show them, the comparisons
within minutes and an hour allow for what they explain (`climate_allowance`).
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.climate import ClimateConfig
from membrane_ctrl.config.schema import LimitsConfig, MirrorConfig
from membrane_ctrl.control.climate import StrainParts
from membrane_ctrl.control.climate_allowance import (
    DAY_MOST_UM,
    HOUR_MOST_UM,
    MINUTES_MOST_UM,
    ClimateAllowance,
    StrainAhead,
    find_distance,
    find_gain,
)
from membrane_ctrl.control.filters import LowPass, lag_step_fraction
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
NO_STRAINS = StrainParts()


def are_means_known(seen_s: float, readings: int) -> bool:
    """Whether the means are good enough for a reference: until there is one, nothing shows
    what a jump
    was.

    Parameters
    ----------
    seen_s : float
        Time over which both sensors were there.
    readings : int
        Number of figures in it.
    """
    return seen_s >= WARM_S or (seen_s >= _KNOWN_S and readings >= _KNOWN_READINGS)


@dataclass(slots=True)
class ComparisonState(StateNode):
    """A reference of laser, trim and gauge that follows slowly while laser and gauge agree."""

    laser_um: float = math.nan
    trim_um: float = 0.0
    root: float = math.nan  # cube root of the gauge pressure
    share: float = 0.0  # of what may be between them
    strain: StrainAhead = field(default_factory=StrainAhead)


@dataclass(frozen=True, slots=True)
class _Means:
    """Smoothed readings of a tick."""

    laser_um: float  # displacement
    trim_um: float  # what the shape loop has added to the setpoint
    root: float  # cube root of the gauge pressure, Pa^(1/3), to which the sag is proportional
    sag_um: float  # of the film
    gained: StrainParts  # strains of film and ring since the last comparison


@dataclass(frozen=True, slots=True)
class _GaugeComparison:
    """Compares changes of sag against such a reference."""

    sensor: str  # of the displacement
    follow_s: float
    limit_um: float
    allowance: ClimateAllowance

    def find_contradiction(self, memory: ComparisonState, means: _Means, dt_s: float) -> str:
        """Both readings, if they contradict each other.

        Parameters
        ----------
        memory : ComparisonState
            Readings that these are compared with; they follow slowly.
        means : _Means
            The present ones.
        dt_s : float
            Time since the last comparison.

        Returns
        -------
        str
            Empty if they agree.
        """
        # The first readings are the reference
        if math.isnan(memory.laser_um):
            memory.laser_um = means.laser_um
            memory.trim_um = means.trim_um
            memory.root = means.root
        # Changes since the reference; by the gauge, sag is proportional to the root of its pressure
        by_laser_um = means.laser_um - memory.laser_um
        trimmed_um = means.trim_um - memory.trim_um
        by_gauge_um = (means.sag_um - by_laser_um) * (means.root / memory.root - 1)
        # What the climate explains of the difference
        memory.strain.follow(means.gained, dt_s, self.follow_s)
        allowed_um = self.allowance.find_range(memory.strain)
        # A laser drift that the shape loop has compensated has not moved the film.
        difference_um = min(
            find_distance(by_laser_um - by_gauge_um, allowed_um),
            find_distance(by_laser_um - trimmed_um - by_gauge_um, allowed_um),
        )
        # The limit, and a share of the motion: the law of the film is not exact
        memory.share = difference_um / (
            self.limit_um + LAW_SHARE * min(abs(by_laser_um), abs(by_gauge_um))
        )
        if memory.share > 1.0:
            return f"{self.sensor} {by_laser_um:+.0f} µm, gauge {by_gauge_um:+.0f} µm"
        # While they agree, the reference follows: differences count for `follow_s`
        share = lag_step_fraction(dt_s, self.follow_s)
        memory.laser_um += share * by_laser_um
        memory.trim_um += share * trimmed_um
        memory.root += share * (means.root - memory.root)
        return ""


@dataclass(slots=True)
class FilmMonitorState(StateNode):
    """Means of one displacement, trim and gauge, and the references that they are compared with."""

    laser: LowPass = field(default_factory=LowPass.with_early_mean)
    trim: LowPass = field(default_factory=LowPass.with_early_mean)
    # of the cube root of the gauge pressure
    root: LowPass = field(default_factory=LowPass.with_early_mean)
    seen_s: float = 0.0
    readings: Count = 0
    minutes: ComparisonState = field(default_factory=ComparisonState)
    hour: ComparisonState = field(default_factory=ComparisonState)
    day: ComparisonState = field(default_factory=ComparisonState)
    strains: StrainParts = NO_STRAINS  # as noted
    compared_strains: StrainParts = NO_STRAINS  # at the last comparison
    # sensor and gauge have moved apart over hours, as by climate or a slow drift
    drifting: bool = False


class FilmMonitor:
    """Compares one displacement, by the laser or by the optics, with the gauge on every tick with a
    driven pump.

    Parameters
    ----------
    limits : LimitsConfig
        How far sensor and gauge may move apart within minutes, an hour and a day.
    mirror : MirrorConfig
        Sag and pressure at displacement 0, by which both are compared.
    sensor : str
        The displacement's sensor, for the message.
    memory : FilmMonitorState, optional
        From the snapshot of an earlier controller; else the first means are the reference.
    climate : ClimateConfig, optional
        The error of the film's expansions.
    """

    def __init__(
        self,
        limits: LimitsConfig,
        mirror: MirrorConfig,
        sensor: str = "laser",
        memory: FilmMonitorState | None = None,
        climate: ClimateConfig | None = None,
    ) -> None:
        self.memory = memory or FilmMonitorState()
        self._limits = limits
        self._sag_um = 1e3 * mirror.sag_mm
        self._pressure_pa = mirror.pressure_pa
        climate = climate or ClimateConfig()
        minutes, hour, day = (
            ClimateAllowance.from_config(mirror, climate, most_um)
            for most_um in (MINUTES_MOST_UM, HOUR_MOST_UM, DAY_MOST_UM)
        )
        self._minutes = _GaugeComparison(
            sensor, SINCE_MINUTES_S, limits.laser_gauge_apart_max_um, minutes
        )
        self._hour = _GaugeComparison(sensor, SINCE_HOUR_S, limits.laser_gauge_drift_max_um, hour)
        self._day = _GaugeComparison(sensor, SINCE_DAY_S, limits.laser_gauge_day_max_um, day)

    def reset(self) -> None:
        """Forget everything."""
        self.memory.start_afresh()

    def note_strains(self, strains: StrainParts) -> None:
        """Note the strains of film and ring, as the climate's sensors show them in this tick."""
        self.memory.strains = strains

    def step(self, dt_s: float, laser_um: float, trim_um: float, gauge_pressure_pa: float) -> str:
        """Process one tick; return both readings in words if they contradict each other.

        Parameters
        ----------
        dt_s : float
            Since the last tick.
        laser_um, gauge_pressure_pa : float
            Readings; NaN without a good one.
        trim_um : float
            The shape loop's addition to the setpoint: drift of the laser as the camera shows it.

        Returns
        -------
        str
            Empty if they agree.
        """
        # Both or none: two means that started together do not differ because of the film's motion.
        if not (math.isfinite(laser_um) and math.isfinite(gauge_pressure_pa)):
            return ""
        memory = self.memory
        laser_um = memory.laser.update(laser_um, dt_s, SMOOTH_S)
        # A knock that the optics have found moves laser and trim equally.
        trim_um = memory.trim.update(trim_um, dt_s, SMOOTH_S)
        # The mean of the root always follows the mean of the sag; the mean of the pressure does
        # not.
        root = memory.root.update(math.cbrt(gauge_pressure_pa), dt_s, SMOOTH_S)
        memory.seen_s += dt_s
        memory.readings += 1
        if strange := self._explain_not_nominal(laser_um, root**3):
            return strange
        sag_um = self._sag_um + laser_um
        if not are_means_known(memory.seen_s, memory.readings) or not (
            self._taut or root**3 > TAUT_PA
        ):
            return ""
        gained = find_gain(memory.strains, memory.compared_strains)
        memory.compared_strains = memory.strains
        means = _Means(laser_um, trim_um, root, sag_um, gained)
        # Within minutes, an hour and a day: a slow drift is small within minutes
        spans = (
            (self._minutes, memory.minutes),
            (self._hour, memory.hour),
            (self._day, memory.day),
        )
        contradictions = [since.find_contradiction(kept, means, dt_s) for since, kept in spans]
        # Hysteresis: a notice ends at a smaller share than it begins
        threshold = DRIFTING_OVER_SHARE if memory.drifting else DRIFTING_SHARE
        memory.drifting = memory.day.share > threshold
        contradiction = next(filter(None, contradictions), "")
        if contradiction:
            return contradiction + self._describe_climate()
        return ""

    @property
    def share_of_minutes(self) -> float:
        """How far sensor and gauge have moved apart within minutes, in units of the limit."""
        return self.memory.minutes.share

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
    def explained_um(self) -> float:
        """What the climate's sensors explain of that, signed; 0 without them."""
        return self._day.allowance.explain_um(self.memory.day.strain)

    @property
    def sees_climate(self) -> bool:
        """Whether a sensor shows a strain of the film or of its ring."""
        strains = self.memory.strains
        parts_ppm = (strains.heat_ppm, strains.water_ppm, strains.ring_ppm)
        return any(map(math.isfinite, parts_ppm))

    def _describe_climate(self) -> str:
        """What the climate has to do with a contradiction, in words."""
        if not self.sees_climate:
            return (
                "; a room whose temperature or humidity has changed does this too, "
                "and no sensor shows them"
            )
        minutes_um = self._minutes.allowance.explain_um(self.memory.minutes.strain)
        hour_um = self._hour.allowance.explain_um(self.memory.hour.strain)
        return (
            f"; temperature and humidity explain {minutes_um:+.0f} µm within minutes, of which "
            f"{MINUTES_MOST_UM:.0f} count, and {hour_um:+.0f} µm within an hour, of which "
            f"{HOUR_MOST_UM:.0f} count"
        )

    @property
    def _taut(self) -> bool:
        """There is a reference: from now on, a gauge that falls to
        zero does not mean a slack film.
        """
        return math.isfinite(self.memory.minutes.root)

    def _explain_not_nominal(self, laser_um: float, gauge_pa: float) -> str:
        if self._pressure_pa == 0.0 or self.memory.seen_s < NOMINAL_S:
            return ""
        # p ~ sag^3 (Hencky); a factor of 2 or so is a wrong unit or range, not a film
        wanted_pa = self._pressure_pa * max(1 + laser_um / self._sag_um, 0.0) ** 3
        if (
            wanted_pa / NOMINAL_FACTOR - NOMINAL_SLACK_PA
            <= gauge_pa
            <= NOMINAL_FACTOR * wanted_pa + NOMINAL_SLACK_PA
        ):
            return ""
        return f"the gauge reads {gauge_pa:.0f} Pa; this sag needs about {wanted_pa:.0f} Pa"
