"""The chart of a tuning session: centre and setpoint, and the flow, over the minutes of hold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from membrane_ctrl.web.chart_axes import GREY, Options, stack_panels

_POINTS_MOST = 3000
_COLOURS = {"setpoint_um": GREY, "displacement_um": "#3b8fd0", "flow_um_per_s": "#e07b00"}
_NAMES = {"setpoint_um": "setpoint", "displacement_um": "centre", "flow_um_per_s": "flow"}
_PANELS = (
    ("centre, µm", ("setpoint_um", "displacement_um")),
    ("flow, µm/s", ("flow_um_per_s",)),
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

    def make_options(self, begun_s: Sequence[tuple[float, str]]) -> Options:
        """Options of ECharts; `begun_s` are the times at which steps began, with their names."""
        latest = dict(begun_s)  # of steps that begin together, the last
        lines = [{"xAxis": at_s / 60.0, "name": step} for at_s, step in latest.items()]
        panels = []
        for place, (title, names) in enumerate(_PANELS):
            is_lowest = place == len(_PANELS) - 1
            label = {"show": is_lowest, "formatter": "{b}", "color": GREY, "fontSize": 10}
            marks = {"symbol": "none", "silent": True, "label": label, "data": lines}
            drawn = [self._make_line(name, place) | {"markLine": marks} for name in names]
            panels.append((title, {"scale": True}, drawn))
        horizontal = ("minutes of hold", {"type": "value", "scale": True})
        return stack_panels(tuple(_NAMES.values()), horizontal, panels)

    def _make_line(self, name: str, panel: int) -> Options:
        return {
            "type": "line",
            "name": _NAMES[name],
            "symbol": "none",
            "xAxisIndex": panel,
            "yAxisIndex": panel,
            "data": self._pairs(name),
            "itemStyle": {"color": _COLOURS[name]},
            "lineStyle": {"width": 1.3},
        }

    def _pairs(self, name: str) -> list[list[float | None]]:
        """Minutes and values, None for a missing one."""
        return [
            [round(minutes, 4), value if math.isfinite(value) else None]
            for minutes, value in zip(self._minutes, self._columns[name], strict=True)
        ]
