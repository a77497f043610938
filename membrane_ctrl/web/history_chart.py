"""The chart of some signals over time: a panel for each, with a common time axis and cursor."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from membrane_ctrl.model.colours import Colour
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.service.feed import Series
from membrane_ctrl.web.chart_axes import GREY, make_axis

SCRIPT = (Path(__file__).parent / "history_chart.js").read_text(encoding="utf-8")
SIGNALS_MOST = 4  # panels that a screen has room for
_RED = "#d55e00"
_MARKS_MOST, _MARK_LETTERS = 20, 24  # newest marks on a chart, and what fits beside each
# per cent of the chart's height
_TOP, _BOTTOM, _GAP = 6.0, 20.0, 5.0
_BAND = {
    "type": "line",
    "symbol": "none",
    "lineStyle": {"opacity": 0},
    "silent": True,
    "stackStrategy": "all",  # also where its lower edge is negative
}


@dataclass(frozen=True, slots=True)
class ChartLine:
    """A vertical line of the chart: a mark or an alarm."""

    utc_s: float
    text: str
    is_alarm: bool = False


def make_history_chart(
    found: Sequence[tuple[str, Series]], utc: bool, moments: Sequence[ChartLine] = ()
) -> dict[str, Any]:
    """Options of ECharts, as plain data; `history_chart.js` adds what is a function.

    Parameters
    ----------
    found : sequence of (str, Series)
        Name and values of each signal, from the top panel to the lowest.
    utc : bool
        Label the times in UTC, else in the machine's local time.
    moments : sequence of ChartLine
        Oldest first.
    """
    # Panels of equal height, in per cent of the chart, with a gap between them.
    count = len(found)
    height = (100.0 - _TOP - _BOTTOM - (count - 1) * _GAP) / count
    shift_ms = 0.0 if utc else 1e3 * _find_offset_s(found)
    lines = [_make_line(each, shift_ms) for each in moments[-_MARKS_MOST:]]
    # All panels show the same time, from the first to the last value of any signal.
    ends_s = [float(each.utc_s[place]) for _, each in found if each.utc_s.size for place in (0, -1)]
    span = (
        {"min": min(ends_s) * 1e3 + shift_ms, "max": max(ends_s) * 1e3 + shift_ms} if ends_s else {}
    )
    grids, x_axes, y_axes, series = [], [], [], []
    # One grid with its axes and lines for each signal; only the lowest labels the time.
    for place, (signal, values) in enumerate(found):
        column = COLUMNS[signal]
        is_lowest = place == count - 1
        top = _TOP + place * (height + _GAP)
        grids.append({"left": 72, "right": 16, "top": f"{top:.1f}%", "height": f"{height:.1f}%"})
        x_axis = {**make_axis("UTC" if utc else "local time", 28), "type": "time", **span}
        if not is_lowest:
            x_axis |= {"name": "", "axisLabel": {"show": False}}
        x_axes.append({**x_axis, "gridIndex": place})
        y_axis = {**make_axis(column.title, 52), "type": "value", "scale": True}
        y_axes.append({**y_axis, "gridIndex": place})
        series += _make_series(signal, values, place, shift_ms, lines, labelled=place == 0)
    places = list(range(count))
    return {
        "animation": False,
        "useUTC": True,  # the local time is in the values: ECharts has no time zone of the bench
        "aria": {"enabled": True},
        "grid": grids,
        "axisPointer": {"link": [{"xAxisIndex": "all"}], "label": {"show": False}},
        "tooltip": {"trigger": "axis", "confine": True},
        "xAxis": x_axes,
        "yAxis": y_axes,
        "dataZoom": [
            {"type": "inside", "xAxisIndex": places},
            {"type": "slider", "xAxisIndex": places, "height": 18, "bottom": 6},
        ],
        "series": series,
    }


def _make_series(
    signal: str,
    values: Series,
    place: int,
    shift_ms: float,
    lines: list[dict[str, Any]],
    labelled: bool,
) -> list[dict[str, Any]]:
    """The band between minimum and maximum, and the mean, whose points carry all three numbers."""
    column = COLUMNS[signal]
    colour = _css_colour(column.colour)
    where = {"xAxisIndex": place, "yAxisIndex": place}
    at_ms = [float(utc_s) * 1e3 + shift_ms for utc_s in values.utc_s]
    low, mean, high = (
        [_make_plain(value, column.decimals) for value in each]
        for each in (values.low, values.mean, values.high)
    )
    # ECharts stacks the width of the band on its lower edge
    width = [
        None if least is None or most is None else most - least
        for least, most in zip(low, high, strict=True)
    ]
    band = {**_BAND, **where, "stack": f"band {place}"}
    points = [list(point) for point in zip(at_ms, mean, low, high, strict=True)]
    return [
        {**band, "data": [list(point) for point in zip(at_ms, low, strict=True)]},
        {
            **band,
            "data": [list(point) for point in zip(at_ms, width, strict=True)],
            "areaStyle": {"color": colour, "opacity": 0.25},
        },
        {
            "type": "line",
            **where,
            "name": column.label,
            "id": signal,
            "symbol": "none",
            "data": points,
            "encode": {"x": 0, "y": 1},
            # what the tooltip writes behind and with how many decimals
            "unit": column.unit,
            "decimals": column.decimals,
            "lineStyle": {"width": 1.5},
            "itemStyle": {"color": colour},
            "markLine": _make_mark_lines(lines, labelled),
        },
    ]


def _make_line(moment: ChartLine, shift_ms: float) -> dict[str, Any]:
    colour = _RED if moment.is_alarm else GREY
    return {
        "xAxis": moment.utc_s * 1e3 + shift_ms,
        "name": moment.text[:_MARK_LETTERS],
        "lineStyle": {"color": colour},
        "label": {"color": colour},
    }


def _make_mark_lines(lines: list[dict[str, Any]], labelled: bool) -> dict[str, Any]:
    label = {"show": labelled, "formatter": "{b}", "position": "insideEndTop", "fontSize": 10}
    return {"symbol": "none", "animation": False, "silent": True, "label": label, "data": lines}


def _find_offset_s(found: Sequence[tuple[str, Series]]) -> float:
    """Offset of the local time from UTC at the newest value."""
    at_s = max((float(each.utc_s[-1]) for _, each in found if each.utc_s.size), default=0.0)
    offset = datetime.fromtimestamp(at_s, UTC).astimezone().utcoffset()
    return offset.total_seconds() if offset else 0.0


def _css_colour(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _make_plain(value: float, decimals: int) -> float | None:
    return round(float(value), decimals + 2) if math.isfinite(value) else None
