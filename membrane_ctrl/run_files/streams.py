"""Telemetry as the viewer gets it: the Rerun entities of the table of columns, lines for events,
tables with UTC.

The signals of one plot share one entity: m scalars of one cost the writer and the viewer far less
than m entities of one. `SeriesLines` sets the names of the lines once.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import IntEnum
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from membrane_ctrl.controller import safety
from membrane_ctrl.model import figure_columns, telemetry
from membrane_ctrl.model.arrays import Column, FloatArray
from membrane_ctrl.model.colours import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    VIOLET,
    WHITE,
    YELLOW,
    Colour,
)
from membrane_ctrl.model.columns import (
    BY_GROUP,
    COLUMNS,
    POSITION,
    TRUE_ERROR_COLUMN,
    Group,
    Kind,
    Plot,
    TelemetryColumn,
    columns_of,
    plots_of,
)
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.telemetry import Rows, column


@dataclass(frozen=True, slots=True)
class Line:
    """One signal of a stream: the telemetry field, its name in the legend, its colour and width in
    points.
    """

    field: str
    name: str
    colour: Colour
    width: float = 1.5


@dataclass(frozen=True, slots=True)
class Stream:
    """One Rerun entity of several signals."""

    path: str
    lines: tuple[Line, ...]

    def values(self, rows: Rows) -> FloatArray:
        """(n, lines) block of the stream."""
        return np.stack([column(rows, line.field) for line in self.lines], axis=1)


def _line(each: TelemetryColumn) -> Line:
    return Line(each.name, each.legend, each.colour, each.width)


def _telemetry_streams() -> tuple[Stream, ...]:
    by_entity: dict[str, list[Line]] = {}
    for each in BY_GROUP:
        if each.entity:
            by_entity.setdefault(each.entity, []).append(_line(each))
    return tuple(Stream(path, tuple(lines)) for path, lines in by_entity.items())


# Every column except `mono_s`, the time axis, is in exactly one stream.
STREAMS: tuple[Stream, ...] = _telemetry_streams()


def entities_of(plot: Plot) -> tuple[str, ...]:
    """Return the Rerun entities that a plot shows."""
    return tuple(dict.fromkeys(each.entity for each in columns_of(plot)))


def mean_path(entity: str) -> str:
    """Return the entity of the means of each second of an entity."""
    return f"/overview{entity}"


# Computed here from the rows, so that plots need no arithmetic.
TRUE_ERROR = Stream(TRUE_ERROR_COLUMN.entity, (_line(TRUE_ERROR_COLUMN),))
_ERROR = COLUMNS["error_um"]


def _line_of_second(what: str, colour: Colour, width: float) -> Line:
    return Line("", f"{_ERROR.label}, {what} of a second {_ERROR.unit}", colour, width)


OVERVIEW = Stream(
    mean_path("/loop/error"),
    (
        _line_of_second("least", GREY, 1.0),
        _line_of_second("mean", BLUE, 2.0),
        _line_of_second("greatest", GREY, 1.0),
    ),
)
# A point per second all over the run: the others have every tick around events and one per second
# in quiet times, and a line that changes its density looks as if the mirror had changed.
_MEAN_PLOTS = (POSITION, *plots_of(Group.PUMP, Group.ENVIRONMENT))
_MEANS = frozenset(each.entity for plot in _MEAN_PLOTS for each in columns_of(plot))
MEANS = tuple(
    replace(stream, path=mean_path(stream.path)) for stream in STREAMS if stream.path in _MEANS
)
TRUE_MEAN = replace(TRUE_ERROR, path=mean_path(TRUE_ERROR.path))
DERIVED: tuple[Stream, ...] = (TRUE_ERROR, OVERVIEW, *MEANS, TRUE_MEAN)


def band(band_um: float) -> Stream:
    """The area in which the error is to stay, drawn as the deviation of a line without width."""
    return Stream("/loop/band", (Line("", f"band ±{band_um:g} {_ERROR.unit}", GREEN, 0.0),))


def _figure_stream(plot: Plot) -> Stream:
    shown = figure_columns.figure_columns_of(plot)
    return Stream(shown[0].entity, tuple(map(_line, shown)))


ZERNIKE = _figure_stream(figure_columns.TERMS)
CHANGE = _figure_stream(figure_columns.LOW_ORDERS)
PUMP = _figure_stream(figure_columns.PUMP_CURVE)
VIBRATIONS = _figure_stream(figure_columns.VIBRATIONS)
SAG = _figure_stream(figure_columns.SAG_CHANGE)
RESIDUAL = _figure_stream(figure_columns.SLOPE_RESIDUAL)
QUALITY = _figure_stream(figure_columns.FRINGE_QUALITY)
MODULATION = _figure_stream(figure_columns.MODULATION)
LATENCY = _figure_stream(figure_columns.LATENCY)
SHAPE_STREAMS: tuple[Stream, ...] = (ZERNIKE, RESIDUAL, QUALITY, MODULATION, LATENCY)


# Vertical lines across plots of a fixed height, interrupted by NaN; an entity each, as a legend
# lists only those with data.
MARKS: tuple[Stream, ...] = (
    Stream("/marks/fault", (Line("fault", "fault", RED, 2.0),)),
    Stream("/marks/pause", (Line("pause", "pause, resume", YELLOW),)),
    Stream("/marks/setpoint", (Line("setpoint", "setpoint", ORANGE),)),
    Stream("/marks/command", (Line("command", "command", VIOLET),)),
    Stream("/marks/mark", (Line("mark", "mark", WHITE),)),
)
_MARK_HALF_HEIGHT = 1e3  # in the units of any plot that has them


def mark_lines(
    events: Sequence[tuple[float, Event]],
) -> Iterator[tuple[Stream, Column, FloatArray]]:
    """Each stream of `MARKS` with events, times (3 n,) and values (3 n, 1) that draw a vertical
    line for each.

    `events` are those of a run with their times.
    """
    for stream in MARKS:
        found = [mono_s for mono_s, event in events if event.plot_mark == stream.lines[0].field]
        if found:
            yield stream, *vertical_lines(np.array(found))


def vertical_lines(time_s: Column) -> tuple[Column, FloatArray]:
    """Times (3 n,) and values (3 n, 1) that draw a vertical line at each of n times."""
    values = np.tile([-_MARK_HALF_HEIGHT, _MARK_HALF_HEIGHT, np.nan], time_s.size)
    return (time_s[:, np.newaxis] + [0.0, 0.0, 1e-9]).ravel(), values[:, np.newaxis]


def overview_um(rows: Rows) -> FloatArray:
    """(1, 3) least, mean and greatest error of the rows; NaN if no row has an error."""
    error = column(rows, "error_um")
    error = error[np.isfinite(error)]
    if not error.size:
        return np.full((1, 3), np.nan)
    return np.array([[error.min(), error.mean(), error.max()]])


def mean_row(rows: Rows) -> Rows:
    """(1, fields) mean of each field over the rows that have it; NaN where none has."""
    there = np.isfinite(rows)
    with np.errstate(invalid="ignore"):
        mean: Rows = np.where(there, rows, 0.0).sum(axis=0, keepdims=True) / there.sum(
            axis=0, keepdims=True
        )
    return mean


# Tables for people: times in UTC, names for codes, nulls for absent values.


TIMES = ("mono_s", "time_s", "time_utc")
_COUNTS = ("rows", *(each.name for each in COLUMNS.values() if each.kind is Kind.COUNT))
_TIME_MAX_S = 1e9  # thirty years: a damaged file may hold any time


def _words(codes: type[IntEnum]) -> dict[int, str]:
    return {int(code): code.name.lower() for code in codes}


# By column: the name of each code.
WORDS: dict[str, dict[int, str]] = {
    "state": _words(telemetry.State),
    "shape_state": _words(telemetry.ShapeState),
    "safe_level": _words(telemetry.SafeLevel),
    "fault": {0: "none"} | {rule.code: rule.name for rule in safety.TABLE},
}


def named_table(columns: Mapping[str, NDArray[Any]], origin_utc: datetime) -> pa.Table:
    """Arrow table of columns.

    Parameters
    ----------
    columns : dict of (n,) array
        One of them is `mono_s` or `time_s`: seconds of the run. NaN: no value.
    origin_utc : datetime
        UTC at 0 s of the run.

    Returns
    -------
    pyarrow.Table
        `time_s` and `time_utc` (timestamps to the microsecond), then the other columns: numbers,
        counts as integers, the codes of `WORDS` as dictionary-encoded names. An absent value is
        null.
    """
    time_s = np.asarray(
        columns["mono_s"] if "mono_s" in columns else columns["time_s"], dtype=np.float64
    )
    table = {"time_s": _nullable(time_s), "time_utc": _utc(time_s, origin_utc)}
    for name, values in columns.items():
        if name in WORDS:
            table[name] = _named(values, WORDS[name])
        elif name not in TIMES:
            table[name] = (
                _nullable(values).cast(pa.int64(), safe=False)
                if name in _COUNTS
                else _nullable(values)
            )
    return pa.table(table)


def _nullable(values: NDArray[Any]) -> pa.Array:
    return pa.array(values, from_pandas=True)  # NaN is null


def _utc(time_s: Column, origin_utc: datetime) -> pa.Array:
    possible = np.abs(time_s) < _TIME_MAX_S
    since_us = np.rint(np.where(possible, time_s, 0.0) * 1e6).astype("timedelta64[us]")
    origin = np.datetime64(round(origin_utc.timestamp() * 1e6), "us")
    return pa.array(origin + since_us, pa.timestamp("us", "UTC"), mask=~possible)


def _named(codes: Column, words: Mapping[int, str]) -> pa.Array:
    """Names of codes; one that this version does not know is `code 99`."""
    there = np.isfinite(codes)
    found, places = np.unique(np.where(there, codes, 0.0), return_inverse=True)
    names = [words.get(int(code), f"code {code:g}") for code in found]
    return pa.DictionaryArray.from_arrays(
        pa.array(places.astype(np.int32), mask=~there), pa.array(names, pa.string())
    )
