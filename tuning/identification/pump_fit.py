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
# Of the leak's course: the weather's slow course looks like it; the last is 1.5 mK/s of the air.
_LEAK_CHANGES_UM_PER_S = (0.02, 0.06, 0.2)
_BEFORE_UM_PER_S = 0.5  # of the loop's flow from the leak, when a run begins
_WHITES = (0.9, 0.97, 0.99, 0.997, 0.9995)
_SHARE_BEFORE_RUNS = 0.8  # of white noise, before any run
_DELAYS_S = (0.05, 0.2, 0.5, 1.0, 1.6, 2.2)
_LAGS_S = (0.1, 0.4, 1.0, 2.0)
_GRID = tuple(product(_DELAYS_S, _LAGS_S))  # actuators at which the search begins
_TURNS = 8  # of the likelihood's search
_ENOUGH = 0.2  # smaller falls of the cost end it
_OFF = np.array([-3, -2])  # columns of delay and lag
_OFF_S = 1.0  # 1 sigma of delay and lag about where they are, before the runs
_SLOPE_S = 0.05  # step of the derivatives by delay and lag
_LEAST_S = 0.01  # delay and lag stay between these
_MOST_S = 4.0
_STEP_SHARES = (1.0, 0.4, 0.1)  # of Gauss and Newton's step, tried in this order
_BLOCKS_LEAST = 10  # of a run
# A column that never moved has a product of zero, or less by rounding.
_LEAST_PRODUCT = 1e-18
_RIDGE = 1e-9  # added to the scaled products, whose diagonal is 1: two equal columns stay solvable
_LEAST_VARIANCE_UM2 = 1e-12


@dataclass(frozen=True, slots=True)
class FlowAt:
    """Flow at a command, µm/s, and its standard error."""

    flow_um_per_s: float
    sigma_um_per_s: float


@dataclass(frozen=True, slots=True)
class PumpFit:
    """Pump and leak by a set of runs.

    Attributes
    ----------
    levels : dict
        Flow at each level.
    covariance : (levels, levels) array
        Of these flows, in their order.
    leak_um_per_s : float
        Mean loss of gas.
    delay_s, lag_s : float
        Dead time and lag of the actuator.
    share_white : float
        Of the noise: 1 - 1 / (blocks that the random walk takes to show).
    leak_changes_um_per_s : float
        Standard deviation of the leak within a run.
    """

    levels: dict[Level, FlowAt]
    covariance: FloatArray
    leak_um_per_s: float
    delay_s: float
    lag_s: float
    share_white: float
    leak_changes_um_per_s: float = _LEAK_CHANGES_UM_PER_S[-1]

    @classmethod
    def empty(cls) -> "PumpFit":
        """The fit before any run: no level, no leak, no delay."""
        return cls({}, np.empty((0, 0)), 0.0, 0.0, 0.0, _SHARE_BEFORE_RUNS)

    @property
    def likeliest(self) -> tuple[float, float, float, float]:
        """Delay, lag, noise, changes of the leak."""
        return self.delay_s, self.lag_s, self.share_white, self.leak_changes_um_per_s

    @property
    def answer_s(self) -> float:
        """Until a changed command shows its whole flow."""
        return self.delay_s + 3 * self.lag_s


@dataclass(frozen=True, slots=True)
class _Blocks:
    """A run in blocks of `BLOCK_S`: means of the readings, and the paths of its levels.

    Attributes
    ----------
    columns : list of int
        Which of all levels these are.
    paths : (before + n, levels + 1) array
        Time for which each level was given before the actuator, s, beginning before the run; the
        last column is the path of what flowed before the run.
    leak : (n, nodes) array
        Paths of the nodes of the leak's course, s.
    pressure_pa : (n,) array
        Ambient pressure.
    displacement_um : (n,) array
        Readings.
    """

    columns: list[int]
    paths: FloatArray
    leak: FloatArray
    pressure_pa: FloatArray
    displacement_um: FloatArray


@dataclass(frozen=True, slots=True)
class _Flows:
    """The linear unknowns behind an actuator, and how likely they are.

    Attributes
    ----------
    delay_s, lag_s : float
        Of the actuator.
    white, leak_changes_um_per_s : float
        The noise, as in `PumpFit`.
    cost : float
        Twice the negative log likelihood.
    values, covariance : (k,), (k, k) arrays
        Flow of each level, leak, effect of the pressure; and by how much delay and lag are off, if
        these were free.
    """

    delay_s: float
    lag_s: float
    white: float
    leak_changes_um_per_s: float
    cost: float
    values: FloatArray
    covariance: FloatArray

    def differs_by_at_most_one(self, white: float, leak_changes_um_per_s: float) -> bool:
        """Whether at most one of the two differs."""
        return white == self.white or leak_changes_um_per_s == self.leak_changes_um_per_s


def fit_pump(runs: Sequence[PumpRun], near: PumpFit | None = None) -> PumpFit:
    """Fit the flow at every level of the runs.

    Parameters
    ----------
    runs : sequence of PumpRun
        Runs of constant commands.
    near : PumpFit, optional
        An earlier fit, at whose actuator and noise the search begins.

    Returns
    -------
    PumpFit

    Raises
    ------
    ValueError
        A run has no readings, or is too short.
    """
    levels = sorted({level for run in runs for level in list_levels(run) if level is not None})
    mirror = _Mirror([_make_blocks(run, levels) for run in runs], len(levels))

    # The best of a grid of actuators, at one noise.
    starts = [(delay_s, lag_s, _WHITES[1], _LEAK_CHANGES_UM_PER_S[-1]) for delay_s, lag_s in _GRID]
    if near is not None:
        starts = [near.likeliest]
    best = min((mirror.solve_flows(*start) for start in starts), key=_cost)

    # Better noise or a better actuator, one after the other, until the likelihood hardly grows.
    for _ in range(_TURNS):
        noises = product(_WHITES, _LEAK_CHANGES_UM_PER_S)
        tried = (
            mirror.solve_flows(best.delay_s, best.lag_s, *noise)
            for noise in noises
            if best.differs_by_at_most_one(*noise)
        )
        better = min((mirror.improve_delay_and_lag(best), *tried), key=_cost)
        is_good_enough = best.cost - better.cost < _ENOUGH
        best = better
        if is_good_enough:
            break
    return mirror.make_fit(best, levels)


class _Mirror:
    """The mirror as a flow meter: the likelihood of its runs behind an actuator and in noise.

    Delay and lag are linear unknowns as well, about where they are: Gauss and Newton's step, and
    their share of the errors.
    """

    def __init__(self, blocks: Sequence[_Blocks], levels: int) -> None:
        self._blocks = blocks
        self._levels = levels
        self._has_pressure = all(np.isfinite(block.pressure_pa).all() for block in blocks)
        # Second differences of white noise have sqrt(6) times its standard deviation; their median
        # absolute value is 0.6745 of that.
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
        """Solve for the flows behind an actuator.

        Parameters
        ----------
        delay_s, lag_s, white, changes : float
            As in `PumpFit`.
        flows : (k,) array, optional
            Flow of each level; with these also by how much delay and lag are off.
        """
        gram, determinant = self._gram_matrix((delay_s, lag_s, white), changes, flows)

        # The cost compares actuators, so it must not contain the freedom of delay and lag: it is
        # computed without their columns. The errors of the flows must contain it.
        without_off = np.delete(np.delete(gram, _OFF, axis=0), _OFF, axis=1)
        variance, values, covariance = _least_squares(without_off, self._rows)
        cost = determinant + self._rows * math.log(variance)
        if flows is not None:
            gram[_OFF, _OFF] += self._noise_um**2 / _OFF_S**2
            _, values, covariance = _least_squares(gram, self._rows)
        return _Flows(delay_s, lag_s, white, changes, cost, values, covariance)

    def improve_delay_and_lag(self, best: _Flows) -> _Flows:
        """With a better delay and lag, if there are any."""
        # The step of Gauss and Newton is too long where the likelihood is far from a parabola: a
        # shorter one is tried before giving up.
        noise = best.white, best.leak_changes_um_per_s
        off_s = self.solve_flows(best.delay_s, best.lag_s, *noise, best.values).values[-2:]
        for share in _STEP_SHARES:
            moved_s = (best.delay_s, best.lag_s) + share * off_s
            delay_s, lag_s = np.clip(moved_s, _LEAST_S, _MOST_S).tolist()
            found = self.solve_flows(delay_s, lag_s, *noise)
            if found.cost < best.cost:
                return found
        return best

    def make_fit(self, best: _Flows, levels: Sequence[Level]) -> PumpFit:
        """The flows of the levels, with the share of delay and lag in their errors."""
        noise = best.white, best.leak_changes_um_per_s
        found = self.solve_flows(best.delay_s, best.lag_s, *noise, best.values)
        count = len(levels)
        covariance = found.covariance[:count, :count]
        flows_um_per_s = found.values[:count].tolist()
        sigmas_um_per_s = np.sqrt(np.diag(covariance)).tolist()
        flows = {
            level: FlowAt(flow, sigma)
            for level, flow, sigma in zip(levels, flows_um_per_s, sigmas_um_per_s, strict=True)
        }
        leak_um_per_s = float(found.values[count])
        return PumpFit(flows, covariance, leak_um_per_s, best.delay_s, best.lag_s, *noise)

    def _gram_matrix(
        self, at: tuple[float, float, float], changes: float, flows: FloatArray | None
    ) -> tuple[FloatArray, float]:
        """Products of the columns of all runs, and the determinant in the likelihood.

        Parameters
        ----------
        at : (float, float, float)
            Delay (s), lag (s) and noise.
        changes : float
            Standard deviation of the leak within a run, µm/s.
        flows : (k,) array, optional
            Flow of each level, for the columns of delay and lag; these are 0 without.

        Returns
        -------
        gram : (levels + 5, levels + 5) array
            Columns: levels, leak, pressure, delay, lag, displacement.
        determinant : float
            Its logarithm.
        """
        common = self._levels + np.arange(5)
        size = self._levels + len(common)
        whole = np.zeros((size, size))
        determinant = 0.0
        # Each run contributes its products, with the numbers that only it has eliminated.
        for block in self._blocks:
            flows_of_run = np.zeros(len(block.columns) + 1)
            if flows is not None:
                flows_of_run = flows[[*block.columns, self._levels]]
            columns = _whiten_columns(block, at, flows_of_run, self._has_pressure)
            noises = (self._noise_um, changes)
            gram, logarithm = _eliminate_own(columns, block.leak.shape[1], at[2], noises)
            where = np.append(block.columns, common).astype(int)
            whole[np.ix_(where, where)] += gram
            determinant += logarithm
        return whole, determinant


def _cost(found: _Flows) -> float:
    return found.cost


def _make_blocks(run: PumpRun, levels: Sequence[Level]) -> _Blocks:
    """Average a run over blocks. Raises ValueError if it has no readings, or is too short."""
    size = max(1, round(BLOCK_S / run.dt_s))
    block_s = size * run.dt_s
    count = run.fraction.size // size
    has_reading = np.isfinite(run.displacement_um)
    if count < _BLOCKS_LEAST or not has_reading.any():
        raise ValueError("a run of the pump without readings, or too short")

    def average_blocks(column: FloatArray) -> FloatArray:
        """Means (count, ...) of values (ticks, ...)."""
        blocks = column[: count * size].reshape(count, size, *column.shape[1:])
        return np.asarray(blocks.mean(axis=1))

    # Path of each level: the time for which it was given so far.
    given = list_levels(run)
    own = sorted({level for level in given if level is not None})
    time_on_s = np.zeros((run.fraction.size + 1, len(own)))
    for tick, level in enumerate(given, start=1):
        if level is not None:
            time_on_s[tick, own.index(level)] = run.dt_s
    before = np.zeros((round(_BEFORE_S / block_s), len(own)))
    during = average_blocks(np.cumsum(time_on_s, axis=0)[:-1])
    paths = np.vstack((before, during))

    # The leak's course is linear between nodes; hats are 1 at one node and 0 at the others.
    time_s = block_s * np.arange(-before.shape[0], count)
    now_s = time_s[before.shape[0] :]
    intervals = max(1, round(now_s[-1] / _LEAK_S))
    nodes_s = np.linspace(0.0, now_s[-1], 1 + intervals)
    hats = np.column_stack([np.interp(now_s, nodes_s, unit) for unit in np.eye(nodes_s.size)])

    # Missing readings are interpolated.
    ticks = np.arange(has_reading.size)
    ticks_with_reading = np.flatnonzero(has_reading)
    filled_um = np.interp(ticks, ticks_with_reading, run.displacement_um[has_reading])
    return _Blocks(
        columns=[levels.index(level) for level in own],
        paths=np.column_stack((paths, np.minimum(time_s, 0.0))),
        leak=np.cumsum(hats, axis=0) * size * run.dt_s,
        pressure_pa=average_blocks(run.ambient_pressure_pa),
        displacement_um=average_blocks(filled_um),
    )


def _delay_paths(paths: FloatArray, delay_s: float, lag_s: float) -> FloatArray:
    """Paths (n, k) behind the actuator; what flows at the beginning had flowed forever."""
    from scipy.signal import lfilter

    # The paths continued to earlier times with their first slope.
    delay_blocks = delay_s / BLOCK_S
    whole = int(delay_blocks)
    part = delay_blocks - whole
    slope = paths[1] - paths[0]
    earlier = paths[0] - slope * np.arange(whole + 1, 0, -1)[:, None]
    extended = np.vstack((earlier, paths))

    # Delayed by whole blocks and a part of one, between whose ends they are linear.
    rows = paths.shape[0]
    delayed = (1 - part) * extended[1 : rows + 1] + part * extended[:rows]

    # The lag: a first-order filter, from rest.
    keep = math.exp(-BLOCK_S / lag_s)
    return np.asarray(lfilter([1 - keep], [1, -keep], delayed - delayed[0], axis=0))


def _whiten_columns(
    block: _Blocks, at: tuple[float, float, float], flows: FloatArray, has_pressure: bool
) -> FloatArray:
    """Columns of a run, differenced so that their noise is white.

    Parameters
    ----------
    block : _Blocks
        The run.
    at : (float, float, float)
        Delay (s), lag (s) and noise.
    flows : (levels + 1,) array
        Flow at each level and before the run, for the columns of delay and lag.
    has_pressure : bool
        Whether all runs have the ambient pressure.

    Returns
    -------
    (n - 1, k) array
        Levels, before, leak, pressure, delay, lag, displacement. Those of delay and lag are what a
        second more of them changes.
    """
    from scipy.signal import lfilter

    delay_s, lag_s, white = at
    count = block.displacement_um.size

    # Derivatives of the driven displacement by delay and by lag, by differences.
    driven_um = block.paths @ flows[:, None]
    here_um = _delay_paths(driven_um, delay_s, lag_s)
    by_delay = (_delay_paths(driven_um, delay_s + _SLOPE_S, lag_s) - here_um) / _SLOPE_S
    by_lag = (_delay_paths(driven_um, delay_s, lag_s + _SLOPE_S) - here_um) / _SLOPE_S

    pressure_pa = np.zeros(count)
    if has_pressure:
        pressure_pa = block.pressure_pa
    columns = np.column_stack(
        (
            _delay_paths(block.paths, delay_s, lag_s)[-count:],
            block.leak,
            pressure_pa,
            by_delay[-count:],
            by_lag[-count:],
            block.displacement_um,
        )
    )

    # Differences make the random walk white; the filter does the same for white noise on it.
    return np.asarray(lfilter([1.0], [1.0, -white], np.diff(columns, axis=0), axis=0))


def _eliminate_own(
    columns: FloatArray, nodes: int, white: float, noises: tuple[float, float]
) -> tuple[FloatArray, float]:
    """Products of a run's columns after the elimination of the unknowns that are its own.

    These are the course of the leak, what the pump gave before the run, and the noise of the first
    reading.

    Parameters
    ----------
    columns : (n, k) array
        As `_whiten_columns` gives them.
    nodes : int
        Of the leak's course.
    white : float
        The noise.
    noises : (float, float)
        Standard deviation of a reading, µm, and of the leak within the run, µm/s.

    Returns
    -------
    gram : (levels + 5, levels + 5) array
        Columns: levels, leak, pressure, delay, lag, displacement.
    determinant : float
        Logarithm of the determinant of what was eliminated, over that of its prior.
    """
    paths, leak, rest = np.split(columns, (-4 - nodes, -4), axis=1)
    levels = paths[:, :-1]
    before = paths[:, -1:]

    # Unknowns shared by all runs. Before the run the pump gave what leaks.
    mean_leak = before - leak.sum(axis=1, keepdims=True)
    shared = np.hstack((levels, mean_leak, rest))

    # The run's own, with their spreads before the run.
    first_reading = white ** np.arange(1, before.size + 1)[:, None]
    own = np.hstack((leak, before, first_reading))
    noise_um, leak_um_per_s = noises
    spread = np.array([*[leak_um_per_s] * nodes, _BEFORE_UM_PER_S, noise_um])
    prior = (noise_um / spread) ** 2

    # Schur's complement over the run's own unknowns.
    across = own.T @ shared
    inner = own.T @ own + np.diag(prior)
    gram = shared.T @ shared - across.T @ np.linalg.solve(inner, across)
    determinant = np.linalg.slogdet(inner)[1] - np.log(prior).sum()
    return np.asarray(gram), float(determinant)


def _least_squares(gram: FloatArray, rows: int) -> tuple[float, FloatArray, FloatArray]:
    """Least squares from the products (k + 1, k + 1) of the columns; the last is the reading.

    Returns
    -------
    variance : float
        Of the residual.
    values, covariance : (k,), (k, k) arrays
    """
    # Scaled to a unit diagonal.
    scale = np.sqrt(np.maximum(np.diag(gram)[:-1], _LEAST_PRODUCT))
    scales = np.outer(scale, scale)
    inverse = np.linalg.inv(gram[:-1, :-1] / scales + _RIDGE * np.eye(scale.size))
    values = inverse @ (gram[:-1, -1] / scale) / scale

    # The residual's sum of squares over its degrees of freedom.
    square = float(gram[-1, -1] - values @ gram[:-1, -1])
    freedom = max(1, rows - scale.size)
    variance = max(square / freedom, _LEAST_VARIANCE_UM2)
    return variance, values, variance * inverse / scales
