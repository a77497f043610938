"""Do laser, gauge and pump tell the same story of the film? They need no camera for it. Pure.

gauge   w ~ p^(1/3) (Hencky), so a change of gauge pressure is a change of sag. Both are the film's own: weather,
        temperature and leak move laser and gauge alike, so whatever parts them is a sensor or its mount.
nominal the pressure that a mirror of this kind has at the laser's reading, known within a factor: units and scale.
gas     a laser that creeps makes the loop pump against it. That looks like a leak that grows; a camera that still
        sees the film in its place tells the two apart.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import LimitsConfig, MirrorConfig
from membrane_ctrl.control.filters import LowPass, smoothing

# 0.5 Pa of noise per sample are then 0.7 um at 10 Hz and 2.3 um at 1 Hz
SMOOTH_S = 10.0
# Before this the means still hold the first samples' noise.
WARM_S = 3 * SMOOTH_S
# Creep of 10 um/min is 20 um ahead of this reference; the 2 um/min of a mount that warms up are 4 um.
SINCE_MINUTES_S = 120.0
# Creep of 17 um an hour is 100 um ahead; a fresh film's own (1 % of compliance in a day) is 31 um.
SINCE_HOURS_S = 6 * 3600.0
# On a long way the sag's own uncertainty (pre-strain, a laser that is not zero where it is said to be) counts.
LAW_SHARE = 0.3
# Film, laser's zero and Young's modulus are known well enough for this; a wrong unit is off by ten.
NOMINAL_FACTOR = 2.0
NOMINAL_SLACK_PA = 20.0
NOMINAL_S = 1.0
# Below this the film is slack, and the gauge's zero is a large part of what it reads.
TAUT_PA = 100.0

LEAK_REFERENCE_S = 3600.0
# As long as the mean of the leak is.
LEAK_STANDS_S = 60.0
# The loop moves the flow by 0.15 um/s: of a mean over this, 0.03 um/s.
FLOW_MEAN_S = 15.0
# Of what a mirror takes at least: a share of next to nothing says nothing.
LEAK_LEAST_UM_PER_S = 0.8
# Where a camera contradicts the laser, gas that agrees with the camera outvotes a gauge that sees nothing.
CONTRADICTED_MOST = 1.25


@dataclass(slots=True)
class _Since:
    """Changes of sag against a reference that follows slowly while laser and gauge agree."""

    follow_s: float
    limit_um: float
    laser_um: float = math.nan
    trim_um: float = 0.0
    root: float = math.nan

    def apart(self, laser_um: float, trim_um: float, root: float, sag_um: float, dt_s: float) -> str:
        """What the two have seen, if it cannot both be true; `root` is the cube root of the gauge pressure."""
        if math.isnan(self.laser_um):
            self.laser_um, self.trim_um, self.root = laser_um, trim_um, root
        by_laser_um, trimmed_um = laser_um - self.laser_um, trim_um - self.trim_um
        by_gauge_um = (sag_um - by_laser_um) * (root / self.root - 1)
        # A laser whose drift the shape loop has taken out has not moved the film.
        apart_um = min(abs(by_laser_um - by_gauge_um), abs(by_laser_um - trimmed_um - by_gauge_um))
        if apart_um > self.limit_um + LAW_SHARE * min(abs(by_laser_um), abs(by_gauge_um)):
            return f"laser {by_laser_um:+.0f} um, gauge {by_gauge_um:+.0f} um"
        share = smoothing(dt_s, self.follow_s)
        self.laser_um += share * by_laser_um
        self.trim_um += share * trimmed_um
        self.root += share * (root - self.root)
        return ""


@dataclass(slots=True)
class LeakGrowth:
    """Whether the film takes far more gas than it used to."""

    _usual: LowPass = field(default_factory=lambda: LowPass(LEAK_REFERENCE_S))
    _flow: LowPass = field(default_factory=lambda: LowPass(FLOW_MEAN_S))
    _still_s: float = 0.0
    _stands_s: float = 0.0

    def reset(self) -> None:
        """Forget what it used to take."""
        self._usual.reset(math.nan)
        self._flow.reset(math.nan)
        self.moves()

    def moves(self) -> None:
        """The setpoint is on its way: the mean holds what the ramp took, with the error of the pump's map."""
        self._still_s = self._stands_s = 0.0

    def step(self, leak_um_per_s: float, flow_um_per_s: float, most: float, dt_s: float) -> str:
        """One tick of a held mirror; what is wrong, if so. NaN for what is not known.

        The leak is the inner loop's estimate, without what the feed-forward adds, and a thermometer that lies shifts
        it; a film that really takes more gas gets more. `most`: times what the film used to take; infinite where a
        camera sees that it stands still.
        """
        if not (math.isfinite(leak_um_per_s) and math.isfinite(flow_um_per_s)):
            return ""
        flow_um_per_s = self._flow.update(flow_um_per_s, dt_s)
        takes_um_per_s = min(leak_um_per_s, flow_um_per_s)
        self._still_s += dt_s
        if self._still_s < LEAK_STANDS_S:
            return ""
        usual_um_per_s = max(self._usual.value, 0.0)
        excess_um_per_s = (most - 1) * max(usual_um_per_s, LEAK_LEAST_UM_PER_S)
        if not takes_um_per_s > usual_um_per_s + excess_um_per_s:
            self._stands_s = 0.0
            # the larger of the two, for a thermometer that lies may shift the estimate down for long
            known = math.isfinite(self._usual.value)
            self._usual.update(max(leak_um_per_s, flow_um_per_s) if known else leak_um_per_s, dt_s)
            return ""
        self._stands_s += dt_s
        if self._stands_s < LEAK_STANDS_S:
            return ""
        return f"the film takes {takes_um_per_s:.1f} um/s of gas, before {usual_um_per_s:.1f} um/s"


class FilmMonitor:
    """Compares laser and gauge on every tick in which the pump may run."""

    def __init__(self, limits: LimitsConfig, mirror: MirrorConfig) -> None:
        self._limits = limits
        self._sag_um, self._pressure_pa = 1e3 * mirror.sag_mm, mirror.pressure_pa
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._laser, self._root = LowPass(SMOOTH_S), LowPass(SMOOTH_S)
        self._seen_s = 0.0
        self._since = (
            _Since(SINCE_MINUTES_S, self._limits.laser_gauge_apart_max_um),
            _Since(SINCE_HOURS_S, self._limits.laser_gauge_drift_max_um),
        )

    @property
    def watching(self) -> bool:
        """It has seen something since the last `reset`."""
        return self._seen_s > 0.0

    def step(self, dt_s: float, laser_um: float, trim_um: float, gauge_pressure_pa: float) -> str:
        """One tick; what laser and gauge have seen, if it does not fit. NaN without a (good) reading.

        `trim_um` is what the shape loop has added to the setpoint: the laser's drift as the camera sees it.
        """
        # Both or none: two means that began their lag together differ by no way that the film goes.
        if not (math.isfinite(laser_um) and math.isfinite(gauge_pressure_pa)):
            return ""
        laser_um = self._laser.update(laser_um, dt_s)
        # A mean of the root goes with the mean of the sag on any way; a mean of the pressure does not.
        root = self._root.update(math.cbrt(gauge_pressure_pa), dt_s)
        self._seen_s += dt_s
        if strange := self._not_nominal(laser_um, root**3):
            return strange
        sag_um = self._sag_um + laser_um
        if self._seen_s < WARM_S or not (self._taut or root**3 > TAUT_PA):
            return ""
        minutes, hours = self._since
        return minutes.apart(laser_um, trim_um, root, sag_um, dt_s) or hours.apart(
            laser_um, trim_um, root, sag_um, dt_s
        )

    @property
    def _taut(self) -> bool:
        """There is a reference: a gauge that falls to nothing from now on is no slack film."""
        return math.isfinite(self._since[0].root)

    def _not_nominal(self, laser_um: float, gauge_pa: float) -> str:
        if self._pressure_pa == 0.0 or self._seen_s < NOMINAL_S:
            return ""
        wanted_pa = self._pressure_pa * max(1 + laser_um / self._sag_um, 0.0) ** 3
        if wanted_pa / NOMINAL_FACTOR - NOMINAL_SLACK_PA <= gauge_pa <= NOMINAL_FACTOR * wanted_pa + NOMINAL_SLACK_PA:
            return ""
        return f"the gauge reads {gauge_pa:.0f} Pa where the sag wants about {wanted_pa:.0f} Pa"
