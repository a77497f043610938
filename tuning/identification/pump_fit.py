"""The pump's curve from runs of constant commands: the mirror is the flow meter.

    y = sum over commands of f(command) x path(command) - leak path + g pressure + n

The path of a command is the time for which it was given, behind the dead time and the lag of the
actuator: whatever its curve, the flow at each command is one linear unknown. A command reached from
above is another unknown than the same one reached from below. The leak may change within a minute;
n is white noise on a random walk.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from tuning.identification.pump_run import Level, PumpRun, list_levels

BLOCK_S = 0.1
_BEFORE_S = 8.0  # a flow that was on its way before the first command has arrived by then
_LEAK_S = 40.0  # between the nodes of the leak's course
_LEAK_CHANGES_UM_PER_S = (
    0.02,
    0.06,
    0.2,
)  # the weather's slow course looks like it; the last is 1.5 mK/s of the air
_BEFORE_UM_PER_S = 0.5  # of the loop's flow from the leak, when a run begins
_WHITES = (0.9, 0.97, 0.99, 0.997, 0.9995)
_DELAYS_S = (0.05, 0.2, 0.5, 1.0, 1.6, 2.2)
_LAGS_S = (0.1, 0.4, 1.0, 2.0)
# of the likelihood's search
_TURNS = 8
_ENOUGH = 0.2
_OFF = np.array([-3, -2])  # columns of delay and lag
# what delay and lag may be off; for their slopes
_OFF_S = 1.0
_SLOPE_S = 0.05
_LEAST_S = 0.01
_MOST_S = 4.0


@dataclass(frozen=True, slots=True)
class FlowAt:
    """Flow at a command, µm/s, and its standard error."""

    flow_um_per_s: float
    sigma_um_per_s: float


@dataclass(frozen=True, slots=True)
class PumpFit:
    """What the runs show of the pump and the leak."""

    levels: dict[Level, FlowAt]
    covariance: FloatArray  # of the levels' flows, in their order
    leak_um_per_s: float
    delay_s: float
    lag_s: float
    share_white: float  # of the noise: 1 - 1/(blocks that the random walk takes to show)
    leak_changes_um_per_s: float = _LEAK_CHANGES_UM_PER_S[-1]  # its standard deviation within a run

    @property
    def likeliest(self) -> tuple[float, float, float, float]:
        """Delay, lag, noise, changes of the leak."""
        return self.delay_s, self.lag_s, self.share_white, self.leak_changes_um_per_s

    @property
    def answer_s(self) -> float:
        """Until a changed command shows its whole flow."""
        return self.delay_s + 3 * self.lag_s


NO_FIT = PumpFit({}, np.empty((0, 0)), 0.0, 0.0, 0.0, 0.8)


@dataclass(frozen=True, slots=True)
class _Blocks:
    """A run in blocks of `BLOCK_S`: the paths of its levels before the actuator, beginning before
    the run.
    """

    columns: list[int]  # which of all levels these are
    paths: FloatArray  # (before + n, levels + 1); the last is what flowed before
    leak: FloatArray  # (n, nodes): paths of the nodes of its course
    pressure_pa: FloatArray  # (n,)
    displacement_um: FloatArray  # (n,)


@dataclass(frozen=True, slots=True)
class _Flows:
    """The linear unknowns behind an actuator: flow of each level, leak, pressure, (what delay and
    lag are off).
    """

    delay_s: float
    lag_s: float
    white: float
    leak_changes_um_per_s: float
    cost: float  # twice the negative log likelihood
    values: FloatArray
    covariance: FloatArray

    def differs_by_at_most_one(self, white: float, leak_changes_um_per_s: float) -> bool:
        """Whether at most one of the two differs."""
        return white == self.white or leak_changes_um_per_s == self.leak_changes_um_per_s


def fit_pump(runs: Sequence[PumpRun], near: PumpFit | None = None) -> PumpFit:
    """Fit the flow at every level of the runs. Begins at the actuator and the noise of `near`, if
    given.

    Raises ValueError for runs without readings, or too short.
    """
    levels = sorted({level for run in runs for level in list_levels(run) if level is not None})
    model = _Mirror([_blocks(run, levels) for run in runs], len(levels))
    starts = product(_DELAYS_S, _LAGS_S, _WHITES[1:2], _LEAK_CHANGES_UM_PER_S[-1:])
    best = min(
        (model.solve_flows(*start) for start in (starts if near is None else (near.likeliest,))),
        key=_cost,
    )
    for _ in range(_TURNS):
        noises = product(_WHITES, _LEAK_CHANGES_UM_PER_S)
        tried = (
            model.solve_flows(best.delay_s, best.lag_s, *noise)
            for noise in noises
            if best.differs_by_at_most_one(*noise)
        )
        better = min((model.improve_delay_and_lag(best), *tried), key=_cost)
        enough = best.cost - better.cost < _ENOUGH
        best = better
        if enough:
            break
    return model.make_fit(best, levels)


class _Mirror:
    """The mirror as a flow meter: the likelihood of its runs behind an actuator and in noise.

    Delay and lag are linear unknowns as well, about where they are: Gauss and Newton's step, and
    their share of the errors.
    """

    def __init__(self, blocks: Sequence[_Blocks], levels: int) -> None:
        self._blocks = blocks
        self._levels = levels
        self._has_pressure = all(np.isfinite(block.pressure_pa).all() for block in blocks)
        bends = np.hstack([np.diff(block.displacement_um, 2) for block in blocks])
        self._noise_um = float(np.median(np.abs(bends))) / 0.6745 / math.sqrt(6)
        self._rows = sum(block.displacement_um.size for block in blocks)

    def solve_flows(
        self,
        delay_s: float,
        lag_s: float,
        white: float,
        changes: float,
        flows: FloatArray | None = None,
    ) -> _Flows:
        """Flows behind an actuator; with `flows` also how far delay and lag are off, if those
        flowed.
        """
        gram, cost = self._gram_matrix((delay_s, lag_s, white), changes, flows)
        here = np.delete(np.delete(gram, _OFF, axis=0), _OFF, axis=1)
        variance, values, covariance = _least_squares(here, self._rows)
        cost += self._rows * math.log(variance)
        if flows is not None:
            gram[_OFF, _OFF] += self._noise_um**2 / _OFF_S**2
            _, values, covariance = _least_squares(gram, self._rows)
        return _Flows(delay_s, lag_s, white, changes, cost, values, covariance)

    def improve_delay_and_lag(self, best: _Flows) -> _Flows:
        """With a better delay and lag, if there are any."""
        kept = best.white, best.leak_changes_um_per_s
        off = self.solve_flows(best.delay_s, best.lag_s, *kept, best.values).values[-2:]
        for share in (1.0, 0.4, 0.1):
            delay_s, lag_s = np.clip(
                (best.delay_s, best.lag_s) + share * off, _LEAST_S, _MOST_S
            ).tolist()
            found = self.solve_flows(delay_s, lag_s, *kept)
            if found.cost < best.cost:
                return found
        return best

    def make_fit(self, best: _Flows, levels: Sequence[Level]) -> PumpFit:
        """The flows of the levels, with the share of delay and lag in their errors."""
        kept = best.white, best.leak_changes_um_per_s
        found = self.solve_flows(best.delay_s, best.lag_s, *kept, best.values)
        count = len(levels)
        covariance = found.covariance[:count, :count]
        columns = found.values[:count].tolist(), np.sqrt(np.diag(covariance)).tolist()
        flows = {level: FlowAt(*at) for level, *at in zip(levels, *columns, strict=True)}
        return PumpFit(
            flows, covariance, float(found.values[count]), best.delay_s, best.lag_s, *kept
        )

    def _gram_matrix(
        self, at: tuple[float, float, float], changes: float, flows: FloatArray | None
    ) -> tuple[FloatArray, float]:
        """Products of the columns levels, leak, pressure, delay, lag, height; and the likelihood's
        determinant.
        """
        last = self._levels + np.arange(5)
        whole, determinant = np.zeros((self._levels + 5,) * 2), 0.0
        for block in self._blocks:
            given = (
                np.zeros(len(block.columns) + 1)
                if flows is None
                else flows[[*block.columns, self._levels]]
            )
            columns = _whiten_columns(block, at, given, self._has_pressure)
            gram, logarithm = _without_own(
                columns, block.leak.shape[1], at[2], (self._noise_um, changes)
            )
            where = np.append(block.columns, last).astype(int)
            whole[np.ix_(where, where)] += gram
            determinant += logarithm
        return whole, determinant


def _cost(found: _Flows) -> float:
    return found.cost


def _blocks(run: PumpRun, levels: Sequence[Level]) -> _Blocks:
    size = max(1, round(BLOCK_S / run.dt_s))
    count = run.fraction.size // size
    good = np.isfinite(run.displacement_um)
    if count < 10 or not good.any():
        raise ValueError("a run of the pump without readings, or too short")

    def mean(column: FloatArray) -> FloatArray:
        return np.asarray(
            column[: count * size].reshape(count, size, *column.shape[1:]).mean(axis=1)
        )

    given = list_levels(run)
    own = sorted({level for level in given if level is not None})
    on = np.zeros((run.fraction.size + 1, len(own)))
    for tick, level in enumerate(given, start=1):
        if level is not None:
            on[tick, own.index(level)] = run.dt_s
    before = np.zeros((round(_BEFORE_S / (size * run.dt_s)), len(own)))
    paths = np.vstack((before, mean(np.cumsum(on, axis=0)[:-1])))
    time_s = size * run.dt_s * np.arange(-before.shape[0], count)
    now_s = time_s[before.shape[0] :]
    nodes = np.linspace(0.0, now_s[-1], 1 + max(1, round(now_s[-1] / _LEAK_S)))
    hats = np.column_stack([np.interp(now_s, nodes, unit) for unit in np.eye(nodes.size)])
    filled = np.interp(np.arange(good.size), np.flatnonzero(good), run.displacement_um[good])
    return _Blocks(
        columns=[levels.index(level) for level in own],
        paths=np.column_stack((paths, np.minimum(time_s, 0.0))),
        leak=np.cumsum(hats, axis=0) * size * run.dt_s,
        pressure_pa=mean(run.ambient_pressure_pa),
        displacement_um=mean(filled),
    )


def _delay_paths(paths: FloatArray, delay_s: float, lag_s: float) -> FloatArray:
    """Paths behind the actuator; what flows at the beginning had flowed forever."""
    from scipy.signal import lfilter

    late = delay_s / BLOCK_S
    whole, part = int(late), late - int(late)
    earlier = paths[0] - (paths[1] - paths[0]) * np.arange(whole + 1, 0, -1)[:, None]
    held = np.vstack((earlier, paths))
    rows = paths.shape[0]
    given = (1 - part) * held[1 : rows + 1] + part * held[:rows]
    keep = math.exp(-BLOCK_S / lag_s)
    return np.asarray(lfilter([1 - keep], [1, -keep], given - given[0], axis=0))


def _whiten_columns(
    block: _Blocks, at: tuple[float, float, float], flows: FloatArray, has_pressure: bool
) -> FloatArray:
    """Columns levels, before, leak, pressure, delay, lag, height, differenced so that the noise is
    white.

    Those of delay and lag say what a second more of them changes, with these flows of the levels
    and before.
    """
    from scipy.signal import lfilter

    delay_s, lag_s, white = at
    count = block.displacement_um.size
    given = block.paths @ flows[:, None]
    slopes = [
        (
            _delay_paths(given, delay_s + more_s, lag_s + slower_s)
            - _delay_paths(given, delay_s, lag_s)
        )
        / _SLOPE_S
        for more_s, slower_s in ((_SLOPE_S, 0.0), (0.0, _SLOPE_S))
    ]
    columns = np.column_stack(
        (
            _delay_paths(block.paths, delay_s, lag_s)[-count:],
            block.leak,
            block.pressure_pa if has_pressure else np.zeros(count),
            *(slope[-count:] for slope in slopes),
            block.displacement_um,
        )
    )
    return np.asarray(lfilter([1.0], [1.0, -white], np.diff(columns, axis=0), axis=0))


def _without_own(
    columns: FloatArray, nodes: int, white: float, noises: tuple[float, float]
) -> tuple[FloatArray, float]:
    """Products of a run's columns levels, leak, pressure, delay, lag, height, after what belongs to
    this run alone.

    These are the course of the leak, what the pump gave before the run, and the noise of the first
    reading. Also the logarithm of their determinant. Noises: of a reading in µm, of the leak in
    µm/s.
    """
    paths, leak, rest = np.split(columns, (-4 - nodes, -4), axis=1)
    levels, before = paths[:, :-1], paths[:, -1:]
    # before the run the pump gave what leaks
    shared = np.hstack((levels, before - leak.sum(axis=1, keepdims=True), rest))
    first = white ** np.arange(1, before.size + 1)[:, None]
    own = np.hstack((leak, before, first))
    noise_um, leak_um_per_s = noises
    spread = np.array([*[leak_um_per_s] * nodes, _BEFORE_UM_PER_S, noise_um])
    free = (noise_um / spread) ** 2
    across, inner = own.T @ shared, own.T @ own + np.diag(free)
    gram = shared.T @ shared - across.T @ np.linalg.solve(inner, across)
    return np.asarray(gram), float(np.linalg.slogdet(inner)[1] - np.log(free).sum())


def _least_squares(gram: FloatArray, rows: int) -> tuple[float, FloatArray, FloatArray]:
    """Variance of the residual, values, their covariance, from the columns' products; the last is
    the reading.
    """
    # A column that never moved has a product of zero, or less by rounding
    scale = np.sqrt(np.maximum(np.diag(gram)[:-1], 1e-18))
    inverse = np.linalg.inv(gram[:-1, :-1] / np.outer(scale, scale) + 1e-9 * np.eye(scale.size))
    values = inverse @ (gram[:-1, -1] / scale) / scale
    variance = max(float(gram[-1, -1] - values @ gram[:-1, -1]) / max(1, rows - scale.size), 1e-12)
    return variance, values, variance * inverse / np.outer(scale, scale)
