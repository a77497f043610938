"""Rerun entities of the telemetry columns: their lines, names and colours.

The signals of one plot share one entity: m scalars of one entity cost the writer and the viewer far
less than m entities of one. `SeriesLines` sets the names of the lines once.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.model import figure_columns
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import (
    BLUE,
    GREEN,
    GREY,
)
from membrane_ctrl.model.columns import (
    COLUMNS,
    POSITION,
    TRUE_ERROR_COLUMN,
    Group,
    Plot,
    columns_of,
    plots_of,
)
from membrane_ctrl.model.telemetry import Rows, get_column
from membrane_ctrl.run_files.stream import (
    Line,
    Stream,
    make_figure_stream,
    make_line,
    make_second_line,
    make_telemetry_streams,
    mean_path,
)

_ERROR = COLUMNS["error_um"]
# A point per second all over the run: the others have every tick around events and one per second
# in quiet times, and a line that changes its density looks as if the mirror had changed.
_MEAN_PLOTS = (POSITION, *plots_of(Group.PUMP, Group.ENVIRONMENT))
_MEANS = frozenset(each.entity for plot in _MEAN_PLOTS for each in columns_of(plot))


# Every column except `mono_s`, the time axis, is in exactly one stream.
STREAMS: tuple[Stream, ...] = make_telemetry_streams()
# Computed here from the rows, so that plots need no arithmetic.
TRUE_ERROR = Stream(TRUE_ERROR_COLUMN.entity, (make_line(TRUE_ERROR_COLUMN),))
OVERVIEW = Stream(
    mean_path("/loop/error"),
    (
        make_second_line("least", GREY, 1.0),
        make_second_line("mean", BLUE, 2.0),
        make_second_line("greatest", GREY, 1.0),
    ),
)
MEANS = tuple(
    replace(stream, path=mean_path(stream.path)) for stream in STREAMS if stream.path in _MEANS
)
TRUE_MEAN = replace(TRUE_ERROR, path=mean_path(TRUE_ERROR.path))
DERIVED: tuple[Stream, ...] = (TRUE_ERROR, OVERVIEW, *MEANS, TRUE_MEAN)
ZERNIKE = make_figure_stream(figure_columns.TERMS)
CHANGE = make_figure_stream(figure_columns.LOW_ORDERS)
PUMP = make_figure_stream(figure_columns.PUMP_CURVE)
VIBRATIONS = make_figure_stream(figure_columns.VIBRATIONS)
SAG = make_figure_stream(figure_columns.SAG_CHANGE)
FOCUS = make_figure_stream(figure_columns.FOCUS)
FIGURE_RMS = make_figure_stream(figure_columns.FIGURE_RMS)
RESIDUAL = make_figure_stream(figure_columns.SLOPE_RESIDUAL)
QUALITY = make_figure_stream(figure_columns.FRINGE_QUALITY)
MODULATION = make_figure_stream(figure_columns.MODULATION)
LATENCY = make_figure_stream(figure_columns.LATENCY)
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
