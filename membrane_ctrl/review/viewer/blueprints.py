"""How a review opens: one tab per question, all on the requested time range."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.components import AbsoluteTimeRange
from rerun.blueprint.encodings import TimelineColumn

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import columns, figure_columns
from membrane_ctrl.model.columns import Group, Plot, plot_title, plots_of
from membrane_ctrl.recorder import blueprint, summary_page
from membrane_ctrl.review.viewer.layer import overview_streams, prefix_of
from membrane_ctrl.run_files import streams

TABS = ("overview", "loop", "environment", "shape", "frames", "faults", "tuning")


# Of the coarse review of a run in the catalogue, which has no ticks.
COARSE_TABS = ("overview", "environment", "shape", "faults")


@dataclass(frozen=True, slots=True)
class ReviewBlueprint:
    """Blueprint of a review.

    Attributes
    ----------
    labels : sequence of str
        Names of the runs; `("",)` for a single one.
    timeline : str
        `utc`, or `run_time` for runs aligned at a moment of each.
    span_ns : tuple or None
        Time range to show, on that timeline; None: everything.
    config : Config
        Of the first run; the error plots span three of its bands.
    """

    labels: Sequence[str]
    timeline: str
    span_ns: tuple[int, int] | None
    config: Config

    def make_blueprint(self, tab: str = "overview", tabs: Sequence[str] = TABS) -> rrb.Blueprint:
        """Make the blueprint of the tabs.

        Parameters
        ----------
        tab : str
            The tab that is selected; one of `tabs`.
        tabs : sequence of str
            Some of `TABS`, in the order shown.
        """
        makers = {
            "overview": self._make_overview,
            "loop": self._make_loop_tab,
            "environment": self._make_environment_tab,
            "shape": self._make_shape_tab,
            "frames": self._make_frames_row,
            "faults": self._make_faults_tab,
            "tuning": self._make_tuning_tab,
        }
        selection = None
        if self.span_ns is not None:
            selection = AbsoluteTimeRange(*self.span_ns)
        return rrb.Blueprint(
            rrb.Tabs(*(makers[name]() for name in tabs), active_tab=tabs.index(tab)),
            rrb.TimePanel(state="collapsed", timeline=self.timeline, time_selection=selection),
            rrb.SelectionPanel(state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
            auto_views=False,
        )

    def _make_axis(self) -> rrb.TimeAxis:
        start = rr.TimeRangeBoundary.infinite()
        end = rr.TimeRangeBoundary.infinite()
        if self.span_ns is not None:
            start, end = (rr.TimeRangeBoundary.absolute(nanos=nanos) for nanos in self.span_ns)
        return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))

    def _make_contents(self, paths: Sequence[str]) -> list[str]:
        return [f"+ {prefix_of(label)}{path}" for label in self.labels for path in paths]

    def _make_plot(
        self, name: str, *paths: str, span: tuple[float, float] | None = None
    ) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=name,
            origin="/",
            contents=self._make_contents(paths),
            axis_x=self._make_axis(),
            axis_y=None if span is None else rrb.ScalarAxis(range=span),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),  # over the oldest data
        )

    def _make_ticks_plot(self, plot: Plot) -> rrb.TimeSeriesView:
        return self._make_plot(plot_title(plot), *streams.entities_of(plot))

    def _make_level_plot(self, plot: Plot) -> rrb.TimeSeriesView:
        return self._make_plot(
            plot_title(plot), *(stream.path for stream in overview_streams(plot))
        )

    def _make_figures_page(self, plot: Plot) -> rrb.TimeSeriesView:
        shown = figure_columns.figure_columns_of(plot)
        return self._make_plot(figure_columns.figure_plot_title(plot), shown[0].entity)

    def _around_band(self, name: str, *paths: str) -> rrb.TimeSeriesView:
        """A plot of the error, with lines where something happened: these would stretch an axis of
        no fixed span.
        """
        band_um = self.config.limits.band_um
        span_um = (-3 * band_um, 3 * band_um)
        return self._make_plot(
            name, "/loop/band", "/marks/**", "/found/lines/**", *paths, span=span_um
        )

    def _make_error_plot(self) -> rrb.TimeSeriesView:
        return self._around_band(
            "Error: minimum, mean, maximum, µm",
            *(stream.path for stream in overview_streams(columns.ERROR)),
        )

    def _make_lanes(self) -> rrb.StateTimelineView:
        several = len(self.labels) > 1  # there is room for two lanes of each
        paths = (
            "/state/controller",
            "/state/fault",
            *(() if several else ("/state/shape_loop", "/state/safe_level")),
        )
        return rrb.StateTimelineView(
            name="States",
            origin="/",
            contents=self._make_contents(paths),
            time_view=self._make_axis(),
        )

    def _make_log_view(self, name: str, *paths: str) -> rrb.TextLogView:
        # too narrow to read: the lines begin with it
        hidden = TimelineColumn(self.timeline, visible=False)
        return rrb.TextLogView(
            name=name,
            origin="/",
            contents=self._make_contents(paths),
            columns=rrb.TextLogColumns(
                timeline_columns=[hidden], text_log_columns=["loglevel", "body"]
            ),
            format_options=rrb.TextLogFormat(monospace_body=False),
        )

    def _make_pages(self) -> rrb.Tabs:
        """A page of figures for each run."""
        names = [label or "Summary" for label in self.labels]
        origins = [prefix_of(label) + summary_page.SUMMARY_PATH for label in self.labels]
        return rrb.Tabs(
            *(rrb.TextDocumentView(name=n, origin=o) for n, o in zip(names, origins, strict=True)),
            active_tab=0,
        )

    def _make_overview(self) -> rrb.Vertical:
        plots = rrb.Vertical(
            self._make_error_plot(),
            self._make_lanes(),
            rrb.Horizontal(
                *map(self._make_level_plot, (columns.FLOW, columns.AMBIENT, columns.TEMPERATURES))
            ),
            row_shares=[3.6, 2.5, 2],
        )
        return rrb.Vertical(
            rrb.Horizontal(plots, self._make_pages(), column_shares=[3.4, 1]),
            rrb.Horizontal(
                self._make_log_view("Detected events, UTC", "/found"),
                self._make_log_view("Events, UTC", "/events"),
            ),
            row_shares=[4.2, 1],
            name="overview",
        )

    def _make_loop_tab(self) -> rrb.Vertical:
        further = [
            self._make_plot(name, *paths)
            for name, paths in blueprint.list_learned_plots(self.config).items()
        ]
        plots = [*map(self._make_ticks_plot, blueprint.LOOP_PLOTS), *further]
        return rrb.Vertical(
            self._around_band(
                f"{plot_title(columns.ERROR, 'each tick')} (shown for short runs, or with "
                "--from and --to)",
                "/loop/error",
            ),
            *plots,
            row_shares=[3, *(2 for _ in plots)],
            name="loop",
        )

    def _make_environment_tab(self) -> rrb.Vertical:
        plots = [self._make_level_plot(plot) for plot in plots_of(Group.PUMP, Group.ENVIRONMENT)]
        return rrb.Vertical(
            self._make_error_plot(), *plots, row_shares=[2, *(1 for _ in plots)], name="environment"
        )

    def _make_shape_tab(self) -> rrb.Vertical:
        rows = [self._make_maps(label) for label in self.labels]
        plots = [
            rrb.Horizontal(
                self._make_figures_page(figure_columns.SAG_CHANGE),
                self._make_figures_page(figure_columns.LOW_ORDERS),
            ),
            rrb.Horizontal(
                self._make_figures_page(figure_columns.FOCUS),
                self._make_figures_page(figure_columns.FIGURE_RMS),
                self._make_figures_page(figure_columns.SLOPE_RESIDUAL),
                *map(self._make_level_plot, plots_of(Group.SHAPE)),
            ),
        ]
        return rrb.Vertical(*rows, *plots, row_shares=[3] * len(rows) + [2.5, 1.5], name="shape")

    def _make_maps(self, label: str) -> rrb.Horizontal:
        def view(kind: str, name: str) -> rrb.Spatial2DView:
            return rrb.Spatial2DView(
                name=f"{label} {name}".strip(), origin=f"{prefix_of(label)}/shape/map/{kind}"
            )

        less = rrb.Tabs(
            view("difference_no_defocus", "Less piston, tilt, defocus"),
            view("difference_no_tilt", "Less piston, tilt"),
            active_tab=0,
        )
        return rrb.Horizontal(
            view("difference", "Change since the hold's first cycle"),
            less,
            view("scatter", "Standard deviation"),
            rrb.TextDocumentView(name="Colours", origin=f"{prefix_of(label)}/shape/legend"),
            column_shares=[1, 1, 1, 0.8],
        )

    def _make_frames_row(self) -> rrb.Vertical:
        """Thumbnails of the camera's frames, a row for each run."""
        names = blueprint.frame_names(self.config)
        rows = [
            rrb.Horizontal(
                *(
                    rrb.Spatial2DView(
                        name=f"{label} {name}".strip(),
                        origin=f"{prefix_of(label)}/frames/{name}",
                    )
                    for name in names
                )
            )
            for label in self.labels
        ]
        return rrb.Vertical(*rows, name="frames")

    def _make_faults_tab(self) -> rrb.Vertical:
        return rrb.Vertical(
            self._make_lanes(),
            self._make_error_plot(),
            rrb.Horizontal(
                *map(self._make_level_plot, (columns.LATENESS, columns.MISSED, columns.GAUGE))
            ),
            rrb.Horizontal(
                self._make_log_view("Events, UTC", "/events"),
                self._make_log_view("Detected events, UTC", "/found"),
            ),
            row_shares=[2.2, 3, 2, 2.8],
            name="faults",
        )

    def _make_tuning_tab(self) -> rrb.Vertical:
        return rrb.Vertical(
            self._make_ticks_plot(columns.POSITION),
            self._around_band(plot_title(columns.ERROR), *streams.entities_of(columns.ERROR)),
            rrb.Horizontal(
                self._make_ticks_plot(columns.TERMS), self._make_ticks_plot(columns.FLOW)
            ),
            self._make_ticks_plot(columns.INTERVAL),
            name="tuning",
        )


def labels_of(names: Sequence[str]) -> list[str]:
    """Names of overlaid runs, without the times of their starts if they differ even so; empty for a
    single run.
    """
    if len(names) == 1:
        return [""]
    short = [re.sub(r"^\d{8}T\d{6}Z-(?=.)", "", name) for name in names]
    names = short if len(set(short)) == len(names) else names
    return [
        name if names.count(name) == 1 else f"{name} ({place})"
        for place, name in enumerate(names, 1)
    ]
