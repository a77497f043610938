"""The pump: command for a flow, and the flow a command gives. Pure.

    q = q_full (d - dead) / (1 - dead)   while it runs; starts at `start`, stalls below `stall`

(docs/explanation/physics.md), or a measured curve through any number of points, with a second
branch for falling commands if there is hysteresis.

There is no flow between rest and the least running flow: a wanted flow in that gap goes to the
nearer end, so that the error of the gap has no fixed sign. (Always running would add gas that
nothing removes, always stopping would lose the least flow: each is a bias.) The rest is left to the
integrator, which has no model of the gap, but integrates the resulting error.
"""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.model.state_tree import StateNode

# Margin above the stall command, so that a rounded register or a cold pump does not stall.
STALL_MARGIN = 0.005
# A stopped pump gets the start command for this long: about its lag (0.15 s), in which it adds less
# than 0.1 µm.
KICK_S = 0.1
VENT_FULL_UM_PER_S = 100.0  # of an open vent at the nominal pressure
_PER_INTERVAL = 16  # chords of the cubic between two points: within 0.1 % of its rise


class _StraightLine:
    """Flow in proportion to the command beyond `dead_fraction`."""

    lowest_fraction, highest_fraction = 0.0, 1.0

    def __init__(self, pump: PumpConfig) -> None:
        self._full = pump.flow_full_um_per_s
        self._dead = pump.dead_fraction

    def flow(self, fraction: float) -> float:
        return max(0.0, self._full * (fraction - self._dead) / (1.0 - self._dead))

    def fraction(self, flow_um_per_s: float) -> float:
        return self._dead + (1.0 - self._dead) * flow_um_per_s / self._full


class _Measured:
    """A monotone cubic (PCHIP) through measured points, tabulated, so that curve and inverse agree
    and cost the same.

    There is no flow below the first command, and none beyond the last one is known.
    """

    def __init__(self, fractions: Sequence[float], flows_um_per_s: Sequence[float]) -> None:
        self._fractions, self._flows = _tabulate_monotone_cubic(fractions, flows_um_per_s)
        self.lowest_fraction = fractions[0]
        self.highest_fraction = fractions[-1]

    def flow(self, fraction: float) -> float:
        if fraction >= self._fractions[0]:
            return _interpolate_clamped(self._fractions, self._flows, fraction)
        return 0.0

    def fraction(self, flow_um_per_s: float) -> float:
        return _interpolate_clamped(self._flows, self._fractions, flow_um_per_s)


def make_branch(pump: PumpConfig, flows_um_per_s: Sequence[float]) -> _StraightLine | _Measured:
    """Return one branch of the pump's curve.

    Parameters
    ----------
    pump : PumpConfig
        Its fractions are those of the curve's points.
    flows_um_per_s : sequence of float
        Flow at each; empty for a straight line.
    """
    if flows_um_per_s:
        return _Measured(pump.curve_fraction, flows_um_per_s)
    return _StraightLine(pump)


def _interpolate_clamped(xs: Sequence[float], ys: Sequence[float], x: float) -> float:
    """Linear interpolation, clamped to the ends."""
    right = min(max(bisect_right(xs, x), 1), len(xs) - 1)
    low, high = xs[right - 1], xs[right]
    share = 0.0
    if high > low:
        share = min(max((x - low) / (high - low), 0.0), 1.0)
    return ys[right - 1] + share * (ys[right] - ys[right - 1])


def _tabulate_monotone_cubic(
    xs: Sequence[float], ys: Sequence[float]
) -> tuple[list[float], list[float]]:
    """Return points along the monotone cubic through measured points: it has no new extrema.

    SciPy's `PchipInterpolator` is the same cubic. It is not used because a curve may arrive with a
    command of a running hold, and loading `scipy.interpolate` would block the tick for 0.4
    seconds (decision 92).
    Source: Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300.
    """
    widths = [b - a for a, b in pairwise(xs)]
    chords = [(b - a) / width for (a, b), width in zip(pairwise(ys), widths, strict=True)]
    # Slope at each inner point: weighted harmonic mean of the chords beside it, 0 beside a flat one
    slopes = [_end_slope(widths, chords)]
    for (before, after), (left, right) in zip(pairwise(chords), pairwise(widths), strict=True):
        if before == 0.0 or after == 0.0:
            slopes.append(0.0)
            continue
        weight_before = 2 * right + left
        weight_after = right + 2 * left
        slopes.append(
            (weight_before + weight_after) / (weight_before / before + weight_after / after)
        )
    slopes.append(_end_slope(widths[::-1], chords[::-1]))
    # Points of the cubic with these slopes; rounding must not make a flow fall
    fractions, flows = [xs[0]], [ys[0]]
    for i, (width, chord) in enumerate(zip(widths, chords, strict=True)):
        square = (3 * chord - 2 * slopes[i] - slopes[i + 1]) / width
        cube = (slopes[i] + slopes[i + 1] - 2 * chord) / width**2
        for step in range(1, _PER_INTERVAL):
            x = width * step / _PER_INTERVAL
            fractions.append(xs[i] + x)
            flows.append(max(flows[-1], ys[i] + x * (slopes[i] + x * (square + x * cube))))
        fractions.append(xs[i + 1])
        flows.append(ys[i + 1])
    return fractions, flows


def _end_slope(widths: Sequence[float], chords: Sequence[float]) -> float:
    """Three-point slope at the first point, limited so that the first interval stays monotone."""
    if len(chords) == 1:
        return chords[0]
    slope = ((2 * widths[0] + widths[1]) * chords[0] - widths[0] * chords[1]) / (
        widths[0] + widths[1]
    )
    return min(max(slope, 0.0), 3 * chords[0])


@dataclass(slots=True)
class PumpCurveState(StateNode):
    """How the pump runs by its commands."""

    flow_um_per_s: float = 0.0  # that it gives
    kick_left_s: float = KICK_S  # of the start pulse


class PumpCurve:
    """The inverse of the pump, which remembers whether the pump runs, and between two branches how
    much it gives.

    Hysteresis is play: the flow stays while it lies between the branches at the command, and else
    moves along one.
    """

    def __init__(self, pump: PumpConfig, memory: PumpCurveState | None = None) -> None:
        self.memory = memory or PumpCurveState()
        self._start_fraction = pump.start_fraction
        self._rising = make_branch(pump, pump.curve_um_per_s)
        self._falling = make_branch(pump, pump.curve_falling_um_per_s or pump.curve_um_per_s)
        # Below its first command a measured curve contains no running pump, on its falling branch
        # either
        self._least_fraction = max(
            pump.stall_fraction + STALL_MARGIN, self._falling.lowest_fraction
        )

    @property
    def least_flow_um_per_s(self) -> float:
        """The smallest flow of a running pump."""
        return self._falling.flow(self._least_fraction)

    def note_stop(self) -> None:
        """Note that something else stopped the pump: the next flow starts it."""
        self.memory.kick_left_s = KICK_S
        self.memory.flow_um_per_s = 0.0

    def flow(self, fraction: float) -> float:
        """Flow in µm/s that a running pump gives for a command."""
        return min(
            max(self.memory.flow_um_per_s, self._rising.flow(fraction)),
            self._falling.flow(fraction),
        )

    def fraction(self, flow_um_per_s: float) -> float:
        """Command at which a running pump, from lower commands, gives a flow."""
        return self._rising.fraction(flow_um_per_s)

    def command(self, flow_um_per_s: float, dt_s: float) -> float:
        """Return the command for a flow; a stopped pump gets a start pulse.

        Parameters
        ----------
        flow_um_per_s : float
            Within the range of the pump; less than half of its smallest flow stops it.
        dt_s : float
            Time until the next command, for the duration of the pulse.

        Returns
        -------
        float
            Fraction of full scale.
        """
        # Less than half of the smallest flow of a running pump: off is nearer
        if flow_um_per_s <= 0.5 * self.least_flow_um_per_s:
            self.note_stop()
            return 0.0
        # More flow is found on the rising branch, less on the falling one
        memory = self.memory
        if flow_um_per_s > memory.flow_um_per_s:
            branch = self._rising
        else:
            branch = self._falling
        fraction = min(
            max(branch.fraction(flow_um_per_s), self._least_fraction), branch.highest_fraction
        )
        # A pump that stands needs more to start than to run
        if memory.kick_left_s > 0.0:
            memory.kick_left_s -= dt_s
            fraction = max(fraction, self._start_fraction)
        memory.flow_um_per_s = self.flow(fraction)
        return fraction
