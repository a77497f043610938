"""Plots show values where their scales put them, in the colours that their maps give them."""

import cv2
import numpy as np
import pytest
from matplotlib import colormaps

from membrane_ctrl.drawing import plot_axes
from membrane_ctrl.drawing.axis_scale import AxisScale, Spacing, fit_scale
from membrane_ctrl.drawing.canvas import Canvas
from membrane_ctrl.drawing.colour_tables import colour_table
from membrane_ctrl.drawing.plot_axes import Box, PlotAxes, Sheet

RED = (255, 0, 0)
BOX = Box(20, 10, 220, 110)
UNIT = AxisScale(0, 1)


def plot(x: AxisScale = UNIT, y: AxisScale = UNIT) -> tuple[Canvas, PlotAxes]:
    canvas = Canvas(240, 120)
    return canvas, PlotAxes(canvas, BOX, x, y)


def red_places(canvas: Canvas) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that are more red than white."""
    return np.nonzero(canvas.pixels[..., 1] < 128)


@pytest.mark.parametrize("name", ["RdBu_r", "viridis", "magma", "gray"])
def test_colour_tables_are_those_of_matplotlib(name: str) -> None:
    known = 255 * colormaps[name](np.arange(256))[:, :3]
    assert np.abs(colour_table(name).astype(float) - known).max() <= 2


@pytest.mark.parametrize(
    ("low", "high", "most", "labels"),
    [
        (0.0, 1.0, 5, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"][:6]),
        (-470.0, 470.0, 5, ["-400", "-200", "0", "200", "400"]),
        (0.0, 10.0, 4, ["0.0", "2.5", "5.0", "7.5", "10.0"]),
        (5.0, -5.0, 2, ["-5", "0", "5"]),
        (0.0, 3e6, 3, ["0", "1e+06", "2e+06", "3e+06"]),
        (2.0, 2.0, 5, []),
    ],
)
def test_ticks_are_round_numbers(low: float, high: float, most: int, labels: list[str]) -> None:
    assert [tick.label for tick in AxisScale(low, high).ticks(most)] == labels


def test_ticks_of_a_logarithmic_scale() -> None:
    wide = AxisScale(1e-6, 1e4, Spacing.LOGARITHMIC).ticks(5)
    assert [tick.label for tick in wide] == ["1e-06", "1e-04", "1e-02", "1e+00", "1e+02", "1e+04"]
    narrow = AxisScale(1.5, 8.0, Spacing.LOGARITHMIC).ticks(5)
    assert [tick.value for tick in narrow] == [2.0, 5.0]


def test_a_symmetric_scale_is_linear_near_zero() -> None:
    scale = AxisScale(-1000.0, 1000.0, Spacing.SYMMETRIC, 1.0)
    assert scale.shares([-1000, -1, 0, 0.5, 1, 10, 1000]) == pytest.approx(
        [0, 0.375, 0.5, 0.5625, 0.625, 0.75, 1]
    )
    values = [tick.value for tick in scale.ticks(5)]
    assert values == sorted(values)
    assert {-1000.0, 0.0, 1000.0} <= set(values)


def test_a_fitted_scale_holds_all_finite_values() -> None:
    scale = fit_scale([1.0, np.nan], np.array([3.0, np.inf]))
    assert scale.low < 1 < 3 < scale.high
    scale = fit_scale([0.0, 1e-3, 10.0], spacing=Spacing.LOGARITHMIC)
    assert 0 < scale.low < 1e-3 < 10 < scale.high
    assert fit_scale([np.nan]).low < fit_scale([np.nan]).high
    assert fit_scale([2.0]).low < 2 < fit_scale([2.0]).high


def test_a_line_stands_where_its_values_are() -> None:
    canvas, axes = plot(AxisScale(0, 10), AxisScale(-1, 1))
    axes.draw_line([0, 10], [0.5, 0.5], RED)
    rows, columns = red_places(canvas)
    assert rows.mean() == pytest.approx(34.5, abs=0.6)  # a quarter from the top
    assert np.ptp(rows) <= 3
    assert columns.min() <= 21
    assert columns.max() >= 218


def test_a_line_is_interrupted_at_an_unknown_value() -> None:
    canvas, axes = plot()
    axes.draw_line([0, 0.2, 0.5, 0.8, 1], [0.5, 0.5, np.nan, 0.5, 0.5], RED)
    _, columns = red_places(canvas)
    assert not ((columns > 70) & (columns < 170)).any()


def test_nothing_is_drawn_beside_the_plot() -> None:
    canvas, axes = plot()
    axes.draw_line([-1e9, 1e9], [-1e9, 1e9], RED)
    axes.draw_bar(-5, 5, (-5, 5), RED)
    axes.draw_dots([-0.01, 2.0], [0.5, 0.5], RED)
    axes.fill_between(np.array([-3.0, 3.0]), np.array([-3.0, -3.0]), np.array([9.0, 9.0]), RED)
    rows, columns = red_places(canvas)
    assert rows.min() == 10
    assert rows.max() == 109
    assert columns.min() == 20
    assert columns.max() == 219


def test_a_map_has_its_first_row_above_and_no_colour_where_unknown() -> None:
    canvas, axes = plot()
    values = np.array([[0.0, np.nan], [1.0, 1.0]])
    axes.draw_image(values, UNIT, "gray")
    inner = canvas.pixels[10:110, 20:220]
    assert (inner[:50, :100] == 0).all()
    assert (inner[:, 100:] == 255).all()
    assert (inner[50:] == 255).all()


def test_a_map_has_square_cells_and_its_scale_beside_it() -> None:
    sheet = Sheet(6, 4)
    side = AxisScale(-10, 10)
    colours = AxisScale(0, 5)
    axes = plot_axes.draw_map(
        sheet.canvas, sheet.box(), np.zeros((20, 20)), side, side, colours, "viridis"
    )
    assert axes.box.width == pytest.approx(axes.box.height)
    axes.draw_frame("title", "x (mm)", "y (mm)")
    beside = sheet.canvas.pixels[:, round(axes.box.right) + 5 :].reshape(-1, 3).astype(int)
    for colour in colour_table("viridis")[[5, 128, 250]]:
        assert np.abs(beside - colour).max(axis=1).min() <= 2


def test_text_stands_where_it_is_put() -> None:
    canvas = Canvas(200, 100)
    canvas.draw_text("mm\nµm", 200, 100, across="right", along="bottom", colour=RED)
    canvas.draw_text("off the picture", -500, 50)
    rows, columns = red_places(canvas)
    assert columns.min() > 150
    assert rows.min() > 50
    upright = Canvas(200, 100)
    upright.draw_text("spectral", 100, 50, colour=RED, upright=True)
    rows, columns = red_places(upright)
    assert np.ptp(rows) > 2 * np.ptp(columns)


def test_a_picture_is_written_as_png() -> None:
    canvas, axes = plot()
    axes.draw_bar(0, 0.5, (0, 1), RED)
    axes.draw_frame("half")
    decoded = cv2.imdecode(np.frombuffer(canvas.encode_png(), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.array_equal(decoded, canvas.pixels)
