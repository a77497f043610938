"""The pump's curve from runs of constant commands: the mirror is the flow meter.

    y = sum over commands of f(command) x path(command) - leak path + g pressure + n

The path of a command is the time for which it was given, behind the dead time and the lag of the actuator: whatever
its curve, the flow at each command is one linear unknown. A command reached from above is another unknown than the
same one reached from below. The leak may change within a minute; n is white noise on a random walk.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from membrane_ctrl.model.arrays import FloatArray

_BLOCK_S = 0.1
_BEFORE_S = 8.0  # a flow that was on its way before the first command has arrived by then
_LEAK_S = 40.0  # between the nodes of the leak's course
_WHITEST = 0.97
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
    fixed: FloatArray  # (n, ...): nodes of the leak; the pressure is appended by `fit`
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

    def solved(at: FloatArray, pumping: Sequence[int]) -> tuple[float, FloatArray, FloatArray]:
        rows = [_whitened(block, np.abs(at), has_pressure) for block in blocks]
        design = _side_by_side([part for part, _ in rows], len(levels))
        keep = [*pumping, *range(len(levels), design.shape[1])]
        return _least_squares(design[:, keep], np.hstack([readings for _, readings in rows]))

    every = list(range(len(levels)))

    def cost(at: FloatArray) -> float:
        return solved(at, every)[0] if at[2] < _WHITEST else np.inf

    starts = [np.array([near.delay_s, near.lag_s, near.share_white])] if near is not None else [
        np.array([delay_s, lag_s, 0.8]) for delay_s in _DELAYS_S for lag_s in _LAGS_S
    ]  # fmt: skip
    start = min(starts, key=cost)
    size = 0.15 if near is None else 0.04
    simplex = start + size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -0.6]])
    options = {"maxfev": 60 if near is None else 25, "xatol": 0.003, "initial_simplex": simplex}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x  # type: ignore[call-overload]
    # no pump takes gas out: what looks so is one without flow, and the rest is judged again without it
    pumping, flows = every, dict[Level, FlowAt]()
    while True:
        _, values, sigmas = solved(best, pumping)
        found = {levels[i]: FlowAt(float(values[k]), float(sigmas[k])) for k, i in enumerate(pumping)}
        flows |= {level: FlowAt(max(at.flow_um_per_s, 0.0), at.sigma_um_per_s) for level, at in found.items()}
        none = [i for i in pumping if found[levels[i]].flow_um_per_s < 0]
        if not none:
            break
        pumping = [i for i in pumping if i not in none]
    leaks = -values[len(pumping) : len(pumping) + sum(block.fixed.shape[1] for block in blocks)]
    return PumpFit(flows, float(np.median(leaks)), *(float(abs(x)) for x in best))


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


def _whitened(block: _Blocks, at: FloatArray, has_pressure: bool) -> tuple[FloatArray, FloatArray]:
    """Design and readings behind the actuator, differenced so that the noise is white."""
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
    columns = [paths[-block.displacement_um.size :], block.fixed]
    if has_pressure:
        columns.append(block.pressure_pa[:, None])
    whole_design = np.column_stack((*columns, block.displacement_um))
    steps = lfilter([1.0], [1.0, -white], np.diff(whole_design, axis=0), axis=0)
    return np.asarray(steps[:, :-1]), np.asarray(steps[:, -1])


def _side_by_side(designs: Sequence[FloatArray], shared: int) -> FloatArray:
    """One design: the levels and the pressure are shared, the rest belongs to its run."""
    own = [design[:, shared + 1 :] for design in designs]
    first = np.vstack([design[:, :shared] for design in designs])
    place = np.cumsum([0, *(part.shape[1] for part in own)])
    rows = np.cumsum([0, *(part.shape[0] for part in own)])
    rest = np.zeros((rows[-1], place[-1]))
    for part, (top, bottom), (left, right) in zip(own, pairwise(rows), pairwise(place), strict=True):
        rest[top:bottom, left:right] = part
    before = np.zeros((rows[-1], len(designs)))
    for i, (design, (top, bottom)) in enumerate(zip(designs, pairwise(rows), strict=True)):
        before[top:bottom, i] = design[:, shared]
    return np.hstack((first, rest, before))


def _least_squares(design: FloatArray, readings: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Logarithm of the residual's variance (for the likelihood), values, standard errors."""
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-9)
    normal = (design / scale).T @ (design / scale) + 1e-9 * np.eye(scale.size)
    inverse = np.linalg.inv(normal)
    values = inverse @ ((design / scale).T @ readings) / scale
    residual = readings - design @ values
    variance = float(residual @ residual) / max(1, readings.size - scale.size)
    return float(np.log(variance)), values, np.sqrt(variance * np.diag(inverse)) / scale
