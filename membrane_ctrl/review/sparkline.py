"""A small line of a series, as SVG."""

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.model.arrays import Column

_POINTS = 80  # of a run's small line


def render_sparkline(values: Sequence[float] | Column, width: int = 160, height: int = 28) -> str:
    """Draw a small line of a series as SVG, scaled to its own range.

    Parameters
    ----------
    values : (n,) array or sequence
        Evenly spaced; values that are not finite leave gaps. More than 80 are averaged to 80.
    width, height : int
        Pixels.

    Returns
    -------
    str
        An element `svg`; empty with fewer than two finite values.
    """
    # Few points, of which one that averages a gap is a gap.
    y = np.asarray(values, dtype=np.float64)
    if y.size > _POINTS:
        y = np.array([part.mean() for part in np.array_split(y, _POINTS)])
    known = np.isfinite(y)
    if known.sum() < 2:
        return ""

    # Rows count down; 3 pixels are left above and below for the width of the line.
    low = y[known].min()
    high = y[known].max()
    rows = height - 3 - (y - low) / max(high - low, 1e-12) * (height - 6)
    columns = np.arange(y.size) * width / max(y.size - 1, 1)

    # A line to each point, or a new start after a gap.
    path = " ".join(
        f"{'L' if place and known[place - 1] else 'M'}{column:.1f},{row:.1f}"
        for place, (column, row) in enumerate(zip(columns, rows, strict=True))
        if known[place]
    )
    return (
        f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img">'
        f'<path d="{path}" fill="none" stroke="currentColor" stroke-width="1.2"/></svg>'
    )
