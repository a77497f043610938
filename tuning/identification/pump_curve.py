"""The pump's curve from runs of constant commands: the mirror is the flow meter.

    y = sum over commands of f(command) x path(command) - leak path + g pressure + n

The path of a command is the time for which it was given, behind the dead time and the lag of the actuator: whatever
its curve, the flow at each command is one linear unknown. A command reached from above is another unknown than the
same one reached from below. The leak may change within a minute; n is white noise on a random walk.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_BLOCK_S = 0.1
_BEFORE_S = 8.0  # a flow that was on its way before the first command has arrived by then
_LEAK_S = 40.0  # between the nodes of the leak's course
_LEAK_CHANGES_UM_PER_S = 0.2  # what the weather's slow course looks like: 1.5 mK/s of the air
_BEFORE_UM_PER_S = 0.5  # of the loop's flow from the leak, when a run begins
_WHITEST = 0.995
_ROUGHNESS = np.geomspace(0.5, 2e4, 16)  # of the curve: square of its second derivative, of the full flow
_DELAYS_S, _LAGS_S = (0.05, 0.2, 0.5, 1.0, 1.6, 2.2), (0.1, 0.4, 1.0, 2.0)


@dataclass(frozen=True, slots=True, order=True)
class Level:
    """A constant command, reached from a smaller one or from a larger one."""

    fraction: float
    rising: bool = True


@dataclass(frozen=True, slots=True)
class PumpRun:
    """Commands and readings of one experiment, evenly sampled, arrays (n,); NaN for missing values."""

    dt_s: float
    fraction: FloatArray  # from each reading until the next
    displacement_um: FloatArray
    ambient_pressure_pa: FloatArray


@dataclass(frozen=True, slots=True)
class FlowAt:
    """Flow at a command, um/s, and its standard error."""

    flow_um_per_s: float
    sigma_um_per_s: float


@dataclass(frozen=True, slots=True)
class Branch:
    """Flows in um/s of the commands reached from below, or of those from above, arrays (n,)."""

    fractions: FloatArray
    flows: FloatArray
    sigmas: FloatArray

    @property
    def columns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """All three."""
        return self.fractions, self.flows, self.sigmas


@dataclass(frozen=True, slots=True)
class PumpFit:
    """What the runs say of the pump and the leak."""

    levels: dict[Level, FlowAt]
    leak_um_per_s: float
    delay_s: float
    lag_s: float
    share_white: float  # of the noise: 1 - 1/(blocks that the random walk takes to show)

    @property
    def answer_s(self) -> float:
        """Until a changed command shows its whole flow."""
        return self.delay_s + 3 * self.lag_s


@dataclass(frozen=True, slots=True)
class _Blocks:
    """A run in blocks of `_BLOCK_S`: the paths of its levels before the actuator, beginning before the run."""

    paths: FloatArray  # (before + n, levels + 1); the last is what flowed before
    fixed: FloatArray  # (n, ...): nodes of the leak
    pressure_pa: FloatArray  # (n,)
    displacement_um: FloatArray  # (n,)


def levels_of(run: PumpRun) -> list[Level | None]:
    """The level at each sample; None for no command."""
    found: list[Level | None] = []
    before, level = 0.0, None
    for fraction in np.round(run.fraction, 4).tolist():
        if fraction != before:
            level = Level(fraction, fraction > before) if fraction > 0 else None
            before = fraction
        found.append(level)
    return found


def fit(runs: Sequence[PumpRun], near: PumpFit | None = None) -> PumpFit:
    """Fit the flow at every level of the runs. Begins at the actuator and the noise of `near`, if given.

    Raises ValueError for runs without readings, or too short.
    """
    from scipy.optimize import minimize

    levels = sorted({level for run in runs for level in levels_of(run) if level is not None})
    blocks = [_blocks(run, levels) for run in runs]
    has_pressure = all(np.isfinite(block.pressure_pa).all() for block in blocks)
    heights = [block.displacement_um for block in blocks]
    noise_um = float(np.median(np.abs(np.hstack([np.diff(height, 2) for height in heights])))) / 0.6745 / math.sqrt(6)

    def gram(at: FloatArray) -> FloatArray:
        return np.asarray(sum(_gram(block, np.abs(at), has_pressure, noise_um) for block in blocks))

    rows = sum(height.size for height in heights)

    def cost(at: FloatArray) -> float:
        return math.log(_least_squares(gram(at), rows)[0]) if at[2] < _WHITEST else math.inf

    starts = [np.array([near.delay_s, near.lag_s, near.share_white])] if near is not None else [
        np.array([delay_s, lag_s, 0.95]) for delay_s in _DELAYS_S for lag_s in _LAGS_S
    ]  # fmt: skip
    start = min(starts, key=cost)
    size = 0.15 if near is None else 0.04
    simplex = start + size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -0.6]])
    options = {"maxfev": 60 if near is None else 25, "xatol": 0.003, "initial_simplex": simplex}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x  # type: ignore[call-overload]
    # no pump takes gas out: what looks so is one without flow, and the rest is judged again without it
    whole, keep, none = gram(best), np.arange(len(levels) + 1 + has_pressure + 1), [True]
    flows = dict[Level, FlowAt]()
    while any(none):
        _, values, sigmas = _least_squares(whole[np.ix_(keep, keep)], rows)
        pumping = keep[keep < len(levels)]
        none = [values[k] < 0 for k in range(pumping.size)]
        for k, i in enumerate(pumping.tolist()):
            flows[levels[i]] = FlowAt(max(float(values[k]), 0.0), float(sigmas[k]))
        keep = np.delete(keep, np.flatnonzero(none))
        leak_um_per_s = float(values[pumping.size])
    return PumpFit(flows, leak_um_per_s, *(float(abs(x)) for x in best))


def _blocks(run: PumpRun, levels: Sequence[Level]) -> _Blocks:
    size = max(1, round(_BLOCK_S / run.dt_s))
    count = run.fraction.size // size
    good = np.isfinite(run.displacement_um)
    if count < 10 or not good.any():
        raise ValueError("a run of the pump without readings, or too short")

    def mean(column: FloatArray) -> FloatArray:
        return np.asarray(column[: count * size].reshape(count, size, *column.shape[1:]).mean(axis=1))

    index = {level: i for i, level in enumerate(levels)}
    on = np.zeros((run.fraction.size + 1, len(levels)))
    for tick, level in enumerate(levels_of(run), start=1):
        if level is not None:
            on[tick, index[level]] = run.dt_s
    before = np.zeros((round(_BEFORE_S / (size * run.dt_s)), len(levels)))
    paths = np.vstack((before, mean(np.cumsum(on, axis=0)[:-1])))
    time_s = size * run.dt_s * np.arange(-before.shape[0], count)
    paths = np.column_stack((paths, np.minimum(time_s, 0.0)))
    now_s = time_s[before.shape[0] :]
    nodes = np.linspace(0.0, now_s[-1], 1 + max(1, round(now_s[-1] / _LEAK_S)))
    hats = np.column_stack([np.interp(now_s, nodes, unit) for unit in np.eye(nodes.size)])
    filled = np.interp(np.arange(good.size), np.flatnonzero(good), run.displacement_um[good])
    return _Blocks(paths, np.cumsum(hats, axis=0) * size * run.dt_s, mean(run.ambient_pressure_pa), mean(filled))


def _gram(block: _Blocks, at: FloatArray, has_pressure: bool, noise_um: float) -> FloatArray:
    """Products of the columns levels, leak, (pressure,) height of a run, after what belongs to this run alone.

    These are the course of the leak, what the pump gave before the run, and the noise of the first reading.
    """
    paths, nodes, rest = np.split(
        _whitened(block, at), np.cumsum([block.paths.shape[1], block.fixed.shape[1]]), axis=1
    )
    levels, before = paths[:, :-1], paths[:, -1:]
    leak = before - nodes.sum(axis=1, keepdims=True)  # before the run the pump gave what leaks
    shared = np.hstack((levels, leak, rest if has_pressure else rest[:, 1:]))
    first = at[2] ** np.arange(1, before.size + 1)[:, None]
    own = np.hstack((nodes, before, first))
    spread = np.array([*[_LEAK_CHANGES_UM_PER_S] * nodes.shape[1], _BEFORE_UM_PER_S, noise_um])
    across = own.T @ shared
    return np.asarray(
        shared.T @ shared - across.T @ np.linalg.solve(own.T @ own + np.diag((noise_um / spread) ** 2), across)
    )


def _whitened(block: _Blocks, at: FloatArray) -> FloatArray:
    """Paths behind the actuator, leak, pressure and height, differenced so that the noise is white."""
    from scipy.signal import lfilter

    delay_s, lag_s, white = at
    late = delay_s / _BLOCK_S
    whole, part = int(late), late - int(late)
    held = np.vstack((np.repeat(block.paths[:1], whole + 1, axis=0), block.paths))
    if block.paths.shape[0] > 1:  # what flowed before had flowed forever
        held[: whole + 1, -1] -= _BLOCK_S * np.arange(whole + 1, 0, -1)
    rows = block.paths.shape[0]
    paths = (1 - part) * held[1 : rows + 1] + part * held[:rows]
    keep = np.exp(-_BLOCK_S / max(lag_s, 1e-3))
    paths = lfilter([1 - keep], [1, -keep], paths - paths[0], axis=0)
    arrived = paths[-block.displacement_um.size :]
    columns = np.column_stack((arrived, block.fixed, np.nan_to_num(block.pressure_pa), block.displacement_um))
    return np.asarray(lfilter([1.0], [1.0, -white], np.diff(columns, axis=0), axis=0))


def _least_squares(gram: FloatArray, rows: int) -> tuple[float, FloatArray, FloatArray]:
    """Variance of the residual, values, standard errors, from the columns' products; the last is the reading."""
    scale = np.maximum(np.sqrt(np.diag(gram)[:-1]), 1e-9)
    inverse = np.linalg.inv(gram[:-1, :-1] / np.outer(scale, scale) + 1e-9 * np.eye(scale.size))
    values = inverse @ (gram[:-1, -1] / scale) / scale
    variance = max(float(gram[-1, -1] - values @ gram[:-1, -1]) / max(1, rows - scale.size), 1e-12)
    return variance, values, np.sqrt(variance * np.diag(inverse)) / scale


def smoothed(fractions: FloatArray, flows: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The likeliest cubic smoothing spline through noisy flows, and its standard errors (Wahba 1978)."""
    x, full = fractions - fractions[0], max(float(flows.max()), 1e-3)
    low, high = np.minimum.outer(x, x), np.maximum.outer(x, x)
    bend, line = low**2 * (3 * high - low) / 6, 10.0 * (1 + np.outer(x, x))
    noise = np.diag((sigmas / full) ** 2)

    def unlikely(roughness: float) -> float:
        covariance = line + roughness * bend + noise
        y = flows / full
        return float(y @ np.linalg.solve(covariance, y) + np.linalg.slogdet(covariance)[1])

    free = line + min(_ROUGHNESS.tolist(), key=unlikely) * bend
    weights = np.linalg.solve(free + noise, free).T
    return weights @ flows, full * np.sqrt(np.maximum(np.diag(free - weights @ free), 1e-12))
