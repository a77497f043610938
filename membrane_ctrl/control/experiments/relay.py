"""Bounded asymmetric relay about the holding flow.

Asymmetric, because the way down is no faster than the leak and the pump must not stall (its least flow is the lower
end), while the way up has most of the pump. The amplitude starts small and grows while the mirror overshoots its
threshold by little, so that a pump three times stronger or slower than configured stays within the same bounds.
"""

from __future__ import annotations

import math

from membrane_ctrl.control.experiments.machine import COAST_S, Around, Finished, Motion
from membrane_ctrl.control.experiments.measurement import Measurement

THRESHOLD_SHARE = 0.25  # of the excursion limit
OVERSHOOT_SHARE = 0.2
_GROWTH = 1.6
_FIRST_MAX_UM_PER_S = 1.5
_OVERSHOOT_LEAST_UM = 0.2  # smaller ones are noise
# A half cycle of 5 um takes this long where leak + bleed are 0.06 um/s: nothing can be held there.
_PATIENCE_S = 90.0


class Relay:
    """Switches between a high and a low flow whenever the centre leaves a band.

    Parameters
    ----------
    around : Around
    centre_um : float
        Middle of the band.
    duration_s : float
    """

    def __init__(self, around: Around, centre_um: float, duration_s: float = 120.0) -> None:
        self._around = around
        self._centre_um = centre_um
        self._duration_s = duration_s
        self._threshold_um = THRESHOLD_SHARE * around.limit_um
        self._motion = Motion()
        first = min(around.holding_flow_um_per_s, _FIRST_MAX_UM_PER_S)
        self._amplitudes_um_per_s = {1: first, -1: first}
        self._speeds_um_per_s = {1: first, -1: first}
        self._direction = 1
        self._time_s = self._since_switch_s = 0.0
        self._overshoot_um = 0.0
        self._at_centre_s = math.nan
        self.crossings = 0

    def step(self, measurement: Measurement, dt_s: float) -> float | Finished:
        """One tick of the relay."""
        self._motion.update(measurement.displacement_um, dt_s)
        if self._time_s >= self._duration_s:
            return Finished(True, f"{self.crossings} crossings")
        self._time_s += dt_s
        self._since_switch_s += dt_s
        off_um = self._motion.position_um - self._centre_um
        # beyond the threshold on the side it came from, for the delay after a switch
        self._overshoot_um = max(self._overshoot_um, -self._direction * off_um - self._threshold_um)
        if math.isnan(self._at_centre_s) and self._direction * off_um > 0:
            self._at_centre_s = self._time_s
        if self._direction * off_um > self._threshold_um:
            self._switch()
        elif self._since_switch_s > _PATIENCE_S:
            way = "rise" if self._direction > 0 else "sink"
            remedy = "check the pump, its tube and the leak" if self._direction > 0 else "open the bleed"
            return Finished(
                False, f"the mirror did not {way} by {self._threshold_um:g} um in {_PATIENCE_S:g} s: {remedy}"
            )
        around = self._around
        swing = self._direction * self._amplitudes_um_per_s[self._direction]
        return around.within(around.holding_flow_um_per_s + swing)

    def _switch(self) -> None:
        """Turn round; the way before this one, whose overshoot is now known, is made faster or slower."""
        wanted_um = OVERSHOOT_SHARE * self._around.limit_um
        # the guard stops what would coast further than that, however short the true delay
        fastest_um_per_s = wanted_um / COAST_S
        if self._time_s > self._at_centre_s:
            self._speeds_um_per_s[self._direction] = self._threshold_um / (self._time_s - self._at_centre_s)
        if self.crossings > 0:
            before = -self._direction
            factor = min(
                wanted_um / max(self._overshoot_um, _OVERSHOOT_LEAST_UM),
                fastest_um_per_s / self._speeds_um_per_s[before],
            )
            self._amplitudes_um_per_s[before] *= min(max(factor, 1 / _GROWTH), _GROWTH)
        self._direction = -self._direction
        self._overshoot_um = 0.0
        self._since_switch_s = 0.0
        self._at_centre_s = math.nan
        self.crossings += 1
