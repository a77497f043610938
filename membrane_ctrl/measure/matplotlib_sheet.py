"""Sheets and maps drawn by Matplotlib, for pictures that need its kinds of plots."""

from __future__ import annotations

from typing import Any

from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from membrane_ctrl.drawing.axis_scale import Spacing
from membrane_ctrl.measure.map_colours import choose_map_colours, describe_map
from membrane_ctrl.model.arrays import FloatArray

_MAP_CELLS = 450  # side of maps


def new_sheet(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """Make a figure and its axes with fixed margins: fitted ones double the time of a picture.

    Parameters
    ----------
    width, height : float
        Inches, margins included.
    rows, columns : int
        Number of axes.

    Returns
    -------
    figure : Figure
    axes : Axes or array of Axes
        As `Figure.subplots` returns them: one, (columns,), (rows,) or (rows, columns).
    """
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(rows, columns)
    figure.subplots_adjust(
        left=0.8 / width,
        right=1 - 0.35 / width,
        bottom=0.6 / height,
        top=1 - 0.4 / height,
        wspace=0.25,
        hspace=0.28,
    )
    return figure, axes


def show_map(
    axes: Any, title: str, axis: FloatArray, values: FloatArray, colours: str, even: bool = False
) -> None:
    """Draw a map with its colour scale, its peak to valley, and its RMS about its mean.

    Parameters
    ----------
    axes : matplotlib axes
        Where to draw.
    title : str
        Title, with the unit of the values.
    axis : (n,) array
        Coordinates along both sides, mm.
    values : (n, n) array
        The map; NaN where nothing is known.
    colours : str
        Name of the colour map.
    even : bool
        Centre the scale on 0, as `choose_map_colours` does.
    """
    every = max(1, values.shape[0] // _MAP_CELLS)
    picture = values[::every, ::every]
    chosen = choose_map_colours(values, picture, even)
    scale: dict[str, Any] = {"vmin": chosen.low, "vmax": chosen.high}
    if chosen.spacing is Spacing.SYMMETRIC:
        scale = {"norm": SymLogNorm(chosen.linear_to, vmin=chosen.low, vmax=chosen.high)}
        title += f", linear to +-{chosen.linear_to:.2g}"
    extent = (axis[0], axis[-1], axis[0], axis[-1])
    shown = axes.imshow(
        picture,
        origin="lower",
        extent=extent,
        cmap=colours,
        interpolation="nearest",
        **scale,
    )
    axes.set(title=title, xlabel="x (mm)", ylabel="y (mm)")
    place = axes.transAxes
    axes.text(0.02, 0.98, describe_map(values), transform=place, va="top", fontsize=8)
    axes.figure.colorbar(shown, ax=axes, shrink=0.85)
