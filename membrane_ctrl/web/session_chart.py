"""The chart of a tuning session: centre and setpoint, and the flow, over the minutes of hold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from membrane_ctrl.web.chart_axes import GREY, make_axis

_POINTS_MOST = 3000
_COLOURS = {"setpoint_um": GREY, "displacement_um": "#3b8fd0", "flow_um_per_s": "#e07b00"}
_NAMES = {"setpoint_um": "setpoint", "displacement_um": "centre", "flow_um_per_s": "flow"}
_PANELS = (
    ("centre, µm", ("setpoint_um", "displacement_um"), {"top": "8%", "height": "48%"}),
    ("flow, µm/s", ("flow_um_per_s",), {"top": "64%", "height": "20%"}),
)


class SessionChart:
    """The points of a session so far; of a long one, every second, fourth and so on."""

    def __init__(self) -> None:
        self.count = 0  # of all points that were added
        self._minutes: list[float] = []
        self._columns: dict[str, list[float]] = {name: [] for name in _NAMES}
        self._every = 1

    def add_points(self, points: Mapping[str, Sequence[float]]) -> None:
        """Add points of `LiveReader.read_new`."""
        for place, time_s in enumerate(points["time_s"]):
            if (self.count + place) % self._every:
                continue
            self._minutes.append(time_s / 60.0)
            for name, column in self._columns.items():
                column.append(points[name][place])
        self.count += len(points["time_s"])
        while len(self._minutes) > _POINTS_MOST:
            self._every *= 2
            self._minutes = self._minutes[::2]
            self._columns = {name: column[::2] for name, column in self._columns.items()}

    def make_options(self, begun_s: Sequence[tuple[float, str]]) -> dict[str, Any]:
        """Options of ECharts; `begun_s` are the times at which steps began, with their names."""
        grids, x_axes, y_axes, series = [], [], [], []
        latest = dict(begun_s)  # of steps that begin together, the last
        lines = [{"xAxis": at_s / 60.0, "name": step} for at_s, step in latest.items()]
        for place, (title, names, where) in enumerate(_PANELS):
            is_lowest = place == len(_PANELS) - 1
            grids.append({"left": 64, "right": 16, **where})
            x_axis = make_axis("minutes of hold" if is_lowest else "", 26)
            x_axes.append({"type": "value", "scale": True, **x_axis, "gridIndex": place})
            y_axis = make_axis(title, 46)
            y_axes.append({"type": "value", "scale": True, **y_axis, "gridIndex": place})
            label = {"show": is_lowest, "formatter": "{b}", "color": GREY, "fontSize": 10}
            marks = {"symbol": "none", "silent": True, "label": label, "data": lines}
            for name in names:
                line: dict[str, Any] = {"type": "line", "name": _NAMES[name], "symbol": "none"}
                line |= {"xAxisIndex": place, "yAxisIndex": place, "data": self._pairs(name)}
                line |= {"itemStyle": {"color": _COLOURS[name]}, "lineStyle": {"width": 1.3}}
                series.append({**line, "markLine": marks})
        return {
            "animation": False,
            "aria": {"enabled": True},
            "legend": {"top": 0, "textStyle": {"color": GREY}},
            "grid": grids,
            "axisPointer": {"link": [{"xAxisIndex": "all"}]},
            "tooltip": {"trigger": "axis", "confine": True},
            "xAxis": x_axes,
            "yAxis": y_axes,
            "series": series,
        }

    def _pairs(self, name: str) -> list[list[float | None]]:
        """Minutes and values, None for a missing one."""
        return [
            [round(minutes, 4), value if math.isfinite(value) else None]
            for minutes, value in zip(self._minutes, self._columns[name], strict=True)
        ]
