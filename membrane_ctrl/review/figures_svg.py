"""Pictures of a report as SVG text; the style all of them share."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, VIOLET, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#8a8f98"
WIDTH_IN = 10.5

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#c3c8d0",
    "axes.labelcolor": "#444b55",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e9ee",
    "grid.linewidth": 0.7,
    "xtick.color": "#667",
    "ytick.color": "#667",
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.facecolor": "none",
    "axes.facecolor": "white",
    "path.simplify_threshold": 0.3,
    # the same report twice is the same text
    "svg.hashsalt": "membrane",
    "svg.fonttype": "none",
}


@contextmanager
def picture(rows: int = 1, columns: int = 1, height_in: float = 3.0, **subplots: Any) -> Iterator[tuple[Figure, Any]]:
    """A figure in the report's style and its axes, as `Figure.subplots` gives them."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        yield figure, figure.subplots(rows, columns, **subplots)


def svg(figure: Figure) -> str:
    """The figure as an `<svg>` element that scales with the page."""
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        # letters are text in the page, drawn with the reader's fonts
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font")
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    return re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1))
