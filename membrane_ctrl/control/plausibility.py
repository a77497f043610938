"""Laser against optics, with the gauge pressure as arbiter: which of them is wrong? Pure.

All three measure changes of the film's sag: the laser as d, the camera as sag, the gauge as
pressure, which for a Hencky film (w ~ p^(1/3)) is dw = w / (3 p) dp. The gauge is too noisy to
hold a mirror with (0.5 Pa are 10 µm), but its mean over ten seconds is good to about a micrometre,
and does not depend on mounts and cameras.

Temperature and humidity move the film against the gauge. Where sensors show them, the gauge's
change is a range, with what they explain (`climate_allowance`); it decides only where the whole
range does.

Changes are compared with references that follow slowly while all agree, so that slow drift (a
laser's mount, a gauge's zero, creep) does not count as a contradiction; the shape loop corrects
it.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.control.climate import StrainParts
from membrane_ctrl.control.climate_allowance import (
    ClimateAllowance,
    StrainAhead,
    find_distance,
    find_gain,
)
from membrane_ctrl.control.film_monitor import NO_STRAINS, SMOOTH_S, are_means_known
from membrane_ctrl.control.filters import LowPass, lag_step_fraction
from membrane_ctrl.model.events import FaultySensor
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode

# A laser's mount at 2 µm/min is then 4 µm ahead of its reference: less than the limit of 10 µm.
REFERENCE_S = 120.0
# The second reference finds optics that drift by 0.034 µm/s or more: 20 µm ahead of it. Climate
# moves the gauge by at most 0.028 µm/s (see SINCE_HOUR_S), 17 µm ahead of it; in the usual phase 13
# µm, less than the 2/3 of 20 µm with which a gauge that climate moves would side with the wrong
# one.
SLOW_REFERENCE_S = 600.0
# Of the limit between laser and optics.
SLOW_SHARE = 2.0
# The gauge must be nearer to one of them by this factor to decide.
CLEARER = 2.0
# A laser without a reading for this long is not compared; its mean then begins with its next
# reading.
LASER_GAP_S = 2.0
_NO_GAIN = StrainParts(0.0, 0.0, 0.0)
# While the film moves, optics lag behind the laser by a figure or a cycle; the speed is a mean over
# this.
SPEED_S = 2.0


@dataclass(frozen=True, slots=True)
class SagChanges(StateNode):
    """Changes of sag since the reference, as seen by the three, µm."""

    laser_um: float
    optics_um: float
    gauge_um: float
    # Range of what the climate adds to the gauge's change; 0 is in it
    climate_low_um: float = 0.0
    climate_high_um: float = 0.0

    def __str__(self) -> str:
        """Format the changes as one line."""
        return (
            f"laser {self.laser_um:+.1f} µm, camera {self.optics_um:+.1f} µm, gauge "
            f"{self.gauge_um:+.1f} µm"
        )

    def judge(self) -> FaultySensor:
        """Which of laser and optics the gauge contradicts: it must be clearly nearer to the other
        one.
        """
        climate_um = (self.climate_low_um, self.climate_high_um)
        to_laser_um = find_distance(self.laser_um - self.gauge_um, climate_um)
        to_optics_um = find_distance(self.optics_um - self.gauge_um, climate_um)
        # A range that reaches between them is not clear; a single value is judged by the factor
        least_um = abs(self.laser_um - self.optics_um) / CLEARER
        if max(to_laser_um, to_optics_um) < least_um:
            return FaultySensor.UNKNOWN
        if to_optics_um * CLEARER < to_laser_um:
            return FaultySensor.LASER
        if to_laser_um * CLEARER < to_optics_um:
            return FaultySensor.OPTICS
        return FaultySensor.UNKNOWN


@dataclass(slots=True)
class ReferenceMeans(StateNode):
    """Means of laser, optics and gauge that follow the present ones
    while laser and optics agree.
    """

    laser_um: float = math.nan
    optics_um: float = math.nan
    gauge_pa: float = math.nan
    strain: StrainAhead = field(default_factory=StrainAhead)

    @property
    def known(self) -> bool:
        """Whether there is one."""
        return math.isfinite(self.laser_um)

    def begin(self, means: tuple[float, float, float]) -> None:
        """Place it at the present means of laser (µm), optics (µm) and gauge (Pa)."""
        self.laser_um, self.optics_um, self.gauge_pa = means
        self.strain = StrainAhead()

    def note_strains(self, gained: StrainParts) -> None:
        """Note what the strains of film and ring have gained since the last tick."""
        self.strain.follow(gained, 0.0, math.inf)

    def follow(
        self, means: tuple[float, float, float], dt_s: float, time_constant_s: float
    ) -> None:
        """Move the reference towards the present means.

        Parameters
        ----------
        means : (float, float, float)
            Of laser in µm, optics in µm and gauge in Pa.
        dt_s : float
            Time since the last tick.
        time_constant_s : float
            In which it follows.
        """
        share = lag_step_fraction(dt_s, time_constant_s)
        self.laser_um += share * (means[0] - self.laser_um)
        self.optics_um += share * (means[1] - self.optics_um)
        self.gauge_pa += share * (means[2] - self.gauge_pa)
        self.strain.follow(_NO_GAIN, dt_s, time_constant_s)

    def changes(
        self,
        means: tuple[float, float, float],
        sag_um: float,
        allowance: ClimateAllowance | None = None,
    ) -> SagChanges:
        """Return the changes of sag since the reference.

        The gauge's follows by Hencky's law: the sag goes with the cube root of the pressure.

        Parameters
        ----------
        means : (float, float, float)
            The present ones of laser in µm, optics in µm and gauge in Pa.
        sag_um : float
            Sag of the mirror at displacement 0.
        allowance : ClimateAllowance, optional
            What the climate may add to the gauge's change.
        """
        gauge_um = (sag_um + self.laser_um) * (math.cbrt(means[2] / self.gauge_pa) - 1)
        climate_um = (0.0, 0.0)
        if allowance is not None:
            climate_um = allowance.find_range(self.strain)
        return SagChanges(
            means[0] - self.laser_um, means[1] - self.optics_um, gauge_um, *climate_um
        )


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
    faulty: FaultySensor = FaultySensor.NONE
    strains: StrainParts = NO_STRAINS  # as noted
    compared_strains: StrainParts = NO_STRAINS  # at the last comparison
    changes: SagChanges = SagChanges(math.nan, math.nan, math.nan)


class PlausibilityCheck:
    """Judges on every tick, also while the film moves; NONE without a camera, as two sensors can
    only disagree.

    Laser and camera may be `limit_um` apart (`shape.disagreement_max_um`) within minutes, and
    `SLOW_SHARE` times as much within a quarter of an hour; there only the camera is found wrong,
    for a laser's mount that drifts so slowly is what the camera corrects. `changes` are NaN until
    there is a reference.

    Parameters
    ----------
    limit_um : float
        How far laser and camera may be from each other, see above.
    sag_um : float
        Of the mirror at displacement 0, by which a change of pressure is a change of sag.
    figure_lag_s : float
        By how much a figure may be older than the laser's reading of the same tick.
    memory : PlausibilityState, optional
        From the snapshot of an earlier controller; else nothing has been compared yet.
    allowance : ClimateAllowance, optional
        What the climate may add to a change by the gauge; nothing without it.
    """

    def __init__(
        self,
        limit_um: float,
        sag_um: float,
        figure_lag_s: float = 0.0,
        memory: PlausibilityState | None = None,
        allowance: ClimateAllowance | None = None,
    ) -> None:
        self._allowance = allowance
        self._limit_um = limit_um
        self._sag_um = sag_um
        self._figure_lag_s = figure_lag_s
        self._slow_limit_um = SLOW_SHARE * limit_um
        self.memory = memory or PlausibilityState()

    @property
    def faulty(self) -> FaultySensor:
        """The verdict."""
        return self.memory.faulty

    @property
    def changes(self) -> SagChanges:
        """Changes of sag by which it was reached."""
        return self.memory.changes

    def reset(self) -> None:
        """Forget everything: the mirror is not held."""
        self.memory.start_afresh()

    def rebase(self) -> None:
        """Compare from the present readings on: the sensor that was found wrong is used again in
        its new place.
        """
        memory = self.memory
        self._end_laser_lag()
        means = (memory.laser.value, memory.optics.value, memory.gauge.value)
        if not all(map(math.isfinite, means)):
            self.reset()
            return
        memory.fast.begin(means)
        memory.slow.begin(means)
        self._clear_verdict()

    def _end_laser_lag(self) -> None:
        """Move the laser's mean to where the laser is.

        Half a minute after a knock of 300 µm the mean is still 15 µm behind, more than the limit.
        """
        memory = self.memory
        # A distance that decays with SMOOTH_S appears larger behind the lag of the speed
        lag_um = (SMOOTH_S - SPEED_S) * memory.speed_um_per_s.value
        if math.isfinite(lag_um):
            memory.laser.value += lag_um
            memory.speed_um_per_s.reset(0.0)

    def _clear_verdict(self) -> None:
        self.memory.faulty = FaultySensor.NONE
        self.memory.slow_wrong = False

    @property
    def watching(self) -> bool:
        """Whether it has had readings since the last `reset`."""
        return math.isfinite(self.memory.laser.value)

    @property
    def judges(self) -> bool:
        """Whether it can distinguish a moved laser from a moved film."""
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
    ) -> FaultySensor:
        """Process one tick of a held mirror, and return the sensor that two others contradict.

        Parameters
        ----------
        dt_s : float
            Since the last tick.
        displacement_um, gauge_pa : float
            Readings of laser and gauge; NaN without a good one.
        estimate : ShapeEstimate or None
            Only in its tick of arrival.
        blind : bool
            The last figure is old: a camera that saw nothing of a motion is not blamed for it.
        """
        memory = self.memory
        # 1. One smoothed mean for each sensor; a figure counts over the time since the last one
        self._average_laser(displacement_um, dt_s)
        if math.isfinite(gauge_pa):
            memory.gauge.update(gauge_pa, dt_s, SMOOTH_S)
        if (
            estimate is not None
            and estimate.verdict != "rejected"
            and math.isfinite(estimate.sag_um)
        ):
            since_s = 0.0
            if not math.isnan(memory.figure_s):
                since_s = estimate.time_s - memory.figure_s
            memory.optics.update(estimate.sag_um, max(since_s, 0.0), SMOOTH_S)
            memory.figure_s = estimate.time_s
        # 2. Judged while all three are there
        means = (memory.laser.value, memory.optics.value, memory.gauge.value)
        laser_present = memory.laser_gap_s <= LASER_GAP_S
        if laser_present and not blind and all(map(math.isfinite, means)):
            memory.age_s += dt_s
            memory.readings += 1
            self._judge_means(means, dt_s)
        return memory.faulty

    def note_strains(self, strains: StrainParts) -> None:
        """Note the strains of film and ring, as the climate's sensors show them in this tick."""
        self.memory.strains = strains

    def _average_laser(self, displacement_um: float, dt_s: float) -> None:
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

    def _judge_means(self, means: tuple[float, float, float], dt_s: float) -> None:
        """Compare the three means with their references, which follow while no sensor is found
        wrong.
        """
        memory = self.memory
        if not are_means_known(memory.age_s, memory.readings):
            return
        gained = find_gain(memory.strains, memory.compared_strains)
        memory.compared_strains = memory.strains
        for reference in (memory.fast, memory.slow):
            reference.note_strains(gained)
            if not reference.known:
                reference.begin(means)
        if memory.faulty in (FaultySensor.LASER, FaultySensor.OPTICS):
            # The verdict stands until the two clearly agree again: a drifting gauge must not accuse
            # the other.
            judged = memory.slow if memory.slow_wrong else memory.fast
            if memory.slow_wrong:
                limit_um = self._slow_limit_um
            else:
                limit_um = self._limit_um
            memory.changes = changes = judged.changes(means, self._sag_um, self._allowance)
            if abs(changes.laser_um - changes.optics_um) <= limit_um / 2 + self._lag_um:
                self._clear_verdict()
        else:
            self._judge_fast(means)
            if memory.faulty == FaultySensor.NONE:
                self._judge_slowly(means)
        if memory.faulty == FaultySensor.NONE:
            memory.fast.follow(means, dt_s, REFERENCE_S)
            memory.slow.follow(means, dt_s, SLOW_REFERENCE_S)

    def _judge_fast(self, means: tuple[float, float, float]) -> None:
        memory = self.memory
        memory.changes = changes = memory.fast.changes(means, self._sag_um, self._allowance)
        # and back only when clearly so
        if memory.faulty == FaultySensor.NONE:
            limit_um = self._limit_um
        else:
            limit_um = self._limit_um / 2
        agree = abs(changes.laser_um - changes.optics_um) <= limit_um + self._lag_um
        memory.faulty = FaultySensor.NONE if agree else changes.judge()

    def _judge_slowly(self, means: tuple[float, float, float]) -> None:
        """Find a camera that drifts slowly; a laser's slow drift is its mount's,
        and is corrected.
        """
        memory = self.memory
        changes = memory.slow.changes(means, self._sag_um, self._allowance)
        apart = abs(changes.laser_um - changes.optics_um) > self._slow_limit_um + self._lag_um
        if apart and changes.judge() == FaultySensor.OPTICS:
            memory.faulty = FaultySensor.OPTICS
            memory.changes = changes
            memory.slow_wrong = True
