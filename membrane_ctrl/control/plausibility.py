"""Laser against optics, with the gauge pressure as arbiter: which one is wrong? Pure.

All three see the sag of the mirror film change: the laser as d, the camera as sag, the gauge as pressure, which for a
Hencky film (w ~ p^(1/3)) is dw = w / (3 p) dp. The gauge is too noisy to hold a mirror with (0.5 Pa are 10 um) but as
a mean over ten seconds it is good to about a micrometre, and knows nothing of mounts and cameras.

Compared are changes against references that follow slowly while all agree, so that what drifts slowly (a laser's
mount, a gauge's zero, creep) is no lie; the shape loop is there for that.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

from membrane_ctrl.control.filters import LowPass, smoothing
from membrane_ctrl.model.shape_estimate import ShapeEstimate

# The gauge's 0.5 Pa per sample are then 0.7 um at 10 Hz, 0.3 um at 50 Hz.
SMOOTH_S = 10.0
# A laser's mount at 2 um/min is then 4 um ahead of its reference: less than the limit of 10 um.
REFERENCE_S = 120.0
# A reference is good once the smoothing has settled.
WARM_S = 3 * SMOOTH_S
# The gauge must be nearer to one of them by this factor to speak.
CLEARER = 2.0


class Liar(IntEnum):
    """Whose story does not fit."""

    NOBODY = 0
    UNSURE = 1
    LASER = 2
    OPTICS = 3


@dataclass(frozen=True, slots=True)
class Changes:
    """Changes of sag since the reference as the three see it, um."""

    laser_um: float
    optics_um: float
    gauge_um: float

    def __str__(self) -> str:
        """For one line."""
        return f"laser {self.laser_um:+.1f} um, camera {self.optics_um:+.1f} um, gauge {self.gauge_um:+.1f} um"


class Plausibility:
    """Judges on every tick; says NOBODY without a camera, for two sensors can only disagree.

    Laser and camera may be `limit_um` apart (`shape.disagreement_max_um`). `changes` are NaN until there is a
    reference.
    """

    def __init__(self, limit_um: float) -> None:
        self._limit_um = limit_um
        self.reset()

    def reset(self) -> None:
        """Forget everything: the mirror is not held."""
        self._laser, self._gauge, self._optics = LowPass(SMOOTH_S), LowPass(SMOOTH_S), LowPass(SMOOTH_S)
        self._reference: tuple[float, float, float] | None = None
        self._age_s = 0.0
        self._seen_s = math.nan
        self.liar = Liar.NOBODY
        self.changes = Changes(math.nan, math.nan, math.nan)

    @property
    def watching(self) -> bool:
        """It has seen something since the last `reset`."""
        return math.isfinite(self._laser.value)

    def step(
        self, dt_s: float, displacement_um: float, gauge_pressure_pa: float, estimate: ShapeEstimate | None
    ) -> Liar:
        """One tick of a held mirror; NaN without a good reading, the estimate in the tick in which it arrives."""
        if math.isfinite(displacement_um):
            self._laser.update(displacement_um, dt_s)
        if math.isfinite(gauge_pressure_pa):
            self._gauge.update(gauge_pressure_pa, dt_s)
        if estimate is not None and estimate.verdict != "rejected" and math.isfinite(estimate.sag_um):
            since_s = SMOOTH_S if math.isnan(self._seen_s) else estimate.time_s - self._seen_s
            self._optics.update(estimate.sag_um, max(since_s, 0.0))
            self._seen_s = estimate.time_s
        means = (self._laser.value, self._optics.value, self._gauge.value)
        if all(map(math.isfinite, means)):
            self._age_s += dt_s
            self._judge(means, dt_s)
        return self.liar

    def _judge(self, means: tuple[float, float, float], dt_s: float) -> None:
        if self._age_s < WARM_S:
            return
        if self._reference is None:
            self._reference = means
        laser, optics, gauge = (mean - reference for mean, reference in zip(means, self._reference, strict=True))
        um_per_pa = self._optics.value / (3 * self._gauge.value)
        self.changes = Changes(laser, optics, um_per_pa * gauge)
        limit_um = self._limit_um if self.liar == Liar.NOBODY else self._limit_um / 2  # and back only when clearly so
        if abs(laser - optics) <= limit_um:
            self.liar = Liar.NOBODY
            follow = smoothing(dt_s, REFERENCE_S)
            a, b, c = (was + follow * (mean - was) for was, mean in zip(self._reference, means, strict=True))
            self._reference = a, b, c
            return
        if self.liar in (Liar.LASER, Liar.OPTICS):
            return  # it stands until the two agree again: a gauge that drifts meanwhile accuses nobody else
        to_laser_um, to_optics_um = abs(self.changes.gauge_um - laser), abs(self.changes.gauge_um - optics)
        if to_optics_um * CLEARER < to_laser_um:
            self.liar = Liar.LASER
        elif to_laser_um * CLEARER < to_optics_um:
            self.liar = Liar.OPTICS
        else:
            self.liar = Liar.UNSURE
