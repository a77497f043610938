"""Rerun entities of the telemetry columns: their lines, names and colours.

The signals of one plot share one entity: m scalars of one entity cost the writer and the viewer far
less than m entities of one. `SeriesLines` sets the names of the lines once.
"""

from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.model import figure_columns
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import (
    BLUE,
    GREEN,
    GREY,
    Colour,
)
from membrane_ctrl.model.columns import (
    BY_GROUP,
    COLUMNS,
    POSITION,
    TRUE_ERROR_COLUMN,
    Group,
    Plot,
    TelemetryColumn,
    columns_of,
    plots_of,
)
from membrane_ctrl.model.telemetry import Rows, get_column

_ERROR = COLUMNS["error_um"]
# A point per second all over the run: the others have every tick around events and one per second
# in quiet times, and a line that changes its density looks as if the mirror had changed.
_MEAN_PLOTS = (POSITION, *plots_of(Group.PUMP, Group.ENVIRONMENT))
_MEANS = frozenset(each.entity for plot in _MEAN_PLOTS for each in columns_of(plot))


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

    def select_values(self, rows: Rows) -> FloatArray:
        """(n, lines) block of the stream."""
        return np.stack([get_column(rows, line.field) for line in self.lines], axis=1)


def _make_line(each: TelemetryColumn) -> Line:
    return Line(each.name, each.legend, each.colour, each.width)


def _telemetry_streams() -> tuple[Stream, ...]:
    by_entity: dict[str, list[Line]] = {}
    for each in BY_GROUP:
        if each.entity:
            by_entity.setdefault(each.entity, []).append(_make_line(each))
    return tuple(Stream(path, tuple(lines)) for path, lines in by_entity.items())


def mean_path(entity: str) -> str:
    """Return the entity of the means of each second of an entity."""
    return f"/overview{entity}"


def _line_of_second(what: str, colour: Colour, width: float) -> Line:
    return Line("", f"{_ERROR.label}, {what} of a second {_ERROR.unit}", colour, width)


def _figure_stream(plot: Plot) -> Stream:
    shown = figure_columns.figure_columns_of(plot)
    return Stream(shown[0].entity, tuple(map(_make_line, shown)))


# Every column except `mono_s`, the time axis, is in exactly one stream.
STREAMS: tuple[Stream, ...] = _telemetry_streams()
# Computed here from the rows, so that plots need no arithmetic.
TRUE_ERROR = Stream(TRUE_ERROR_COLUMN.entity, (_make_line(TRUE_ERROR_COLUMN),))
OVERVIEW = Stream(
    mean_path("/loop/error"),
    (
        _line_of_second("least", GREY, 1.0),
        _line_of_second("mean", BLUE, 2.0),
        _line_of_second("greatest", GREY, 1.0),
    ),
)
MEANS = tuple(
    replace(stream, path=mean_path(stream.path)) for stream in STREAMS if stream.path in _MEANS
)
TRUE_MEAN = replace(TRUE_ERROR, path=mean_path(TRUE_ERROR.path))
DERIVED: tuple[Stream, ...] = (TRUE_ERROR, OVERVIEW, *MEANS, TRUE_MEAN)
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


def entities_of(plot: Plot) -> tuple[str, ...]:
    """Return the Rerun entities that a plot shows."""
    return tuple(dict.fromkeys(each.entity for each in columns_of(plot)))


def make_band(band_um: float) -> Stream:
    """The area in which the error is to stay, drawn as the deviation of a line without width."""
    return Stream("/loop/band", (Line("", f"band ±{band_um:g} {_ERROR.unit}", GREEN, 0.0),))


def overview_um(rows: Rows) -> FloatArray:
    """(1, 3) least, mean and greatest error of the rows; NaN if no row has an error."""
    error = get_column(rows, "error_um")
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
