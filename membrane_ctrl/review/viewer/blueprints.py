"""How a review opens: one tab per question, all on the requested time range."""

from collections.abc import Sequence

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import AbsoluteTimeRange

TABS = ("overview", "loop", "shape", "faults", "tuning")


class ReviewBlueprint:
    """Blueprint of a review.

    Parameters
    ----------
    prefixes : sequence of str
        Before the runs' paths; `("",)` for a single run.
    span_s : tuple or None
        Time range to show, on the review's timeline; None: everything.
    band_um : float
        The error plots span three bands.
    maps_um : sequence of float
        Scale of each run's maps; NaN without maps.
    """

    def __init__(
        self, prefixes: Sequence[str], span_s: tuple[float, float] | None, band_um: float, maps_um: Sequence[float]
    ) -> None:
        self._prefixes = prefixes
        self._span_s = span_s
        self._error_span_um = (-3 * band_um, 3 * band_um)
        self._maps_um = maps_um

    def made(self, tab: str = "overview") -> rrb.Blueprint:
        """The blueprint, with `tab` (one of `TABS`) selected."""
        tabs = [self._overview(), self._loop(), self._shape(), self._faults(), self._tuning()]
        selection = None
        if self._span_s is not None:
            start, end = (round(1e9 * second) for second in self._span_s)
            selection = AbsoluteTimeRange(start, end)
        return rrb.Blueprint(
            rrb.Tabs(*tabs, active_tab=TABS.index(tab)),
            rrb.TimePanel(state="collapsed", timeline="run_time", time_selection=selection),
            rrb.SelectionPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
            auto_views=False,
        )

    def _axis(self) -> rrb.TimeAxis:
        start, end = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite()
        if self._span_s is not None:
            start, end = (rr.TimeRangeBoundary.absolute(seconds=second) for second in self._span_s)
        return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))

    def _contents(self, paths: Sequence[str]) -> list[str]:
        return [f"+ {prefix}{path}" for prefix in self._prefixes for path in paths]

    def _plot(self, name: str, *paths: str, span: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=name,
            origin="/",
            contents=self._contents(paths),
            axis_x=self._axis(),
            axis_y=None if span is None else rrb.ScalarAxis(range=span),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightBottom),
        )

    def _error(self) -> rrb.TimeSeriesView:
        paths = ("/overview/error", "/overview/true", "/loop/band", "/found/marks")
        return self._plot("Error: minimum, mean, maximum; red: detected, um", *paths, span=self._error_span_um)

    def _lanes(self) -> rrb.StateTimelineView:
        several = len(self._prefixes) > 1  # there is room for two lanes of each
        paths = ("/state/controller", "/state/fault", *(() if several else ("/state/shape_loop", "/state/rung")))
        return rrb.StateTimelineView(
            name="States", origin="/", contents=self._contents(paths), time_view=self._axis()
        )  # fmt: skip

    def _log(self, name: str, *paths: str) -> rrb.TextLogView:
        columns = rrb.TextLogColumns(timeline_columns=["run_time"], text_log_columns=["loglevel", "body"])
        return rrb.TextLogView(name=name, origin="/", contents=self._contents(paths), columns=columns)

    def _overview(self) -> rrb.Vertical:
        return rrb.Vertical(
            self._error(),
            self._lanes(),
            rrb.Horizontal(
                self._plot("Flow and leak, um/s", "/overview/flow"),
                self._plot("Air pressure, Pa", "/overview/ambient"),
                self._plot("Air temperature, C", "/overview/temperature"),
            ),
            rrb.Horizontal(self._log("Detected events, UTC", "/found"), self._log("Events, UTC", "/events")),
            row_shares=[3.6, 2.7, 1.9, 1.8],
            name="overview",
        )

    def _loop(self) -> rrb.Vertical:
        return rrb.Vertical(
            self._plot("Error, each tick, um (shown for short runs, or with --from and --to)", "/loop/error",
                       "/loop/band", span=self._error_span_um),
            self._plot("Setpoint, reading, true centre, um", "/loop/position", "/truth/displacement"),
            self._plot("P, I, D, feed-forward, um/s", "/loop/terms"),
            self._plot("Flow and leak, um/s", "/loop/flow"),
            self._plot("Pump and vent", "/pump/drive"),
            name="loop",
        )  # fmt: skip

    def _shape(self) -> rrb.Vertical:
        maps = [
            rrb.Spatial2DView(name=_map_name(prefix.strip("/"), most_um), origin=f"{prefix}/shape/map")
            for prefix, most_um in zip(self._prefixes, self._maps_um, strict=True)
        ]
        return rrb.Vertical(
            rrb.Horizontal(*maps, self._plot("Low orders, change, um", "/shape/change")),
            self._plot("Change of the centre by camera and by laser, um", "/shape/sag_change"),
            rrb.Horizontal(
                self._plot("Slope residual, urad", "/shape/residual"), self._plot("Trim, um", "/overview/trim")
            ),
            row_shares=[3, 2, 1.5],
            name="shape",
        )

    def _faults(self) -> rrb.Vertical:
        return rrb.Vertical(
            self._lanes(),
            self._error(),
            rrb.Horizontal(
                self._plot("Lateness, ms", "/overview/lateness"),
                self._plot("Ticks missed so far", "/overview/missed"),
                self._plot("Gauge pressure, Pa", "/overview/gauge"),
            ),
            rrb.Horizontal(self._log("Events, UTC", "/events"), self._log("Detected events, UTC", "/found")),
            row_shares=[2.2, 3, 2, 2.8],
            name="faults",
        )

    def _tuning(self) -> rrb.Vertical:
        paths = ("/loop/error", "/truth/displacement", "/loop/band")
        return rrb.Vertical(
            self._plot("Reading, filtered, setpoint, um", "/loop/position"),
            self._plot("True and measured error, um", *paths, span=self._error_span_um),
            rrb.Horizontal(
                self._plot("P, I, D, feed-forward, um/s", "/loop/terms"),
                self._plot("Flow wanted and given, um/s", "/loop/flow"),
            ),
            self._plot("Time between ticks, s", "/tick/dt"),
            name="tuning",
        )


def _map_name(run: str, most_um: float) -> str:
    """The map's name includes its colour scale, which the viewer does not draw."""
    scale = f", um: blue {-most_um:.2g}, green 0, red {most_um:+.2g}" if most_um == most_um else ""
    return f"{run} Height since the hold's first cycle{scale}".strip()
