"""Plots: a sheet of axes, and what is drawn in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from membrane_ctrl.drawing.axis_scale import AxisScale, Tick
from membrane_ctrl.drawing.canvas import (
    BLACK,
    DOTS_PER_INCH,
    Canvas,
    HorizontalPlace,
    VerticalPlace,
    text_width_px,
)
from membrane_ctrl.drawing.colour_tables import colour_table
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import Colour

# Colours of lines in their order: Matplotlib's.
FIRST_COLOUR: Colour = (31, 119, 180)
SECOND_COLOUR: Colour = (255, 127, 14)
GOOD_COLOUR: Colour = (44, 160, 44)
MARK_COLOUR: Colour = (214, 39, 40)
_UNKNOWN: Colour = (255, 255, 255)  # of a map where it has no value

# Margins of a sheet and of the space between its axes, inches.
_LEFT_IN = 0.8
_RIGHT_IN = 0.35
_TOP_IN = 0.4
_BOTTOM_IN = 0.6
_BETWEEN_IN = 1.0
_TICK_PX = 5
_FRAME_PX = 1
_LABEL_PT = 9.0
_TITLE_PT = 11.0
_SMALL_PT = 8.0
_PX_A_TICK = 75  # space that a label needs, along x and along y
_DASH_PX = 9
_SCALE_WIDTH = 0.045  # of a colour scale, over the width of its plot
_SCALE_SPACE = 0.2  # that it takes away from its plot, labels included
_SCALE_HEIGHT = 0.85  # over that of its map
_BAND = 0.3  # opacity


@dataclass(frozen=True)
class Box:
    """A rectangle of a picture, pixels from its upper left corner."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def width(self) -> float:
        return self.right - self.left

    @property
    def height(self) -> float:
        return self.bottom - self.top

    def fit_aspect(self, aspect: float) -> Box:
        """The largest box of width over height `aspect` in the middle of this one."""
        width = min(self.width, self.height * aspect)
        height = width / aspect
        left = self.left + (self.width - width) / 2
        top = self.top + (self.height - height) / 2
        return Box(left, top, left + width, top + height)


class Sheet:
    """A picture of rows and columns of plots.

    Parameters
    ----------
    width_in, height_in : float
        Its size, inches.
    rows, columns : int
        Number of plots.
    """

    def __init__(self, width_in: float, height_in: float, rows: int = 1, columns: int = 1) -> None:
        width_px = round(width_in * DOTS_PER_INCH)
        height_px = round(height_in * DOTS_PER_INCH)
        self.canvas = Canvas(width_px, height_px)
        self._rows = rows
        self._columns = columns

    def box(self, row: int = 0, column: int = 0) -> Box:
        """The space of the plot in a row and a column, without its labels."""
        height_px, width_px = self.canvas.pixels.shape[:2]
        between_px = _BETWEEN_IN * DOTS_PER_INCH
        inner_px = width_px - (_LEFT_IN + _RIGHT_IN) * DOTS_PER_INCH
        width = (inner_px - between_px * (self._columns - 1)) / self._columns
        inner_px = height_px - (_TOP_IN + _BOTTOM_IN) * DOTS_PER_INCH
        height = (inner_px - between_px * (self._rows - 1)) / self._rows
        left = _LEFT_IN * DOTS_PER_INCH + column * (width + between_px)
        top = _TOP_IN * DOTS_PER_INCH + row * (height + between_px)
        return Box(left, top, left + width, top + height)


class PlotAxes:
    """One plot. What is drawn beyond its scales is cut off when its frame is drawn, the last step.

    Parameters
    ----------
    canvas : Canvas
        The picture.
    box : Box
        Where it stands.
    x, y : AxisScale
        Its scales; y counts upwards.
    """

    def __init__(self, canvas: Canvas, box: Box, x: AxisScale, y: AxisScale) -> None:
        self._canvas = canvas
        self.box = box
        self.x = x
        self.y = y
        rows = slice(round(box.top), round(box.bottom))
        columns = slice(round(box.left), round(box.right))
        # Only the plot's own pixels can be drawn on.
        self._inner = Canvas(1, 1)
        self._inner.pixels = canvas.pixels[rows, columns]

    def place(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Pixels (n, 2) of points within the plot, from its own corner."""
        columns = self.x.shares(x) * self.box.width
        rows = (1 - self.y.shares(y)) * self.box.height
        return np.stack(np.broadcast_arrays(np.atleast_1d(columns), np.atleast_1d(rows)), axis=1)

    def draw_line(
        self, x: ArrayLike, y: ArrayLike, colour: Colour = FIRST_COLOUR, dashed: bool = False
    ) -> None:
        """Draw a line through points; it is interrupted where one is NaN."""
        points = self.place(x, y)
        for piece in _split_at_gaps(points):
            if dashed:
                for dash in _cut_dashes(piece):
                    self._inner.draw_line(dash, colour)
            else:
                self._inner.draw_line(piece, colour)

    def draw_dots(
        self, x: ArrayLike, y: ArrayLike, colour: Colour = MARK_COLOUR, radius_px: float = 4.5
    ) -> None:
        """Draw a dot at each point."""
        for column, row in self.place(x, y):
            if np.isfinite(column + row):
                self._inner.draw_dot(column, row, radius_px, colour)

    def fill_between(
        self, x: FloatArray, low: FloatArray, high: FloatArray, colour: Colour = FIRST_COLOUR
    ) -> None:
        """Fill the band between two curves, half transparent."""
        is_known = np.isfinite(x + low + high)
        if not is_known.any():
            return
        lower = self.place(x[is_known], low[is_known])
        upper = self.place(x[is_known], high[is_known])
        self._inner.fill_area(np.concatenate([lower, upper[::-1]]), colour, _BAND)

    def draw_bar(
        self,
        from_x: float,
        to_x: float,
        y: tuple[float, float],
        colour: Colour,
        opacity: float = 1.0,
    ) -> None:
        """Fill a rectangle between two values of x and two of y."""
        low, high = y
        corners = self.place([from_x, to_x, to_x, from_x], [low, low, high, high])
        self._inner.fill_area(corners, colour, opacity)

    def draw_interval(
        self, x: float, half: float, y: float, colour: Colour = MARK_COLOUR, cap_px: float = 5.0
    ) -> None:
        """Draw a dot and the interval of x about it."""
        self.draw_dots(x, y, colour, radius_px=3.5)
        ends = self.place([x - half, x + half], [y, y])
        self._inner.draw_line(ends, colour)
        for column, row in ends:
            self._inner.draw_line([[column, row - cap_px], [column, row + cap_px]], colour)

    def draw_image(self, values: FloatArray, colours: AxisScale, table: str) -> None:
        """Fill the plot with a map.

        Parameters
        ----------
        values : (rows, columns) array
            The map from its upper row on; NaN where it has no value.
        colours : AxisScale
            Which colour belongs to a value.
        table : str
            Name of the colour table.
        """
        columns = round(self.box.right) - round(self.box.left)
        rows = round(self.box.bottom) - round(self.box.top)
        # Nearest values: a map of pixels is not to look smoother than it is.
        nearest = cv2.resize(
            np.asarray(values, np.float32), (columns, rows), interpolation=cv2.INTER_NEAREST
        )
        is_known = np.isfinite(nearest)
        shares = colours.shares(np.where(is_known, nearest, colours.low))
        steps = np.clip(255 * shares + 0.5, 0, 255).astype(np.uint8)
        image = colour_table(table)[steps]
        image[~is_known] = _UNKNOWN
        self._inner.paste(image, 0, 0)

    def write_note(
        self,
        text: str,
        x_share: float,
        y_share: float,
        across: HorizontalPlace = "left",
        along: VerticalPlace = "top",
        size_pt: float = _SMALL_PT,
    ) -> None:
        """Write text at a place of the plot; shares count from its lower left corner."""
        column = self.box.left + x_share * self.box.width
        row = self.box.top + (1 - y_share) * self.box.height
        self._canvas.draw_text(text, column, row, size_pt, across, along)

    def write_beside(self, text: str, x: float, y: float) -> None:
        """Write text to the right of a point."""
        ((column, row),) = self.place(x, y)
        self._inner.draw_text(text, column, row, _LABEL_PT, "left", "middle")

    def draw_legend(
        self,
        entries: Sequence[tuple[str, Colour]],
        across: Literal["left", "right"] = "right",
        along: Literal["top", "bottom"] = "top",
    ) -> None:
        """Name the lines, in a corner."""
        step_px = 20
        width_px = max(text_width_px(name, _LABEL_PT) for name, _ in entries) + 40
        left = self.box.left + 8
        if across == "right":
            left = self.box.right - width_px - 8
        top = self.box.top + 8
        if along == "bottom":
            top = self.box.bottom - 8 - step_px * len(entries)
        for number, (name, colour) in enumerate(entries):
            middle = top + step_px * (number + 0.5)
            swatch = [[left, middle], [left + 26, middle]]
            self._canvas.draw_line(swatch, colour, 4)
            self._canvas.draw_text(name, left + 34, middle, _LABEL_PT, "left", "middle")

    def draw_frame(
        self,
        title: str = "",
        x_label: str = "",
        y_label: str = "",
        x_ticks: Sequence[Tick] | None = None,
        y_ticks: Sequence[Tick] | None = None,
    ) -> None:
        """Draw frame, ticks and labels; the ticks are those of the scales if none are given."""
        box = self.box
        canvas = self._canvas
        corners = [
            [box.left, box.top],
            [box.right, box.top],
            [box.right, box.bottom],
            [box.left, box.bottom],
            [box.left, box.top],
        ]
        canvas.draw_line(np.rint(corners) + 0.5, BLACK, _FRAME_PX)
        if x_ticks is None:
            x_ticks = self.x.ticks(round(box.width / _PX_A_TICK))
        if y_ticks is None:
            y_ticks = self.y.ticks(round(box.height / _PX_A_TICK) + 1)

        # Ticks and their labels.
        for tick in x_ticks:
            column = round(box.left + float(self.x.shares(tick.value)) * box.width) + 0.5
            mark = [[column, box.bottom], [column, box.bottom + _TICK_PX]]
            canvas.draw_line(mark, BLACK, _FRAME_PX)
            canvas.draw_text(tick.label, column, box.bottom + _TICK_PX + 3, _LABEL_PT, along="top")
        label_px = 0
        for tick in y_ticks:
            row = round(box.bottom - float(self.y.shares(tick.value)) * box.height) + 0.5
            canvas.draw_line([[box.left - _TICK_PX, row], [box.left, row]], BLACK, _FRAME_PX)
            canvas.draw_text(tick.label, box.left - _TICK_PX - 3, row, _LABEL_PT, "right")
            label_px = max(label_px, text_width_px(tick.label, _LABEL_PT))

        # Names of the axes, and the title.
        middle = (box.left + box.right) / 2
        canvas.draw_text(x_label, middle, box.bottom + 28, _LABEL_PT, along="top")
        canvas.draw_text(title, middle, box.top - 7, _TITLE_PT, along="bottom")
        beside = box.left - _TICK_PX - label_px - 8
        centre = (box.top + box.bottom) / 2
        canvas.draw_text(y_label, beside, centre, _LABEL_PT, "right", upright=True)


def draw_map(
    canvas: Canvas,
    box: Box,
    values: FloatArray,
    x: AxisScale,
    y: AxisScale,
    colours: AxisScale,
    table: str,
) -> PlotAxes:
    """Draw a map with its colour scale to its right.

    Parameters
    ----------
    canvas : Canvas
        The picture.
    box : Box
        Space for both; cells of the map are as high as they are wide.
    values : (rows, columns) array
        The map from its upper row on; NaN where it has no value.
    x, y : AxisScale
        Coordinates of its outer edges.
    colours : AxisScale
        Which colour belongs to a value.
    table : str
        Name of the colour table.

    Returns
    -------
    PlotAxes
        The map, whose frame is still to be drawn.
    """
    room = replace(box, right=box.right - _SCALE_SPACE * box.width)
    aspect = abs(x.high - x.low) / abs(y.high - y.low)
    axes = PlotAxes(canvas, room.fit_aspect(aspect), x, y)
    axes.draw_image(values, colours, table)

    # The colour scale, with ticks on its right.
    left = axes.box.right + 0.05 * box.width
    half = _SCALE_HEIGHT * axes.box.height / 2
    middle = (axes.box.top + axes.box.bottom) / 2
    scale_box = Box(left, middle - half, left + _SCALE_WIDTH * box.width, middle + half)
    scale = PlotAxes(canvas, scale_box, AxisScale(0, 1), colours)
    steps = np.linspace(1, 0, round(scale_box.height))
    shares = AxisScale(0, 1)
    scale.draw_image(np.repeat(steps[:, None], 2, axis=1), shares, table)
    scale.draw_frame(x_ticks=(), y_ticks=())
    for tick in colours.ticks(round(scale_box.height / _PX_A_TICK) + 3):
        row = round(scale_box.bottom - float(colours.shares(tick.value)) * scale_box.height) + 0.5
        mark = [[scale_box.right, row], [scale_box.right + _TICK_PX, row]]
        canvas.draw_line(mark, BLACK, _FRAME_PX)
        canvas.draw_text(tick.label, scale_box.right + _TICK_PX + 3, row, _LABEL_PT, "left")
    return axes


def _split_at_gaps(points: FloatArray) -> list[FloatArray]:
    """Runs of finite points."""
    is_finite = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(is_finite)) + 1
    pieces = np.split(points, edges)
    return [piece for piece in pieces if len(piece) > 1 and np.isfinite(piece[0]).all()]


def _cut_dashes(points: FloatArray) -> list[FloatArray]:
    """Every second piece of a line, of equal lengths."""
    steps_px = np.hypot(*np.diff(points, axis=0).T)
    along_px = np.concatenate([[0.0], np.cumsum(steps_px)])
    begins = np.arange(0.0, along_px[-1], 2 * _DASH_PX)
    dashes = []
    for begin in begins:
        at = np.array([begin, begin + _DASH_PX / 2, begin + _DASH_PX])
        columns = np.interp(at, along_px, points[:, 0])
        rows = np.interp(at, along_px, points[:, 1])
        dashes.append(np.stack([columns, rows], axis=1))
    return dashes
