"""The pump's curve from a survey, or the reason why there is none to hold a mirror with."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import PumpConfig
from membrane_ctrl.control.experiments.operating_point import describe_bleed_remedy
from membrane_ctrl.control.experiments.spec import LIMIT_MAX_UM
from membrane_ctrl.model.arrays import FloatArray
from tuning.identification.curve_shape import Branch, find_first_jump
from tuning.identification.pump_fit import BLOCK_S, PumpFit

_USEFUL_SHARE = 0.02  # standard error of a level, of the full flow; beyond it there is no curve
# A pump counts as stuck if it certainly gives less than the larger of both, at any command.
_STUCK_LEAKS = 0.3
_STUCK_UM_PER_S = 0.2
_REACHES_LEAKS = 1.2  # the curve must reach this flow, in leaks
_FEW_S = 300.0  # of experiments: fewer do not show the noise
# A pump that starts with more than so many leaks, between two commands not further apart.
_STEP_LEAKS = 4.0
_STEP_MOST = 0.105
# Shares of the full flow up to which the curve is flat at its ends; flat ends are shortened.
_FLAT_LOW = 0.005
_FLAT_HIGH = 0.995
_ASTRAY = (
    "the mirror did not come back to its setpoint within three minutes, with slow gains: the "
    "weather is too strong, or the pump gives too much as soon as it runs; run `tune pump` again "
    "in steadier weather, or open the bleed (loop.bleed_fraction)"
)


@dataclass(frozen=True, slots=True)
class PumpMap:
    """`pump_map.json`: what was measured. Flows in µm/s."""

    fraction: tuple[float, ...]  # levels reached from below
    flow_um_per_s: tuple[float, ...]
    sigma_um_per_s: tuple[float, ...]
    pump: PumpConfig
    leak_um_per_s: float
    delay_s: float
    lag_s: float
    duration_s: float
    known: bool  # every level to the accuracy wanted


@dataclass(frozen=True, slots=True)
class Surveyed:
    """What a survey has found so far. Flows in µm/s."""

    fit: PumpFit
    rising: Branch  # levels reached from below, from no flow at command 0
    falling: Branch
    full_um_per_s: float  # the largest flow seen for certain
    hysteretic: bool
    duration_s: float
    done: bool  # every level to the accuracy wanted
    limit_um: float
    held: bool = True  # the hold brought the mirror back after the last round

    def map(self) -> PumpMap:
        """The curve. Raises ValueError, with what to check,
        if there is none to hold a mirror with.
        """
        from scipy.optimize import isotonic_regression

        rising, from_bottom = self._known_part()
        leak = self.fit.leak_um_per_s
        full = float(rising.flows[-1])
        if full < leak:
            raise ValueError(
                f"the pump gives {full:.2f} µm/s at most and the mirror loses {leak:.2f} µm/s: "
                "find the leak, or take a stronger pump, then run `tune pump` again"
            )

        # Commands at which the pump starts from rest, and at which a running one stalls.
        start_fraction = 0.0
        if not from_bottom:
            start_fraction = float(rising.fractions[0])
        stall_fraction = start_fraction
        start = find_first_jump(rising, full)
        if start is not None:
            start_fraction = start[1]
            stall_fraction = start_fraction
            stall = find_first_jump(self.falling, full)
            if stall is not None:
                stall_fraction = min(start_fraction, stall[1])

        # The curve of a running pump: from above between stall and start, from below beyond it.
        above = (self.falling.fractions >= stall_fraction) & (
            self.falling.fractions < start_fraction
        )
        below = rising.fractions >= start_fraction
        curve_fractions = [*self.falling.fractions[above], *rising.fractions[below]]
        curve_flows = [*self.falling.flows[above], *rising.flows[below]]

        # Without flat ends, and never falling.
        points = sorted(zip(curve_fractions, curve_flows, strict=True))
        while len(points) > 2 and points[1][1] <= _FLAT_LOW * full:
            points.pop(0)
        while len(points) > 2 and points[-2][1] >= _FLAT_HIGH * full:
            points.pop()
        fractions, flows = np.array(points).T
        rising_flows = isotonic_regression(flows).x
        table: dict[str, object] = {
            "curve_fraction": _round_values(fractions),
            "curve_um_per_s": _round_values(rising_flows),
            "start_fraction": start_fraction,
            "stall_fraction": stall_fraction,
        }

        # A second branch with hysteresis: no less than the first, and equal at the end.
        if self.hysteretic:
            from_above = np.interp(fractions, self.falling.fractions, self.falling.flows)
            more = np.maximum(from_above, rising_flows)
            more[-1] = flows[-1]
            never_falling = np.maximum.accumulate(np.minimum(more, flows[-1]))
            table["curve_falling_um_per_s"] = _round_values(never_falling)
        pump = PumpConfig.model_validate(table)
        return PumpMap(
            _round_values(rising.fractions),
            _round_values(rising.flows),
            _round_values(rising.sigmas),
            pump,
            leak,
            self.fit.delay_s,
            self.fit.lag_s,
            self.duration_s,
            self.done,
        )

    def _advise_runs(self, off: float = 2.0) -> str:
        """What makes the flows known better; the errors are `off` times too large.

        Runs twice as long see a flow 1.4 times as well (measured, on pumps of a second world), in a
        random walk no better.
        """
        # The limit that would do, in steps of 5 µm.
        enough_um = 5.0 * math.ceil(1.3 * off**2 * self.limit_um / 5.0)

        # Whether the limit ended nearly every run; and whether the noise is a random walk already
        # within a run.
        is_stopped = self.duration_s < _FEW_S
        walk_shows_s = BLOCK_S / (1 - self.fit.share_white)
        is_in_walk = walk_shows_s * self.fit.leak_um_per_s < self.limit_um
        helps = is_stopped or (not is_in_walk and enough_um <= LIMIT_MAX_UM)
        if self.limit_um >= LIMIT_MAX_UM or not helps:
            return "run `tune pump` again in steadier weather, or with a quieter laser"
        limit_um = 2 * self.limit_um
        if not is_stopped:
            limit_um = max(enough_um, limit_um)
        return f"run `tune pump` again with --limit-um {min(limit_um, LIMIT_MAX_UM):g}"

    def _known_part(self) -> tuple[Branch, bool]:
        """The levels reached from below that are known, on either side of the leak; and whether
        that begins at 0.

        Raises ValueError, with what to check, if there are none.
        """
        if not self.fit.levels:
            if not self.held:
                raise ValueError(_ASTRAY)
            raise ValueError(f"the experiments were stopped too early: {self._advise_runs()}")
        fractions, flows, sigmas = self.rising.columns
        leak = self.fit.leak_um_per_s
        if is_stuck(self.fit, self.rising):
            last = int(np.argmin(sigmas[1:])) + 1
            raise ValueError(
                f"the mirror moves the same at every command ({flows[last]:.2f} +- "
                f"{sigmas[last]:.2f} µm/s more at {fractions[last]:.2f} than at 0): the pump is "
                "stuck, or its gas does not arrive: free it, then run `tune pump` again"
            )
        if not self.held:
            self._refuse_steep(1.0, "the hold does not bring the mirror back")
            raise ValueError(_ASTRAY)

        # The known levels next to each other about the flow that holds the mirror.
        useful_sigma = _USEFUL_SHARE * self.full_um_per_s
        known = sigmas <= useful_sigma
        distance = np.where(known, np.abs(flows - _REACHES_LEAKS * leak), np.inf)
        low = int(np.argmin(distance))
        top = low
        while low > 0 and known[low - 1]:
            low -= 1
        while top + 1 < known.size and known[top + 1]:
            top += 1

        # The flow that holds the mirror must be on the curve.
        ends_too_early = fractions[top] < 1.0 and flows[top] < _REACHES_LEAKS * leak
        if top == low or ends_too_early:
            self._refuse_steep(_STEP_LEAKS, "no command holds the mirror")
            where = f"beyond a command of {fractions[top]:.2f}"
            self._refuse_unknown(where, top, min(top + 1, known.size - 1))
        if low > 0 and flows[low] > leak:
            self._refuse_unknown(f"below a command of {fractions[low]:.2f}", top, low - 1)
        part = slice(low, top + 1)
        return Branch(fractions[part], flows[part], sigmas[part]), low == 0

    def _refuse_unknown(self, where: str, top: int, unknown: int) -> None:
        """Raise ValueError for a curve that ends too early, with what to do.

        Parameters
        ----------
        where : str
            Where the curve ends, for a person.
        top : int
            Number of its last known level; 0: none is known.
        unknown : int
            Number of the first level that is not.
        """
        if not top:
            where = "at every command"
        useful_sigma = _USEFUL_SHARE * self.full_um_per_s
        too_large = float(self.rising.sigmas[unknown]) / useful_sigma
        raise ValueError(
            f"the flow {where} is not known to {_USEFUL_SHARE:.0%} after "
            f"{self.duration_s / 60:.0f} minutes of experiments: "
            f"{self._advise_runs(too_large)}"
        )

    def _refuse_steep(self, leaks: float, reading_text: str) -> None:
        """Raises ValueError if the flow rises at once from less than the leak to more than so many
        times as much.
        """
        fractions, flows, sigmas = self.rising.columns
        leak = self.fit.leak_um_per_s
        above = int(np.argmax(flows - 2 * sigmas > leaks * leak))
        if not above:
            return
        below = above - 1
        is_too_little = flows[below] + 2 * sigmas[below] < leak
        if is_too_little and fractions[above] - fractions[below] <= _STEP_MOST:
            raise ValueError(
                f"{reading_text}: the flow rises from {flows[below]:.1f} µm/s at a command of "
                f"{fractions[below]:.2f} to {flows[above]:.1f} µm/s at {fractions[above]:.2f}, "
                f"and the mirror loses {leak:.1f} µm/s: throttle the pump, or "
                f"{describe_bleed_remedy(leak, flows[above])}, then run `tune pump` again"
            )


def is_stuck(fit: PumpFit, rising: Branch) -> bool:
    """Return whether it is certain that no command so far gives a flow that matters.

    A pump that is stuck at what leaks makes the mirror look tight, so that a share of the leak does
    not suffice as a limit.

    Parameters
    ----------
    fit : PumpFit
        Leak, and flows by their commands.
    rising : Branch
        The branch of commands from below.
    """
    if not rising.flows.size:
        return False
    if any(at.flow_um_per_s > 5 * at.sigma_um_per_s for at in fit.levels.values()):
        return False
    matters_um_per_s = max(_STUCK_LEAKS * fit.leak_um_per_s, _STUCK_UM_PER_S)
    flows = rising.flows[1:]
    sigmas = rising.sigmas[1:]
    return bool((flows + 3 * sigmas < matters_um_per_s).all())


def _round_values(values: FloatArray) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in values.tolist())
