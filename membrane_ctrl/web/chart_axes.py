"""Colours and axes that the charts have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Options = dict[str, Any]  # of ECharts
GREY, RULE = "#8a8a8a", "rgba(128, 128, 128, 0.3)"  # legible on white and on black


def make_axis(name: str, gap_px: int) -> Options:
    """Options of an axis of ECharts.

    Parameters
    ----------
    name : str
        Title beside the axis, with its unit; empty for none.
    gap_px : int
        Between the axis and its name.
    """
    return {
        "name": name,
        "nameGap": gap_px,
        "nameLocation": "middle",
        "nameTextStyle": {"color": GREY},
        "axisLabel": {"color": GREY, "hideOverlap": True},
        "splitLine": {"lineStyle": {"color": RULE}},
    }


def stack_panels(
    names: Sequence[str],
    horizontal: tuple[str, Options],
    panels: Sequence[tuple[str, Options, list[Options]]],
) -> Options:
    """Options of panels above each other, with a common horizontal axis and cursor.

    Parameters
    ----------
    names : sequence of str
        Of the lines, for the legend.
    horizontal : (str, dict)
        Title of the common axis, and its options.
    panels : sequence of (str, dict, list of dict)
        Title and options of the vertical axis, and the lines, which name their panel as
        `xAxisIndex` and `yAxisIndex`; from the top.
    """
    # All panels have the same height, in per cent of the chart.
    title, axis = horizontal
    count = len(panels)
    height = 80.0 / count - 3.0
    grids, x_axes, y_axes, series = [], [], [], []
    for place, (y_title, y_axis, lines) in enumerate(panels):
        top = 8.0 + place * (height + 5.0)
        grids.append({"left": 64, "right": 16, "top": f"{top:.1f}%", "height": f"{height:.1f}%"})
        # Only the lowest one has times.
        is_lowest = place == count - 1
        x_axis = {**make_axis(title if is_lowest else "", 26), **axis, "gridIndex": place}
        if not is_lowest:
            x_axis["axisLabel"] = {"show": False}
        x_axes.append(x_axis)
        y_axes.append({"type": "value", **make_axis(y_title, 46), **y_axis, "gridIndex": place})
        series += lines
    return {
        "animation": False,
        "aria": {"enabled": True},
        "legend": {"data": list(names), "top": 0, "textStyle": {"color": GREY}},
        "grid": grids,
        "axisPointer": {"link": [{"xAxisIndex": "all"}]},
        "tooltip": {"trigger": "axis", "confine": True},
        "xAxis": x_axes,
        "yAxis": y_axes,
        "series": series,
    }
