"""One Rerun entity of several signals, and how columns become one."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.model import figure_columns
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import (
    Colour,
)
from membrane_ctrl.model.columns import (
    BY_GROUP,
    COLUMNS,
    Plot,
    TelemetryColumn,
)
from membrane_ctrl.model.telemetry import Rows, get_column


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


def make_line(each: TelemetryColumn) -> Line:
    """Return the line that shows a column."""
    return Line(each.name, each.legend, each.colour, each.width)


def make_telemetry_streams() -> tuple[Stream, ...]:
    """Return one stream for each entity, with the lines of all columns that share it."""
    by_entity: dict[str, list[Line]] = {}
    for each in BY_GROUP:
        if each.entity:
            by_entity.setdefault(each.entity, []).append(make_line(each))
    return tuple(Stream(path, tuple(lines)) for path, lines in by_entity.items())


def mean_path(entity: str) -> str:
    """Return the entity of the means of each second of an entity."""
    return f"/overview{entity}"


def make_figure_stream(plot: Plot) -> Stream:
    """Return the stream of a plot of the figure's columns."""
    shown = figure_columns.figure_columns_of(plot)
    return Stream(shown[0].entity, tuple(map(make_line, shown)))


def make_second_line(what: str, colour: Colour, width: float) -> Line:
    """Return a line of the overview, which has one value of the error for each second.

    Parameters
    ----------
    what : str
        Which value, as its legend names it: `least`, `mean`, `greatest`.
    colour : Colour
        In the viewer and in reports.
    width : float
        Points.
    """
    error = COLUMNS["error_um"]
    return Line("", f"{error.label}, {what} of a second {error.unit}", colour, width)
