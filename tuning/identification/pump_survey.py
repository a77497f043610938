"""Which commands to give next, until the pump's curve is known.

A round is a minute or two of short runs, each from below the centre to above it or back; the hold
between two rounds brings the mirror back. What is known so far determines how long a command may
last. Levels are added where the curve bends or jumps, and repeated until they are known.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from membrane_ctrl.control.experiments.spec import PumpStep
from membrane_ctrl.control.pump_curve import STALL_MARGIN
from membrane_ctrl.model.arrays import FloatArray
from tuning.identification.curve_shape import (
    JUMP_SHARE,
    NO_BRANCH,
    Branch,
    find_first_jump,
    limit_bend,
    smooth_flows,
)
from tuning.identification.pump_fit import NO_FIT, PumpFit, fit_pump
from tuning.identification.pump_map import PumpMap, Surveyed, is_stuck
from tuning.identification.pump_run import Level, PumpRun

_KNOWN_SHARE = 0.009  # standard error of a level, of the full flow
_BENT_SHARE = 0.02  # of the full flow, by which a kink between two levels may be hidden
# Likewise of the leak, in flows up to so many leaks: the loop's gain there is the slope of the
# curve
_BENT_LEAKS = 0.15
_ABOUT_LEAKS = 2.0
_SURE = 3.0
_PLAY_SHARE = 0.03  # hysteresis that is worth a second branch
# commands between which a jump lies; levels for a bend
_EDGE = 0.02
_NEAREST = 0.04
# a jump to more than this share of the leak may be a steep rise through it
_FINE_EDGE = 0.002
_TOO_MUCH = 0.6
_MOST_ROUNDS = 40
_MOST_S = 1500.0
_ROUND_S = 120.0
# Of a survey, with the holds between its rounds and the check of the curve: the median of drawn
# pumps, and gusts or a laser of 1 µm
TYPICAL_S = 900.0
LONGEST_S = 2100.0
_LEAST_S = 1.5  # of a run
_DARK_S = 15.0  # a longer run has shown something before its reading was lost
_TRAVEL_UM = 6.0  # of a run, in an excursion limit of 10
_HIGHEST = 0.25  # of the limit, where a run begins at most
# of the limit; the rest is for gusts, and for the noise that the guard keeps in hand
_CAUGHT = 0.55
_SHARE_LEAST = 0.4  # of the travel: shorter runs see little but noise, and gusts stop them as well
_NONE_UM_PER_S = 1e-3  # at command 0
_SHORTEST_S = 0.05
_PULSE_S = 0.2
_LONGEST_S = 20.0
_MOST_VISITS = 6
_ABOVE = 0.15
_SCOUTS = (0.25, 0.5, 0.75, 1.0)
# rounds without any flow; share of the limit at most, by a first pulse
_FIRST_ROUNDS = 5
_FIRST_RISE = 0.2
_FIRST_PULSES_S = (0.3, 0.6, 1.2, 2.4, 2.4, 2.4, 2.4)


@dataclass
class PumpSurvey:
    """The rounds of a survey, as a step machine: `steps` to give, `add_run` what came of them.

    Attributes
    ----------
    holding_fraction : float
        Command that about holds the mirror.
    limit_um, laser_um : float
        Excursion limit of an experiment; standard deviation of a reading.
    """

    holding_fraction: float
    limit_um: float = 10.0
    laser_um: float = 0.5
    runs: list[PumpRun] = field(default_factory=list)
    fit: PumpFit = NO_FIT
    dark: int = 0  # the latest runs that were short and ended without a reading
    _share: float = 1.0  # of the travel, smaller after a run that was stopped
    _longer: float = 1.0  # the first pulses, while no flow is known
    _rounds: int = 0
    _wanted: set[Level] = field(default_factory=set)
    _branches: dict[bool, Branch] = field(default_factory=dict)

    @property
    def duration_s(self) -> float:
        """Of all experiments so far."""
        return sum(run.dt_s * run.fraction.size for run in self.runs)

    def add_run(self, run: PumpRun, completed: bool) -> None:
        """Learn from a run; one that its guard stopped counts as well, and the next ones go less
        far.
        """
        self._rounds += 1
        if not self._lacks_flows:
            self._share = float(
                np.clip(self._share * (1.2 if completed else 0.8), _SHARE_LEAST, 1.0)
            )
        elif (
            not completed
        ):  # a weak pump sinks between short pulses; a strong one rises too far in long ones
            self._longer *= 2.0 if run.has_sunk else 0.5
        if run.fraction.size * run.dt_s > _LEAST_S:
            self.runs.append(run)
        is_short = run.fraction.size * run.dt_s < _DARK_S
        is_dark = is_short and bool(np.isnan(run.displacement_um[-1:]).any())
        self.dark = self.dark + 1 if is_dark else 0
        if self.runs:
            self.fit = fit_pump(
                self.runs, self.fit if self._rounds > 3 and self.fit.levels else None
            )
            self._branches = {rising: self._make_branch(rising) for rising in (True, False)}

    def steps(self) -> tuple[PumpStep, ...]:
        """The next round; empty when the curve is known, or cannot be known better in the time."""
        if self._rounds >= _MOST_ROUNDS or self.duration_s > _MOST_S:
            return ()
        if self._lacks_flows:
            hopeless = is_stuck(self.fit, self._branches.get(True, NO_BRANCH))
            if self._rounds >= (1 if hopeless else 3) * _FIRST_ROUNDS:
                return ()
            first = min(1.0, self.holding_fraction + 0.1 * (1 + self._rounds % _FIRST_ROUNDS))
            rise_um = min(
                max(1.0, 1.5 * self.laser_um), _FIRST_RISE * self.limit_um
            )  # shows in the noise
            # after a round that sank, at once: it sinks further until the first gas arrives
            down = [_make_step(0.0, 20.0, -1.5 * rise_um)] if self._longer <= 1.0 else []
            lengths_s = np.clip(
                self._longer * np.array(_FIRST_PULSES_S), _SHORTEST_S, _LONGEST_S
            ).tolist()
            pulses = (
                (*down, _make_step(first, longest_s, rise_um), _make_step(0.0, 0.5))
                for longest_s in lengths_s
            )
            return tuple(step for pulse in pulses for step in pulse)
        self._add_levels()
        made: list[PumpStep] = []
        left_s = _ROUND_S
        for level in self._plan_visits():
            visit = self._plan_visit(level)
            left_s -= self._lasts_s(level)
            if made and (left_s < 0 or len(made) + len(visit) > 90):
                break
            made += visit
        return tuple(made)

    @property
    def full_um_per_s(self) -> float:
        """The largest flow seen for certain; a level that was only
        passed through may look strong.
        """
        return max(
            [1e-3, *(float((at.flows - 2 * at.sigmas).max()) for at in self._branches.values())]
        )

    @property
    def holding(self) -> float:
        """The command that balances the leak, once there is one above and one below it."""
        fractions, flows = self._list_known_flows()
        leak = self.fit.leak_um_per_s
        between = flows.size > 0 and flows[0] <= leak < flows[-1]
        return float(np.interp(leak, flows, fractions)) if between else self.holding_fraction

    def is_known(self, level: Level) -> bool:
        """Whether its flow is known well enough."""
        return self.flow_sigma(level) <= _KNOWN_SHARE * self.full_um_per_s

    def flow_sigma(self, level: Level) -> float:
        """Standard error of its flow in µm/s, with what its neighbours tell; infinite for one not
        visited.
        """
        branch = self._branches[level.rising]
        at = np.flatnonzero(branch.fractions == level.fraction)
        return float(branch.sigmas[at[0]]) if at.size else math.inf

    def _make_branch(self, rising: bool) -> Branch:
        """One branch, from no flow at command 0; its flows never fall, and are as smooth as they
        look.
        """
        from scipy.optimize import isotonic_regression

        visits = [
            level in self._wanted or not self._wanted for level in self.fit.levels
        ]  # not just passed through
        own = [i for i, level in enumerate(self.fit.levels) if level.rising == rising and visits[i]]
        levels = list(self.fit.levels.items())
        at = [(levels[i][0].fraction, levels[i][1].flow_um_per_s) for i in own]
        fractions, flows = np.array([(0.0, 0.0), *at]).T
        noise = np.zeros((fractions.size,) * 2)
        noise[0, 0] = _NONE_UM_PER_S**2
        noise[1:, 1:] = self.fit.covariance[np.ix_(own, own)]
        flows, noise = smooth_flows(fractions, flows, noise)
        sigmas = np.sqrt(np.maximum(np.diag(noise), 0.0))
        return Branch(fractions, np.asarray(isotonic_regression(np.maximum(flows, 0.0)).x), sigmas)

    def find_start(self) -> tuple[float, float] | None:
        """The command at which a standing pump starts with a flow at once, and the one below it, if
        it does.
        """
        return find_first_jump(self._branches[True], self.full_um_per_s)

    def hysteretic(self) -> bool:
        """A level gives more when it is reached from above, beyond doubt."""
        start = self.find_start()
        for level, above in self.fit.levels.items():
            below = self.fit.levels.get(Level(level.fraction))
            if level.rising or below is None or (start is not None and level.fraction < start[1]):
                continue
            more = above.flow_um_per_s - below.flow_um_per_s
            sigma = math.hypot(above.sigma_um_per_s, below.sigma_um_per_s)
            if more > max(3 * sigma, _PLAY_SHARE * self.full_um_per_s):
                return True
        return False

    def _add_levels(self) -> None:
        """Add levels: scouts first, then where the curve bends or jumps, then those reached from
        above.
        """
        if not self._wanted:
            low, high = self.holding_fraction, min(level.fraction for level in self.fit.levels)
            self._wanted |= {
                Level(_round_fraction(high + share * (1 - high))) for share in _SCOUTS
            } | {Level(high)}
            self._wanted |= {Level(_round_fraction(low * share)) for share in _SCOUTS}
        seen = all(level in self.fit.levels for level in self._wanted if self._is_reachable(level))
        if seen:
            self._wanted |= {Level(f) for f in self._list_finer_fractions(True)}
        if any(not level.rising for level in self._wanted):
            self._wanted |= {Level(f, False) for f in self._list_finer_fractions(False)}
        if seen:
            self._wanted |= {Level(f, False) for f in self._from_above()}

    @property
    def is_complete(self) -> bool:
        """Every level wanted so far is known."""
        return all(self.is_known(level) for level in self._wanted if self._is_reachable(level))

    def _list_finer_fractions(self, rising: bool) -> list[float]:
        """Commands between those of a branch, where it bends or jumps."""
        fractions, flows, sigmas = self._branches[rising].columns
        full = self.full_um_per_s
        found: list[float] = []
        for i, (low, high) in enumerate(pairwise(fractions.tolist())):
            clear = flows[i + 1] - flows[i] > 4 * math.hypot(sigmas[i], sigmas[i + 1])
            least = float(
                np.interp(high + STALL_MARGIN, fractions, flows)
            )  # that a loop would give
            edge = _FINE_EDGE if least > _TOO_MUCH * self.fit.leak_um_per_s else _EDGE
            if (
                clear
                and flows[i] < 0.02 * full
                and flows[i + 1] > JUMP_SHARE * full
                and high - low > edge
            ):
                found.append(_round_fraction((low + high) / 2))
        if not rising:
            return found
        leak_um_per_s = self.fit.leak_um_per_s
        for i, off in enumerate(limit_bend(fractions, flows).tolist()):
            low, high = fractions[i : i + 2].tolist()
            about = flows[i] < _ABOUT_LEAKS * leak_um_per_s < _ABOUT_LEAKS**2 * flows[i + 1]
            sure = off > _SURE * math.hypot(sigmas[i], sigmas[i + 1])
            here = about and sure and off > _BENT_LEAKS * leak_um_per_s and high - low > _EDGE
            if here or (off > _BENT_SHARE * full and high - low > _NEAREST):
                found.append(_round_fraction((low + high) / 2))
        return found

    def _from_above(self) -> list[float]:
        """Commands to reach from above: two for hysteresis, all if there is any; below the start
        for the stall.
        """
        fractions, flows, _ = self._branches[True].columns
        reached = np.array([f for f in fractions.tolist() if self._is_reachable(Level(f))])
        found = [
            float(reached[np.argmin(np.abs(flows[: reached.size] - s * self.full_um_per_s))])
            for s in (0.3, 0.6)
        ]
        start = self.find_start()
        if start is not None:
            found += [_round_fraction(start[1] / 2), start[1]]
        if self.hysteretic():
            found += reached[1:-1].tolist()
        return [f for f in found if f > 0]

    def _plan_visits(self) -> list[Level]:
        """Levels to visit in the next round: new ones once, small ones first, then others as often
        as they ask for.

        A round reaches only the first of them. Where the leak's error keeps every level from being
        known, those with the largest error of their own must be among them.
        """
        wanted = sorted(level for level in self._wanted if self._is_reachable(level))
        fresh = [level for level in wanted if level not in self.fit.levels]
        wide = max(_KNOWN_SHARE * self.full_um_per_s, 1e-3)
        worst = sorted(
            (level for level in wanted if level not in fresh), key=self.flow_sigma, reverse=True
        )
        visits = [3 * (self.flow_sigma(level) / wide) ** 2 for level in worst]
        again = [
            level
            for turn in range(_MOST_VISITS)
            for level, n in zip(worst, visits, strict=True)
            if n > max(turn, 3)
        ]
        return fresh + again

    @property
    def _lacks_flows(self) -> bool:
        """No flow is known, or, in the rounds of the first pulses, none that lifts the mirror."""
        flows = self._list_known_flows()[1]
        return not flows.any() or (
            self._rounds < 3 * _FIRST_ROUNDS and flows.max() <= self.fit.leak_um_per_s
        )

    def _list_known_flows(self) -> tuple[FloatArray, FloatArray]:
        """Commands whose flows are known to a third, and the flows."""
        if not self.runs:
            return np.empty(0), np.empty(0)
        fractions, flows, sigmas = self._branches[True].columns
        sure = (sigmas < 0.3 * np.maximum(flows, 0.3 * self.fit.leak_um_per_s)) & (fractions > 0)
        return fractions[sure], flows[sure]

    def _guess_flow(self, fraction: float) -> float:
        """Flow that a command may have, rather too large: beyond the largest known one like a
        square.
        """
        fractions, flows = (np.append(0.0, column) for column in self._list_known_flows())
        if fraction <= fractions[-1] or not flows[-1]:
            return float(np.interp(fraction, fractions, flows))
        none = float(fractions[flows < 0.02 * flows[-1]].max(initial=0.0))
        return float(1.3 * flows[-1] * ((fraction - none) / (fractions[-1] - none)) ** 2)

    def _least_flow(self, fraction: float) -> float:
        """Flow that a command has at least: that of the largest smaller one that is known."""
        fractions, flows = (np.append(0.0, column) for column in self._list_known_flows())
        return float(flows[fractions <= fraction][-1])

    def _plan_visit(self, level: Level) -> list[PumpStep]:
        """From where the mirror may be to the level's run, and until its gas has arrived."""
        leak, travel_um, up = (
            max(self.fit.leak_um_per_s, 0.05),
            self._travel_um,
            self._lifting_fraction(),
        )
        run = _make_step(level.fraction, self._run_s(level))
        up_s = (
            60.0 if self._least_flow(up) > leak else _FIRST_PULSES_S[-1]
        )  # what an unknown command gives is not awaited
        if self._net_flow(level) > 0:
            late_s = self.fit.delay_s + self.fit.lag_s
            late_um, caught_um = (
                leak * late_s,
                _CAUGHT * self._share * self.limit_um,
            )  # sinks before an answer
            bottom_um = -0.5 * travel_um - min(1.0, 0.1 * self._net_flow(level))
            above = [] if level.rising else [_make_step(self._higher_fraction(level), 0.1)]
            # where nothing is known to lift it meanwhile it begins higher, so that its gas can be
            # awaited
            sinks_um = late_um + (leak - self._least_flow(level.fraction)) * run.duration_s
            least_um = min(bottom_um + late_um, 0.0)
            start_um = max(least_um, min(sinks_um - caught_um, _HIGHEST * self.limit_um))
            first = [
                _make_step(up, up_s, bottom_um + start_um - least_um - 0.5),
                _make_step(0.0, 60.0, start_um),
            ]
            wait = [_make_step(0.0, max(0.1, late_s))] if start_um >= sinks_um - caught_um else []
            # a short run lifts it less than the leak takes meanwhile: the hold must catch it within
            # the limit
            until_um = min(late_um - caught_um, 0.0)
            wait.append(_make_step(0.0, max(0.3, self.fit.answer_s - late_s * len(wait)), until_um))
            return [*first, *above, run, *wait]
        lifts_um = max(self._net_flow(Level(up)), 0.0) * self.fit.answer_s
        top_um = max(0.5 * travel_um - lifts_um, -0.2 * travel_um)
        pause = [_make_step(0.0, 0.3)] if level.rising else []
        return [_make_step(0.0, 60.0, 0.5 * travel_um), _make_step(up, up_s, top_um), *pause, run]

    @property
    def _travel_um(self) -> float:
        return _TRAVEL_UM * self._share * self.limit_um / 10.0

    def _net_flow(self, level: Level) -> float:
        return self._guess_flow(level.fraction) - self.fit.leak_um_per_s

    def _is_reachable(self, level: Level) -> bool:
        """The shortest pulse of it leaves the mirror within its limit."""
        return self._net_flow(level) * _PULSE_S <= 1.3 * self.limit_um

    def _run_s(self, level: Level) -> float:
        fresh, net = level not in self.fit.levels, self._net_flow(level)
        longest_s, way_um = _LONGEST_S, self._travel_um
        if fresh:
            sinks_um_per_s = self.fit.leak_um_per_s - self._least_flow(
                level.fraction
            )  # the guess may be wrong
            longest_s = min(
                longest_s, way_um * (0.5 if net > 0 else 1.5) / max(sinks_um_per_s, 1e-3)
            )
            way_um *= 0.6
        return max(min(way_um / max(abs(net), 0.05), longest_s), _PULSE_S)

    def _lasts_s(self, level: Level) -> float:
        leak = max(self.fit.leak_um_per_s, 0.05)
        return (
            self._run_s(level) * (1 + max(self._net_flow(level), 0.0) / leak)
            + self.fit.answer_s
            + self._travel_um / leak
        )

    def _higher_fraction(self, level: Level) -> float:
        """A larger command, from which a level is reached: beyond any hysteresis."""
        return min(1.0, level.fraction + _ABOVE)

    def make_map(self, held: bool = True) -> PumpMap:
        """The curve. Raises ValueError, with what to check, if there is none to hold a mirror with.

        `held`: the hold brought the mirror back after the last round.
        """
        return Surveyed(
            self.fit,
            self._branches.get(True, NO_BRANCH),
            self._branches.get(False, NO_BRANCH),
            self.full_um_per_s,
            bool(self._branches) and self.hysteretic(),
            self.duration_s,
            self.is_complete,
            self.limit_um,
            held,
        ).map()

    def _lifting_fraction(self) -> float:
        """The smallest known command that lifts the mirror well; if none does,
        the first that may.
        """
        fractions, flows, sigmas = self._branches[True].columns
        lifts = fractions[flows - 2 * sigmas > 1.5 * self.fit.leak_um_per_s]
        if lifts.size:
            return float(lifts[0])
        may = (_round_fraction(f) for f in np.linspace(fractions[-1], 1.0, 9).tolist())
        return next((f for f in may if self._net_flow(Level(f)) > self.fit.leak_um_per_s), 1.0)


def _make_step(fraction: float, duration_s: float, until_um: float | None = None) -> PumpStep:
    return PumpStep(fraction=fraction, duration_s=duration_s, until_um=until_um)


def _round_fraction(fraction: float) -> float:
    return round(fraction, 3)
