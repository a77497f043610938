"""Slow changes that lead to a failure, detected early in hourly means. Pure.

leak      mean loss of gas; an opening seam makes it grow until the pump cannot keep up
reserve   the pump's flow in excess of the leak
tight     a mirror that loses too little gas cannot be lowered (control/film_health.py)
creep     at a held sag p J = const (Hencky, J the compliance): as the film gives the pressure falls, dJ/J = -dp/p
"""  # noqa: E501

import math
from collections import deque
from dataclasses import dataclass, field

from membrane_ctrl.control.pump_drift import PumpScale
from membrane_ctrl.model.state_tree import Count, StateNode

# The mirror's loss of gas, from the pump's flow and the motion of the centre.
#
# Balance of gas, as speed of the centre:  dy/dt = v - leak + w,  and the feed-forward is -w as far
# as it is known, so
#
#     leak = mean of (v - feed-forward - dy/dt)
#
# The mean of dy/dt is a difference of two readings: the laser's noise falls with the window, not
# with its root.

# Long compared with the loop (6.5 s), short compared with a leak that somebody opens.
WINDOW_S = 60.0

# Before this the readings' noise and the pump's lag are a tenth of the leak.
FIRST_S = 10.0

# The loop moves the flow by 0.15 µm/s (standard deviation) and the pump's least running flow is 0.3
# µm/s: with less than this to make up for, the pump stops and starts, and in the end the band of 2
# µm is lost
# (docs/explanation/control.md).
TOO_TIGHT_UM_PER_S = 0.4

# A warning stands until the leak is clearly above the limit again.
TOO_TIGHT_END_UM_PER_S = 0.45

# With a shorter mean, weather alone could cause the warning.
JUDGE_S = 30.0

# A reading so far from its filtered value is a jump of film or laser: no gas moves the film so
# fast.
JUMP_UM = 10.0


@dataclass(slots=True)
class LeakEstimate(StateNode):
    """Mean loss of gas (leak and bleed together) over the last minute, or over a shorter record."""

    mean_um_per_s: float = 0.0
    elapsed_s: float = 0.0
    last_um: float = math.nan
    warned: bool = False

    @property
    def leak_um_per_s(self) -> float:
        """Estimate; NaN until there is one, and while nothing is seen."""
        return (
            self.mean_um_per_s
            if self.elapsed_s >= FIRST_S and math.isfinite(self.last_um)
            else math.nan
        )

    @property
    def too_tight(self) -> bool:
        """Whether the mirror loses too little gas to be held within the band."""
        if self.elapsed_s >= JUDGE_S:
            self.warned = self.mean_um_per_s < (
                TOO_TIGHT_END_UM_PER_S if self.warned else TOO_TIGHT_UM_PER_S
            )
        return self.warned

    def update(
        self, pumped_um_per_s: float, displacement_um: float, filtered_um: float, dt_s: float
    ) -> None:
        """Take a step: the flow without the feed-forward's share, and the reading, as read and
        filtered.
        """
        jumps = abs(displacement_um - filtered_um) > JUMP_UM
        if math.isfinite(self.last_um) and not jumps:
            self.take(pumped_um_per_s - (filtered_um - self.last_um) / dt_s, filtered_um, dt_s)
        self.last_um = displacement_um if jumps else filtered_um  # where the filter will be

    def take(self, loss_um_per_s: float, centre_um: float, dt_s: float) -> None:
        """Take a step's loss that is known, and where it ends."""
        self.elapsed_s = min(self.elapsed_s + dt_s, WINDOW_S)
        self.mean_um_per_s += dt_s / self.elapsed_s * (loss_um_per_s - self.mean_um_per_s)
        self.last_um = centre_um

    def pause(self) -> None:
        """Skip a step without a reading."""
        self.last_um = math.nan


HOUR_S = 3600.0
DAY_HOURS = 24
# A day of typical weather moves an hourly mean by a few per cent; growth by half means the seam.
LEAK_GREW = 1.5
# The loop needs room for gusts: below this share of the pump's flow for the leak there is enough.
RESERVE_SHARE = 0.6
# Both films' creep laws give 0.7 % on the first day and 0.15 % on the second; more than this is not
# regular creep.
CREEP_PER_DAY = 0.01
# Warn again only after a clear improvement.
BETTER = 0.9


@dataclass(frozen=True, slots=True)
class Hour(StateNode):
    """Means of an hour of hold."""

    leak_um_per_s: float
    pressure_pa: float


@dataclass(frozen=True, slots=True)
class FilmWarning:
    """A maintenance notice; it no longer applies if it is not `bad`."""

    name: str
    message: str
    bad: bool = True


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
        """The pump in force gives this much from now on."""
        self._flow_max_um_per_s = flow_max_um_per_s

    def step(
        self, dt_s: float, leak_um_per_s: float, gauge_pressure_pa: float
    ) -> tuple[FilmWarning, ...]:
        """Process one tick of a held mirror; at the end of an hour, return new and withdrawn
        warnings.
        """
        if not (math.isfinite(leak_um_per_s) and math.isfinite(gauge_pressure_pa)):
            return ()
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
        return tuple(self._news(hour, memory.first))

    def setpoint_moved(self) -> None:
        """The sag has changed: pressures before and after are not comparable."""
        self.memory.hours.clear()
        self._begin_hour()

    def _begin_hour(self) -> None:
        self.memory.held_s = 0.0
        self.memory.leak_um = 0.0
        self.memory.pressure_pa_s = 0.0

    def _news(self, hour: Hour, first: Hour) -> list[FilmWarning]:
        leak, most = hour.leak_um_per_s, self._flow_max_um_per_s
        creep = self._creep_per_day()
        found = (
            (
                "leak_growth",
                leak / (LEAK_GREW * max(first.leak_um_per_s, TOO_TIGHT_UM_PER_S)),
                self._says_leak(leak),
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
        bad = [name for name, over, _ in found if over > (BETTER if name in warned else 1.0)]
        changed = set(bad) ^ set(warned)
        self.memory.warned = bad
        return [
            FilmWarning(name, says if name in bad else "no longer so", name in bad)
            for name, _, says in found
            if name in changed
        ]

    def _says_leak(self, leak_um_per_s: float) -> str:
        """The leak, and how long the pump can keep up at this growth."""
        hours = self.memory.hours
        days = (len(hours) - 1) / DAY_HOURS
        growth_per_day = (leak_um_per_s - hours[0].leak_um_per_s) / days if days else 0.0
        left = (
            (self._flow_max_um_per_s - leak_um_per_s) / growth_per_day
            if growth_per_day > 0
            else math.inf
        )
        until = f"; the pump keeps up for {left:.1f} days more" if left < 365 else ""
        return f"the leak has grown to {leak_um_per_s:.2f} µm/s{until}: look for an opening seam"

    def _creep_per_day(self) -> float:
        """Creep over up to a day; 0 before six hours, as a shorter trend is noise."""
        kept = self.memory.hours
        hours = len(kept) - 1
        if hours < 6:
            return 0.0
        first, last = kept[0].pressure_pa, kept[-1].pressure_pa
        return (first - last) / first * DAY_HOURS / hours


_PUMP_EVERY = 10  # segments of a minute between reports
_PUMP_SIGMAS = 3.0


@dataclass(slots=True)
class PumpHealthState(StateNode):
    """Segments so far, and whether the warning applies."""

    count: Count = 0
    warned: bool = False


class PumpHealth:
    """Reports what a hold has learned of its pump, and warns once of
    a drift beyond `change_max`.
    """

    def __init__(self, change_max: float, memory: PumpHealthState | None = None) -> None:
        self._change_max = change_max
        self.memory = memory or PumpHealthState()

    def set_pump(self, change_max: float) -> None:
        """Another curve is in force, with this limit of its drift."""
        self._change_max = change_max

    def step(self, known: PumpScale) -> tuple[bool, tuple[FilmWarning, ...]]:
        """Take a segment's estimate; returns whether to report it,
        and a new or withdrawn warning.
        """
        memory = self.memory
        memory.count += 1
        change = known.scale - 1.0
        bad = abs(change) > max(self._change_max, _PUMP_SIGMAS * known.sigma) * (
            BETTER if memory.warned else 1.0
        )
        says = (
            f"the pump gives {100 * abs(change):.0f} % {'less' if change < 0 else 'more'} than "
            "its curve"
        )
        says += f" (+- {100 * known.sigma:.0f} %): check it, then `tune pump`"
        news = (
            (FilmWarning("pump_drift", says if bad else "no longer so", bad),)
            if bad != memory.warned
            else ()
        )
        memory.warned = bad
        return bool(news) or memory.count % _PUMP_EVERY == 0, news
