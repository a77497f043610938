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
    Branch,
    find_first_jump,
    limit_bend,
    smooth_flows,
)
from tuning.identification.pump_fit import PumpFit, fit_pump
from tuning.identification.pump_map import PumpMap, Surveyed, is_stuck
from tuning.identification.pump_run import Level, PumpRun

_KNOWN_SHARE = 0.009  # standard error of a level, of the full flow
_BENT_SHARE = 0.02  # of the full flow, by which a kink between two levels may be hidden
# The same of the leak, in flows up to so many leaks: the loop's gain there is the slope of the
# curve.
_BENT_LEAKS = 0.15
_ABOUT_LEAKS = 2.0
_CERTAIN_SIGMAS = 3.0  # of a bend
_CLEAR_SIGMAS = 4.0  # of a rise between two levels
_PLAY_SHARE = 0.03  # hysteresis that is worth a second branch, of the full flow
_PLAY_PROBES = (0.3, 0.6)  # shares of the full flow at which hysteresis is looked for
_NONE_SHARE = 0.02  # a smaller share of the full flow counts as no flow
# Commands closer than these are not divided further: about a jump, and in a bend.
_EDGE = 0.02
_NEAREST = 0.04
# A jump to more than this share of the leak may be a steep rise through it: it is divided finely.
_FINE_EDGE = 0.002
_TOO_MUCH = 0.6
_MOST_ROUNDS = 40
_MOST_S = 1500.0
_ROUND_S = 120.0
_MOST_STEPS = 90  # of a round
# Of a survey, with the holds between its rounds and the check of the curve: the median of drawn
# pumps, and gusts or a laser of 1 µm.
TYPICAL_S = 900.0
LONGEST_S = 2100.0
_LEAST_S = 1.5  # of a run
_DARK_S = 15.0  # a longer run has shown something before its reading was lost
_TRAVEL_UM = 6.0  # of a run, in an excursion limit of 10
_HIGHEST = 0.25  # of the limit, where a run begins at most
# Of the limit; the rest is for gusts, and for the noise that the guard keeps in hand.
_CAUGHT = 0.55
_SHARE_LEAST = 0.4  # of the travel: shorter runs see little but noise, and gusts stop them as well
# Factors on the share of the travel after a run that completed, and after one that was stopped.
_FARTHER = 1.2
_LESS_FAR = 0.8
_NONE_UM_PER_S = 1e-3  # at command 0
_SHORTEST_S = 0.05
_PULSE_S = 0.2
_LONGEST_S = 20.0
_MOST_VISITS = 6
_ABOVE = 0.15  # by how much a command is larger from which a level is reached from above
_SCOUTS = (0.25, 0.5, 0.75, 1.0)  # shares of the range in which the first levels are
# Rounds without any flow; share of the limit that a first pulse rises at most; lengths of the
# pulses of a round.
_FIRST_ROUNDS = 5
_FIRST_RISE = 0.2
_FIRST_PULSES_S = (0.3, 0.6, 1.2, 2.4, 2.4, 2.4, 2.4)
_KNOWN_RATIO = 0.3  # standard error over the flow, up to which it counts as known
_GUESS_FACTOR = 1.3  # of the flow beyond the largest known command: rather too large
_FULL_TIME_S = 60.0  # longest wait for a place
_LEAST_LEAK_UM_PER_S = 0.05


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
    fit: PumpFit = field(default_factory=PumpFit.empty)
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
        """Add a run. One that its guard stopped counts as well, and the next ones go less far.

        Parameters
        ----------
        run : PumpRun
            Commands and readings of one round.
        completed : bool
            Whether the guard let it end.
        """
        self._rounds += 1
        duration_s = run.fraction.size * run.dt_s

        # How far the next runs go; while no flow is known, how long the pulses are. A weak pump
        # sinks between short pulses, a strong one rises too far in long ones.
        if not self._lacks_flows:
            factor = _LESS_FAR
            if completed:
                factor = _FARTHER
            self._share = float(np.clip(self._share * factor, _SHARE_LEAST, 1.0))
        elif not completed:
            if run.has_sunk:
                self._longer *= 2.0
            else:
                self._longer *= 0.5

        if duration_s > _LEAST_S:
            self.runs.append(run)
        lost_reading = bool(np.isnan(run.displacement_um[-1:]).any())
        if duration_s < _DARK_S and lost_reading:
            self.dark += 1
        else:
            self.dark = 0

        # The curve so far; the first fits search from the grid of actuators.
        if self.runs:
            near = None
            if self._rounds > 3 and self.fit.levels:
                near = self.fit
            self.fit = fit_pump(self.runs, near)
            self._branches = {rising: self._make_branch(rising) for rising in (True, False)}

    def steps(self) -> tuple[PumpStep, ...]:
        """The next round; empty when the curve is known, or cannot be known better in the time."""
        if self._rounds >= _MOST_ROUNDS or self.duration_s > _MOST_S:
            return ()
        if self._lacks_flows:
            return self._plan_first_pulses()
        self._add_levels()

        # As many visits as a round has time for, one at least.
        steps: list[PumpStep] = []
        left_s = _ROUND_S
        for level in self._plan_visits():
            visit = self._plan_visit(level)
            left_s -= self._lasts_s(level)
            if steps and (left_s < 0 or len(steps) + len(visit) > _MOST_STEPS):
                break
            steps += visit
        return tuple(steps)

    def _plan_first_pulses(self) -> tuple[PumpStep, ...]:
        """Pulses of growing length at a command that grows from round to round; empty when enough
        rounds have shown no flow.
        """
        most_rounds = 3 * _FIRST_ROUNDS
        if is_stuck(self.fit, self._branches.get(True, Branch.empty())):
            most_rounds = _FIRST_ROUNDS
        if self._rounds >= most_rounds:
            return ()
        stage = 1 + self._rounds % _FIRST_ROUNDS
        fraction = min(1.0, self.holding_fraction + 0.1 * stage)
        visible_um = max(1.0, 1.5 * self.laser_um)
        rise_um = min(visible_um, _FIRST_RISE * self.limit_um)
        lengths_s = np.clip(self._longer * np.array(_FIRST_PULSES_S), _SHORTEST_S, _LONGEST_S)

        steps: list[PumpStep] = []
        for longest_s in lengths_s.tolist():
            # From below; after a round that sank at once, as it sinks further until the first gas
            # arrives.
            if self._longer <= 1.0:
                steps.append(_make_step(0.0, 20.0, -1.5 * rise_um))
            steps.append(_make_step(fraction, longest_s, rise_um))
            steps.append(_make_step(0.0, 0.5))
        return tuple(steps)

    @property
    def full_um_per_s(self) -> float:
        """The largest flow seen for certain; a level that was only passed through may look
        strong.
        """
        flows = [float((at.flows - 2 * at.sigmas).max()) for at in self._branches.values()]
        return max([_NONE_UM_PER_S, *flows])

    @property
    def holding(self) -> float:
        """The command that balances the leak, once there is one above and one below it."""
        fractions, flows = self._list_known_flows()
        leak = self.fit.leak_um_per_s
        if flows.size > 0 and flows[0] <= leak < flows[-1]:
            return float(np.interp(leak, flows, fractions))
        return self.holding_fraction

    def is_known(self, level: Level) -> bool:
        """Whether its flow is known well enough."""
        return self.flow_sigma(level) <= _KNOWN_SHARE * self.full_um_per_s

    def flow_sigma(self, level: Level) -> float:
        """Standard error of its flow in µm/s, by its own runs and its neighbours'; infinite for one
        not visited.
        """
        branch = self._branches[level.rising]
        at = np.flatnonzero(branch.fractions == level.fraction)
        if not at.size:
            return math.inf
        return float(branch.sigmas[at[0]])

    def _make_branch(self, rising: bool) -> Branch:
        """One branch, from no flow at command 0; its flows never fall, and are as smooth as they
        look.
        """
        from scipy.optimize import isotonic_regression

        # The levels of this branch that were visited, and not just passed through.
        own: list[int] = []
        points = [(0.0, 0.0)]
        for number, (level, found) in enumerate(self.fit.levels.items()):
            is_visited = level in self._wanted or not self._wanted
            if level.rising == rising and is_visited:
                own.append(number)
                points.append((level.fraction, found.flow_um_per_s))
        fractions, flows = np.array(points).T

        # Their flows, smoothed; those of command 0 are known.
        noise = np.zeros((fractions.size, fractions.size))
        noise[0, 0] = _NONE_UM_PER_S**2
        noise[1:, 1:] = self.fit.covariance[np.ix_(own, own)]
        flows, noise = smooth_flows(fractions, flows, noise)
        sigmas = np.sqrt(np.maximum(np.diag(noise), 0.0))
        rising_flows = isotonic_regression(np.maximum(flows, 0.0)).x
        return Branch(fractions, np.asarray(rising_flows), sigmas)

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
            if level.rising or below is None:
                continue
            # Below its start a pump at rest gives nothing: that is no hysteresis of the curve.
            if start is not None and level.fraction < start[1]:
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
            # Above the smallest command that was given, and below the one that holds the mirror.
            low = self.holding_fraction
            high = min(level.fraction for level in self.fit.levels)
            self._wanted.add(Level(high))
            for share in _SCOUTS:
                self._wanted.add(Level(_round_fraction(high + share * (1 - high))))
                self._wanted.add(Level(_round_fraction(low * share)))
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
        leak_um_per_s = self.fit.leak_um_per_s

        # Jumps: a clear rise from no flow. It is divided finely if the least flow that a loop would
        # give above it is near the leak.
        for i, (low, high) in enumerate(pairwise(fractions.tolist())):
            rise = flows[i + 1] - flows[i]
            is_clear = rise > _CLEAR_SIGMAS * math.hypot(sigmas[i], sigmas[i + 1])
            is_jump = (
                is_clear and flows[i] < _NONE_SHARE * full and flows[i + 1] > JUMP_SHARE * full
            )
            least_um_per_s = float(np.interp(high + STALL_MARGIN, fractions, flows))
            edge = _EDGE
            if least_um_per_s > _TOO_MUCH * leak_um_per_s:
                edge = _FINE_EDGE
            if is_jump and high - low > edge:
                found.append(_round_fraction((low + high) / 2))
        if not rising:
            return found

        # Bends: anywhere of a share of the full flow, and about the leak of a share of the leak.
        for i, off in enumerate(limit_bend(fractions, flows).tolist()):
            low, high = fractions[i : i + 2].tolist()
            is_about_leak = flows[i] < _ABOUT_LEAKS * leak_um_per_s < _ABOUT_LEAKS**2 * flows[i + 1]
            is_certain = off > _CERTAIN_SIGMAS * math.hypot(sigmas[i], sigmas[i + 1])
            is_bent_at_leak = is_about_leak and is_certain and off > _BENT_LEAKS * leak_um_per_s
            is_bent = off > _BENT_SHARE * full
            if (is_bent_at_leak and high - low > _EDGE) or (is_bent and high - low > _NEAREST):
                found.append(_round_fraction((low + high) / 2))
        return found

    def _from_above(self) -> list[float]:
        """Commands to reach from above: two for hysteresis, all if there is any; below the start
        for the stall.
        """
        # Reachable commands near some shares of the full flow.
        fractions, flows, _ = self._branches[True].columns
        reached = np.array([f for f in fractions.tolist() if self._is_reachable(Level(f))])
        found = []
        for share in _PLAY_PROBES:
            distance = np.abs(flows[: reached.size] - share * self.full_um_per_s)
            found.append(float(reached[np.argmin(distance)]))
        # The stall is between the start and half of it.
        start = self.find_start()
        if start is not None:
            found += [_round_fraction(start[1] / 2), start[1]]
        if self.hysteretic():
            found += reached[1:-1].tolist()
        return [f for f in found if f > 0]

    def _plan_visits(self) -> list[Level]:
        """Levels to visit in the next round: new ones once, small ones first, then others as often
        as their errors require.

        A round reaches only the first of them. Where the leak's error keeps every level from being
        known, those with the largest error of their own must be among them.
        """
        wanted = sorted(level for level in self._wanted if self._is_reachable(level))
        fresh = [level for level in wanted if level not in self.fit.levels]

        # The others, the least known first. Three visits, times the square of the error that is too
        # large, make a level known.
        others = [level for level in wanted if level not in fresh]
        worst = sorted(others, key=self.flow_sigma, reverse=True)
        wanted_sigma = max(_KNOWN_SHARE * self.full_um_per_s, _NONE_UM_PER_S)
        visits = [3 * (self.flow_sigma(level) / wanted_sigma) ** 2 for level in worst]
        again: list[Level] = []
        for turn in range(_MOST_VISITS):
            for level, needed in zip(worst, visits, strict=True):
                if needed > max(turn, 3):
                    again.append(level)
        return fresh + again

    @property
    def _lacks_flows(self) -> bool:
        """No flow is known, or, in the rounds of the first pulses, none that lifts the mirror."""
        flows = self._list_known_flows()[1]
        if not flows.any():
            return True
        is_early = self._rounds < 3 * _FIRST_ROUNDS
        return is_early and bool(flows.max() <= self.fit.leak_um_per_s)

    def _list_known_flows(self) -> tuple[FloatArray, FloatArray]:
        """Commands whose flows are known to a third, and the flows."""
        if not self.runs:
            return np.empty(0), np.empty(0)
        fractions, flows, sigmas = self._branches[True].columns
        least = _KNOWN_RATIO * self.fit.leak_um_per_s
        is_known = (sigmas < _KNOWN_RATIO * np.maximum(flows, least)) & (fractions > 0)
        return fractions[is_known], flows[is_known]

    def _guess_flow(self, fraction: float) -> float:
        """Flow that a command may have, rather too large: beyond the largest known one like a
        square.
        """
        fractions, flows = (np.append(0.0, column) for column in self._list_known_flows())
        if fraction <= fractions[-1] or not flows[-1]:
            return float(np.interp(fraction, fractions, flows))
        # Beyond it: a square from the largest command without flow.
        none = float(fractions[flows < _NONE_SHARE * flows[-1]].max(initial=0.0))
        ratio = (fraction - none) / (fractions[-1] - none)
        return float(_GUESS_FACTOR * flows[-1] * ratio**2)

    def _least_flow(self, fraction: float) -> float:
        """Flow that a command has at least: that of the largest smaller one that is known."""
        fractions, flows = (np.append(0.0, column) for column in self._list_known_flows())
        return float(flows[fractions <= fraction][-1])

    def _plan_visit(self, level: Level) -> list[PumpStep]:
        """From where the mirror may be to the level's run, and until its gas has arrived."""
        # A visit has to show a motion as long as the limit permits, in one direction. So a level
        # that lifts the mirror begins below the centre, and one on which it sinks above; the steps
        # before the run bring it there.
        leak = max(self.fit.leak_um_per_s, _LEAST_LEAK_UM_PER_S)
        travel_um = self._travel_um
        run = _make_step(level.fraction, self._run_s(level))

        # The command that lifts the mirror; what an unknown command gives is not awaited.
        up = self._lifting_fraction()
        up_s = _FIRST_PULSES_S[-1]
        if self._least_flow(up) > leak:
            up_s = _FULL_TIME_S
        if self._net_flow(level) > 0:
            return self._plan_rising_visit(level, run, up, up_s)

        # A level that lets the mirror sink begins above the centre.
        lifts_um = max(self._net_flow(Level(up)), 0.0) * self.fit.answer_s
        top_um = max(0.5 * travel_um - lifts_um, -0.2 * travel_um)
        first = [_make_step(0.0, _FULL_TIME_S, 0.5 * travel_um), _make_step(up, up_s, top_um)]
        if level.rising:
            first.append(_make_step(0.0, 0.3))
        return [*first, run]

    def _plan_rising_visit(
        self, level: Level, run: PumpStep, up: float, up_s: float
    ) -> list[PumpStep]:
        """The visit of a level that lifts the mirror: it begins below the centre.

        `up` is the command that brings the mirror to its start, for `up_s` at most.
        """
        leak = max(self.fit.leak_um_per_s, _LEAST_LEAK_UM_PER_S)
        late_s = self.fit.delay_s + self.fit.lag_s
        late_um = leak * late_s  # by which it sinks before an answer
        caught_um = _CAUGHT * self._share * self.limit_um

        # Where nothing is known to lift it meanwhile it begins higher, so that its gas can be
        # awaited.
        bottom_um = -0.5 * self._travel_um - min(1.0, 0.1 * self._net_flow(level))
        sinks_um = late_um + (leak - self._least_flow(level.fraction)) * run.duration_s
        least_um = min(bottom_um + late_um, 0.0)
        start_um = max(least_um, min(sinks_um - caught_um, _HIGHEST * self.limit_um))
        steps = [
            _make_step(up, up_s, bottom_um + start_um - least_um - 0.5),
            _make_step(0.0, _FULL_TIME_S, start_um),
        ]
        if not level.rising:
            steps.append(_make_step(self._higher_fraction(level), 0.1))
        steps.append(run)

        # Until its gas has arrived. A short run lifts it less than the leak takes meanwhile: the
        # hold must catch it within the limit.
        rest_s = self.fit.answer_s
        if start_um >= sinks_um - caught_um:
            steps.append(_make_step(0.0, max(0.1, late_s)))
            rest_s = self.fit.answer_s - late_s
        until_um = min(late_um - caught_um, 0.0)
        steps.append(_make_step(0.0, max(0.3, rest_s), until_um))
        return steps

    @property
    def _travel_um(self) -> float:
        """Way of a run."""
        return _TRAVEL_UM * self._share * self.limit_um / 10.0

    def _net_flow(self, level: Level) -> float:
        """Speed of the mirror at a level, µm/s, as far as it is known."""
        return self._guess_flow(level.fraction) - self.fit.leak_um_per_s

    def _is_reachable(self, level: Level) -> bool:
        """The shortest pulse of it leaves the mirror within its limit."""
        return self._net_flow(level) * _PULSE_S <= 1.3 * self.limit_um

    def _run_s(self, level: Level) -> float:
        """How long a level is given."""
        net = self._net_flow(level)
        longest_s = _LONGEST_S
        way_um = self._travel_um
        if level not in self.fit.levels:
            # Its flow is a guess, which may be wrong: it may sink at the least flow's speed.
            sinks_um_per_s = self.fit.leak_um_per_s - self._least_flow(level.fraction)
            share = 1.5
            if net > 0:
                share = 0.5
            longest_s = min(longest_s, way_um * share / max(sinks_um_per_s, _NONE_UM_PER_S))
            way_um *= 0.6
        return max(min(way_um / max(abs(net), _LEAST_LEAK_UM_PER_S), longest_s), _PULSE_S)

    def _lasts_s(self, level: Level) -> float:
        """How long a visit takes, with the way back."""
        leak = max(self.fit.leak_um_per_s, _LEAST_LEAK_UM_PER_S)
        back_over_run = max(self._net_flow(level), 0.0) / leak
        run_and_back_s = self._run_s(level) * (1 + back_over_run)
        return run_and_back_s + self.fit.answer_s + self._travel_um / leak

    def _higher_fraction(self, level: Level) -> float:
        """A larger command, from which a level is reached: beyond any hysteresis."""
        return min(1.0, level.fraction + _ABOVE)

    def make_map(self, held: bool = True) -> PumpMap:
        """The curve. Raises ValueError, with what to check, if there is none to hold a mirror with.

        `held`: the hold brought the mirror back after the last round.
        """
        return Surveyed(
            self.fit,
            self._branches.get(True, Branch.empty()),
            self._branches.get(False, Branch.empty()),
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
        for fraction in np.linspace(fractions[-1], 1.0, 9).tolist():
            rounded = _round_fraction(fraction)
            if self._net_flow(Level(rounded)) > self.fit.leak_um_per_s:
                return rounded
        return 1.0


def _make_step(fraction: float, duration_s: float, until_um: float | None = None) -> PumpStep:
    return PumpStep(fraction=fraction, duration_s=duration_s, until_um=until_um)


def _round_fraction(fraction: float) -> float:
    return round(fraction, 3)
