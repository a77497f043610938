"""Slow changes of the film that lead to a failure, detected early in hourly means. Pure.

leak      mean loss of gas; an opening seam makes it grow until the pump cannot keep up
reserve   the pump's flow in excess of the leak
tight     a mirror that loses too little gas cannot be lowered (control/leak_estimate.py)
creep     at a held sag p J = const (Hencky, J the compliance): as the film gives, the pressure
          falls, dJ/J = -dp/p
"""

import math
from collections import deque
from dataclasses import dataclass, field

from membrane_ctrl.control.leak_estimate import TOO_TIGHT_UM_PER_S
from membrane_ctrl.control.maintenance_notice import WITHDRAWN_BELOW, MaintenanceNotice
from membrane_ctrl.model.state_tree import StateNode

HOUR_S = 3600.0
DAY_HOURS = 24
# A day of typical weather moves an hourly mean by a few per cent; growth by half means the seam.
LEAK_GREW = 1.5
# The loop needs room for gusts: below this share of the pump's flow for the leak there is enough.
RESERVE_SHARE = 0.6
# Both films' creep laws give 0.7 % on the first day and 0.15 % on the second; more than this is not
# regular creep.
CREEP_PER_DAY = 0.01


@dataclass(frozen=True, slots=True)
class Hour(StateNode):
    """Means of an hour of hold."""

    leak_um_per_s: float
    pressure_pa: float


@dataclass(slots=True)
class FilmHealthState(StateNode):
    """The hours of a held mirror, and the sums of the open one."""

    hours: deque[Hour] = field(default_factory=deque)  # of the last day
    first: Hour | None = None
    warned: list[str] = field(default_factory=list)  # names of the notices that apply
    held_s: float = 0.0
    leak_um: float = 0.0
    pressure_pa_s: float = 0.0


class FilmHealth:
    """Collects a held mirror's hours and warns once about each deterioration; the pump has
    `flow_max_um_per_s`.
    """

    def __init__(self, flow_max_um_per_s: float, memory: FilmHealthState | None = None) -> None:
        self._flow_max_um_per_s = flow_max_um_per_s
        self.memory = memory or FilmHealthState()

    def set_pump(self, flow_max_um_per_s: float) -> None:
        """Take this as the largest flow of the pump from here on."""
        self._flow_max_um_per_s = flow_max_um_per_s

    def step(
        self, dt_s: float, leak_um_per_s: float, gauge_pressure_pa: float
    ) -> tuple[MaintenanceNotice, ...]:
        """Process one tick of a held mirror.

        Parameters
        ----------
        dt_s : float
            Time since the last tick.
        leak_um_per_s : float
            Estimate of the leak.
        gauge_pressure_pa : float
            NaN without a reading.

        Returns
        -------
        tuple of MaintenanceNotice
            At the end of an hour: new and withdrawn warnings.
        """
        if not (math.isfinite(leak_um_per_s) and math.isfinite(gauge_pressure_pa)):
            return ()
        # Means of an hour; then the hour is compared with the first one and with the day before
        memory = self.memory
        memory.held_s += dt_s
        memory.leak_um += dt_s * leak_um_per_s
        memory.pressure_pa_s += dt_s * gauge_pressure_pa
        if memory.held_s < HOUR_S:
            return ()
        hour = Hour(memory.leak_um / memory.held_s, memory.pressure_pa_s / memory.held_s)
        self._begin_hour()
        memory.hours.append(hour)
        if len(memory.hours) > DAY_HOURS + 1:
            memory.hours.popleft()
        memory.first = memory.first or hour
        return tuple(self._list_changes(hour, memory.first))

    def setpoint_moved(self) -> None:
        """The sag has changed: pressures before and after are not comparable."""
        self.memory.hours.clear()
        self._begin_hour()

    def _begin_hour(self) -> None:
        self.memory.held_s = 0.0
        self.memory.leak_um = 0.0
        self.memory.pressure_pa_s = 0.0

    def _list_changes(self, hour: Hour, first: Hour) -> list[MaintenanceNotice]:
        """Compare an hour with the first one and with the day; returns new and withdrawn
        warnings.
        """
        # Each warning: its name, how far beyond its limit (1 is at the limit), and its sentence
        leak, most = hour.leak_um_per_s, self._flow_max_um_per_s
        creep = self._creep_per_day()
        found = (
            (
                "leak_growth",
                leak / (LEAK_GREW * max(first.leak_um_per_s, TOO_TIGHT_UM_PER_S)),
                self._describe_leak(leak),
            ),
            (
                "pump_reserve",
                leak / (RESERVE_SHARE * most),
                f"the leak takes {100 * leak / most:.0f} % of the pump",
            ),
            (
                "too_tight",
                TOO_TIGHT_UM_PER_S / max(leak, 1e-6),
                f"the mirror loses only {leak:.2f} µm/s: open a bleed (loop.bleed_fraction)",
            ),
            (
                "creep",
                creep / CREEP_PER_DAY,
                f"the film's compliance grows by {100 * creep:.1f} % a day",
            ),
        )
        warned = self.memory.warned
        bad = []
        notices = []
        for name, over, description in found:
            # A warning is withdrawn lower than it is given, so that it does not flicker
            threshold = WITHDRAWN_BELOW if name in warned else 1.0
            is_bad = over > threshold
            if is_bad:
                bad.append(name)
            if is_bad != (name in warned):
                text = description if is_bad else "no longer so"
                notices.append(MaintenanceNotice(name, text, is_bad))
        self.memory.warned = bad
        return notices

    def _describe_leak(self, leak_um_per_s: float) -> str:
        """The leak, and how long the pump can keep up at this growth."""
        hours = self.memory.hours
        days = (len(hours) - 1) / DAY_HOURS
        growth_per_day = 0.0
        if days:
            growth_per_day = (leak_um_per_s - hours[0].leak_um_per_s) / days
        left = math.inf
        if growth_per_day > 0:
            left = (self._flow_max_um_per_s - leak_um_per_s) / growth_per_day
        until = ""
        if left < 365:
            until = f"; the pump keeps up for {left:.1f} days more"
        return f"the leak has grown to {leak_um_per_s:.2f} µm/s{until}: look for an opening seam"

    def _creep_per_day(self) -> float:
        """Creep over up to a day; 0 before six hours, as a shorter trend is noise."""
        kept = self.memory.hours
        hours = len(kept) - 1
        if hours < 6:
            return 0.0
        first, last = kept[0].pressure_pa, kept[-1].pressure_pa
        return (first - last) / first * DAY_HOURS / hours
