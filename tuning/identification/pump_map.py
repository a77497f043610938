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
# a pump that surely gives less than both, at any command
_STUCK_LEAKS = 0.3
_STUCK_UM_PER_S = 0.2
_REACHES_LEAKS = 1.2
_FEW_S = 300.0  # of experiments: fewer do not show the noise
# a pump that starts with more than the mirror loses, between two commands
_STEP_LEAKS = 4.0
_STEP_MOST = 0.105
_ASTRAY = (
    "the mirror did not come back to its setpoint within three minutes, with slow gains: the "
    "weather is too strong, "
    "or the pump gives too much as soon as it runs; run `tune pump` again in steadier "
    "weather, or open the bleed "
    "(loop.bleed_fraction)"
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
        leak, full = self.fit.leak_um_per_s, float(rising.flows[-1])
        if full < leak:
            raise ValueError(
                f"the pump gives {full:.2f} µm/s at most and the mirror loses {leak:.2f} "
                "µm/s: find the leak, or "
                "take a stronger pump, then run `tune pump` again"
            )
        start, above = find_first_jump(rising, full), self.falling.columns
        begin = stall = 0.0 if from_bottom else float(rising.fractions[0])
        if start is not None:
            begin = stall = start[1]
            stalls = find_first_jump(self.falling, full)
            stall = min(begin, stalls[1]) if stalls is not None else begin
        falling = {
            f: v
            for f, v in zip(above[0].tolist(), above[1].tolist(), strict=True)
            if stall <= f < begin
        }
        up = {
            f: v
            for f, v in zip(rising.fractions.tolist(), rising.flows.tolist(), strict=True)
            if f >= begin
        }
        points = sorted({**falling, **up}.items())
        while len(points) > 2 and points[1][1] <= 0.005 * full:
            points.pop(0)
        while len(points) > 2 and points[-2][1] >= 0.995 * full:
            points.pop()
        xs, ys = np.array(points).T
        table: dict[str, object] = {
            "curve_fraction": _round_values(xs),
            "curve_um_per_s": _round_values(isotonic_regression(ys).x),
        }
        if self.hysteretic:
            more = np.maximum(np.interp(xs, above[0], above[1]), isotonic_regression(ys).x)
            more[-1] = ys[-1]
            table["curve_falling_um_per_s"] = _round_values(
                np.maximum.accumulate(np.minimum(more, ys[-1]))
            )
        pump = PumpConfig.model_validate(
            {**table, "start_fraction": begin, "stall_fraction": stall}
        )
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
        walk_shows_s = BLOCK_S / (1 - self.fit.share_white)
        enough_um = 5.0 * math.ceil(1.3 * off**2 * self.limit_um / 5.0)
        stopped = self.duration_s < _FEW_S  # the limit ended nearly every run
        drowned = walk_shows_s * self.fit.leak_um_per_s < self.limit_um
        if self.limit_um < LIMIT_MAX_UM and (
            stopped or (not drowned and enough_um <= LIMIT_MAX_UM)
        ):
            limit_um = min(max(enough_um if not stopped else 0.0, 2 * self.limit_um), LIMIT_MAX_UM)
            return f"run `tune pump` again with --limit-um {limit_um:g}"
        return "run `tune pump` again in steadier weather, or with a quieter laser"

    def _known_part(self) -> tuple[Branch, bool]:
        """The levels reached from below that are known, on either side of the leak; and whether
        that begins at 0.

        Beyond them nothing is said. Raises ValueError if there are none.
        """
        if not self.fit.levels:
            if not self.held:
                raise ValueError(_ASTRAY)
            raise ValueError(f"the experiments were stopped too early: {self._advise_runs()}")
        fractions, flows, sigmas = self.rising.columns
        leak, last = self.fit.leak_um_per_s, int(np.argmin(sigmas[1:])) + 1
        if is_stuck(self.fit, self.rising):
            raise ValueError(
                f"the mirror moves the same at every command ({flows[last]:.2f} +- "
                f"{sigmas[last]:.2f} µm/s more at "
                f"{fractions[last]:.2f} than at 0): the pump is stuck, or its gas does not "
                "arrive: free it, then run "
                "`tune pump` again"
            )
        if not self.held:
            self._refuse_steep(1.0, "the hold does not bring the mirror back")
            raise ValueError(_ASTRAY)
        known = sigmas <= _USEFUL_SHARE * self.full_um_per_s
        low = top = int(np.argmin(np.where(known, np.abs(flows - _REACHES_LEAKS * leak), np.inf)))
        while low > 0 and known[low - 1]:
            low -= 1
        while top + 1 < known.size and known[top + 1]:
            top += 1
        beyond = top == low or (fractions[top] < 1.0 and flows[top] < _REACHES_LEAKS * leak)
        if beyond:
            self._refuse_steep(_STEP_LEAKS, "no command holds the mirror")
        if beyond or (
            low > 0 and flows[low] > leak
        ):  # the flow that holds the mirror must be on the curve
            unknown = min(top + 1, known.size - 1) if beyond else low - 1
            where = (
                f"{'beyond' if beyond else 'below'} a command of "
                f"{fractions[top if beyond else low]:.2f}"
            )
            too_large = float(sigmas[unknown]) / (_USEFUL_SHARE * self.full_um_per_s)
            raise ValueError(
                f"the flow {where if top else 'at every command'} is not known to "
                f"{_USEFUL_SHARE:.0%} after "
                f"{self.duration_s / 60:.0f} minutes of experiments: "
                f"{self._advise_runs(too_large)}"
            )
        part = slice(low, top + 1)
        return Branch(fractions[part], flows[part], sigmas[part]), low == 0

    def _refuse_steep(self, leaks: float, reading_text: str) -> None:
        """Raises ValueError if the flow rises at once from less than the leak to more than so many
        times as much.
        """
        fractions, flows, sigmas = self.rising.columns
        leak = self.fit.leak_um_per_s
        above = int(np.argmax(flows - 2 * sigmas > leaks * leak))
        below = above - 1
        if (
            above
            and flows[below] + 2 * sigmas[below] < leak
            and fractions[above] - fractions[below] <= _STEP_MOST
        ):
            raise ValueError(
                f"{reading_text}: the flow rises from {flows[below]:.1f} µm/s at a command of "
                f"{fractions[below]:.2f} to {flows[above]:.1f} µm/s at {fractions[above]:.2f}, "
                f"and the mirror loses {leak:.1f} µm/s: throttle the pump, or "
                f"{describe_bleed_remedy(leak, flows[above])}, then run `tune pump` again"
            )


def is_stuck(fit: PumpFit, rising: Branch) -> bool:
    """Whether no command so far gives what would matter, beyond doubt."""
    # a pump that is stuck at what leaks makes the mirror look tight
    matters_um_per_s = max(_STUCK_LEAKS * fit.leak_um_per_s, _STUCK_UM_PER_S)
    if not rising.flows.size or any(
        at.flow_um_per_s > 5 * at.sigma_um_per_s for at in fit.levels.values()
    ):
        return False
    _, flows, sigmas = (column[1:] for column in rising.columns)
    return bool((flows + 3 * sigmas < matters_um_per_s).all())


def _round_values(values: FloatArray) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in values.tolist())
