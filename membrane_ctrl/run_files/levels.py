"""Overview levels: minimum, mean and maximum of each signal per 1, 10 and 60 s, so that a month
opens in seconds.

A level is a dict of columns: `time_s` (start of the window, a multiple of its length), `rows`
(ticks in it), the codes at its end (of some the largest), `min_<signal>`, `mean_<signal>`,
`max_<signal>`, and of some signals `std_<signal>`, the standard deviation of its ticks.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.model import telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.columns import AGGREGATED, COLUMNS, TRUE_ERROR_COLUMN, Aggregation, Kind
from membrane_ctrl.model.state_tree import ArrayShape, StateNode
from membrane_ctrl.run_files.figure_minutes import OpenFigureMinute

Columns = dict[str, Column]
_StoredColumns = dict[str, Annotated[Column, ArrayShape((-1,))]]

WINDOWS_S: tuple[float, ...] = (1.0, 10.0, 60.0)
# Minimum, mean and maximum of these, and the codes, by the table of columns.
SIGNALS: tuple[str, ...] = tuple(each.name for each in AGGREGATED)
# Of these also the standard deviation of the ticks: that of a month follows from its windows.
SPREAD_SIGNALS: tuple[str, ...] = ("error_um", TRUE_ERROR_COLUMN.name)
CODES: tuple[str, ...] = tuple(each.name for each in COLUMNS.values() if each.kind is Kind.CODE)
_LARGEST = tuple(name for name in CODES if COLUMNS[name].aggregation is Aggregation.LARGEST)
NAMES: tuple[str, ...] = (
    "time_s",
    "rows",
    *CODES,
    *(f"{kind}_{name}" for name in SIGNALS for kind in ("min", "mean", "max")),
    *(f"std_{name}" for name in SPREAD_SIGNALS),
)
# The telemetry fields from which levels are computed, each once.
_RECORDED_SIGNALS = tuple(name for name in SIGNALS if name in COLUMNS)
_OF_TRUE_ERROR = ("target_um", "truth_displacement_um")
TICK_FIELDS: tuple[str, ...] = tuple(
    dict.fromkeys(("mono_s", *CODES, *_RECORDED_SIGNALS, *_OF_TRUE_ERROR))
)
# Share of a window within which a time counts as the window's start: 59.9999999 means 60.
_ROUNDING = 1e-9


def first_level(ticks: Mapping[str, Column]) -> Columns:
    """The 1 s level of consecutive ticks.

    Parameters
    ----------
    ticks : mapping of str to (n,) array
        `TICK_FIELDS` of the ticks, in order of time.

    Returns
    -------
    dict of str to (windows,) array
        `NAMES`; incomplete windows are included.
    """
    time_s = ticks["mono_s"]
    if not time_s.size:
        return {name: np.empty(0) for name in NAMES}
    starts, window = _find_windows(time_s, WINDOWS_S[0])
    # Times, numbers of ticks, and codes at the end of each window.
    level: Columns = {"time_s": window, "rows": _count_rows(starts, time_s.size)}
    level |= _reduce_codes(ticks, starts)
    # Extremes and means of the signals, and the spread of some.
    for name in SIGNALS:
        if name == TRUE_ERROR_COLUMN.name:
            values = telemetry.true_error_um(ticks)
        else:
            values = ticks[name]
        level[f"min_{name}"] = np.fmin.reduceat(values, starts)
        mean = _weighted_mean(values, np.ones(values.size), starts)
        level[f"mean_{name}"] = mean
        level[f"max_{name}"] = np.fmax.reduceat(values, starts)
        if name in SPREAD_SIGNALS:
            squares = (values - _repeat_windows(mean, starts, values.size)) ** 2
            variance = _weighted_mean(squares, np.ones(values.size), starts)
            level[f"std_{name}"] = np.sqrt(variance)
    return level


def coarser_level(level: Mapping[str, Column], window_s: float) -> Columns:
    """Make a level of longer windows from a finer one; means are weighted by the number of ticks.

    The coarser level lacks the signals and codes that the finer one lacks.

    Parameters
    ----------
    level : mapping of (windows,) arrays
        Columns of the finer level.
    window_s : float
        Length of the new windows.
    """
    if not level["time_s"].size:
        return {name: np.empty(0) for name in level}
    # Extremes of extremes, means of means by their ticks; the spread needs the new means first
    starts, window = _find_windows(level["time_s"], window_s)
    coarse: Columns = {"time_s": window, "rows": np.add.reduceat(level["rows"], starts)}
    coarse |= _reduce_codes(level, starts)
    for name, values in level.items():
        if name.startswith("mean_"):
            coarse[name] = _weighted_mean(values, level["rows"], starts)
        elif name.startswith("min_"):
            coarse[name] = np.fmin.reduceat(values, starts)
        elif name.startswith("max_"):
            coarse[name] = np.fmax.reduceat(values, starts)
    for name in SPREAD_SIGNALS:
        if {f"std_{name}", f"mean_{name}"} <= level.keys():
            coarse[f"std_{name}"] = _coarser_std(level, coarse, name, starts)
    return coarse


def _coarser_std(
    level: Mapping[str, Column],
    coarse: Mapping[str, Column],
    name: str,
    starts: NDArray[np.intp],
) -> Column:
    """Standard deviation of a signal in coarser windows.

    The variance of a window is the mean of the variances within its parts, and of the squared
    distances of their means from its own, both weighted by the number of ticks.
    """
    means = level[f"mean_{name}"]
    distance = means - _repeat_windows(coarse[f"mean_{name}"], starts, means.size)
    squares = level[f"std_{name}"] ** 2 + distance**2
    return np.sqrt(_weighted_mean(squares, level["rows"], starts))


def _repeat_windows(values: Column, starts: NDArray[np.intp], size: int) -> Column:
    """The value of its window for each of `size` rows."""
    row_counts = np.diff(np.append(starts, size))
    return np.repeat(values, row_counts)


def _find_windows(time_s: Column, window_s: float) -> tuple[NDArray[np.intp], Column]:
    """First row of each non-empty window, and the windows' starts in s."""
    number = _window_numbers(time_s, window_s)
    is_first = np.concatenate(([True], number[1:] != number[:-1]))
    starts = np.flatnonzero(is_first)
    return starts, number[starts] * window_s


def _window_numbers(time_s: Column, window_s: float) -> Column:
    return np.asarray(np.floor(time_s / window_s + _ROUNDING))


def _count_rows(starts: NDArray[np.intp], size: int) -> Column:
    return np.diff(np.append(starts, size)).astype(np.float64)


def _reduce_codes(table: Mapping[str, Column], starts: NDArray[np.intp]) -> Columns:
    """The codes at the end of each window; of those in `_LARGEST` the largest."""
    size = next(iter(table.values())).size
    last = np.append(starts[1:], size) - 1
    reduced: Columns = {}
    for name in CODES:
        if name not in table:
            continue
        if name in _LARGEST:
            reduced[name] = np.fmax.reduceat(table[name], starts)
        else:
            reduced[name] = np.asarray(table[name], dtype=np.float64)[last]
    return reduced


def _weighted_mean(values: Column, weights: Column, starts: NDArray[np.intp]) -> Column:
    """Mean of the finite values of each window; NaN for a window without any."""
    is_finite = np.isfinite(values)
    total = np.add.reduceat(np.where(is_finite, weights, 0.0), starts)
    # Sums are relative to the window's first value: a double then holds 1e5 Pa and a change of mPa
    # without loss.
    base = np.where(is_finite, values, 0.0)[starts]
    offset = _repeat_windows(base, starts, values.size)
    weighted = np.where(is_finite, (values - offset) * weights, 0.0)
    divisor = np.where(total > 0, total, 1.0)
    mean = base + np.add.reduceat(weighted, starts) / divisor
    return np.where(total > 0, mean, np.nan)


def _no_ticks() -> Columns:
    return {name: np.empty(0) for name in TICK_FIELDS}


@dataclass(slots=True)
class OpenWindows(StateNode):
    """Unfinished windows of the overview, which a successor of a dead recorder needs to finish."""

    ticks: _StoredColumns = field(default_factory=_no_ticks)  # rows of the open 1 s window
    # by the coarser window in s: rows of the finer level in its open window
    levels: dict[float, _StoredColumns] = field(default_factory=dict)
    figures: OpenFigureMinute = field(default_factory=OpenFigureMinute)

    def __post_init__(self) -> None:
        """Check the columns, which may have been read from a file.

        Raises
        ------
        ValueError
            A column is missing or unknown, or of another length than the others.
        """
        _require_columns(self.ticks, TICK_FIELDS)
        for window_s, rows in self.levels.items():
            if window_s not in WINDOWS_S[1:]:
                raise ValueError(f"no level has windows of {window_s:g} s")
            _require_columns(rows, NAMES)

    def finished_rows(self, new: Columns | None) -> Iterator[tuple[float, Columns]]:
        """Add ticks, and yield the finished rows of each level.

        Parameters
        ----------
        new : dict of str to (n,) array, or None
            `TICK_FIELDS` of the ticks after the last ones; None at the end of the run, when all
            windows are finished.

        Yields
        ------
        tuple of float and dict of str to (rows,) array
            The level's window in s, and its finished rows.
        """
        # Ticks become rows of the finest level; those of the last window wait.
        is_over = new is None
        ticks = self.ticks
        if new is not None:
            ticks = {name: np.concatenate((ticks[name], new[name])) for name in TICK_FIELDS}
        done = _finished_count(ticks["mono_s"], WINDOWS_S[0], is_over)
        finished, self.ticks = _split_rows(ticks, done)
        level = first_level(finished)
        yield WINDOWS_S[0], level
        # Each level is made from the finished rows of the finer one.
        for coarse_s in WINDOWS_S[1:]:
            waiting = self.levels.get(coarse_s)
            if waiting is not None:
                level = {name: np.concatenate((waiting[name], level[name])) for name in NAMES}
            done = _finished_count(level["time_s"], coarse_s, is_over)
            finished, self.levels[coarse_s] = _split_rows(level, done)
            level = coarser_level(finished, coarse_s)
            yield coarse_s, level


def _require_columns(rows: Columns, names: tuple[str, ...]) -> None:
    if rows.keys() != set(names):
        raise ValueError(f"other columns than {', '.join(names)}")
    if len({values.size for values in rows.values()}) > 1:
        raise ValueError("columns of different lengths")


def _finished_count(time_s: Column, window_s: float, is_over: bool) -> int:
    """Number of rows in finished windows: during the run, those before the last window."""
    if is_over or not time_s.size:
        return time_s.size
    number = _window_numbers(time_s, window_s)
    return int(np.searchsorted(number, number[-1]))


def _split_rows(table: Columns, count: int) -> tuple[Columns, Columns]:
    """The first `count` rows of a table, and the others."""
    first = {name: values[:count] for name, values in table.items()}
    others = {name: values[count:] for name, values in table.items()}
    return first, others
