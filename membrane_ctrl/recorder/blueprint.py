"""How a run opens in the viewer: one tab per question."""

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import columns, figure_columns, zernike_terms
from membrane_ctrl.model.columns import Group, Plot, plot_title, plots_of
from membrane_ctrl.model.figure_columns import figure_plot_title
from membrane_ctrl.recorder.summary_page import SUMMARY_PATH
from membrane_ctrl.run_files import plot_marks, shapes, streams
from membrane_ctrl.run_files.stream import mean_path

_NO_TIME = TimelineColumn("utc", visible=False)  # too narrow to read: the lines begin with it
_TICKS = "every tick around events, else one a second"
LOOP_PLOTS = tuple(plot for plot in plots_of(Group.LOOP, Group.PUMP) if plot != columns.ERROR)


def run_blueprint(config: Config) -> rrb.Blueprint:
    """The layout of a run; it has a shape tab only if the shape is measured."""
    tabs = [
        _make_overview(config),
        _make_loop_tab(config),
        _make_environment_tab(config),
        _make_timing_tab(),
    ]
    if config.shape.enabled:
        tabs.insert(2, _make_shape_tab(config))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="utc"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _whole_run() -> rrb.TimeAxis:
    """Show the whole run; the default, and plots linked to one axis, show half a minute around the
    cursor.
    """
    everything = rr.TimeRange(
        start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()
    )
    return rrb.TimeAxis(view_range=everything)


def _make_plot(
    name: str, *paths: str, span: tuple[float, float] | None = None, marks: bool = False
) -> rrb.TimeSeriesView:
    """Plot entities; lines of commands and faults only with a span, as they would stretch any other
    axis.
    """
    lines = [stream.path for stream in plot_marks.MARKS] if marks else []
    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=[f"+ {path}" for path in (*lines, *paths)],
        axis_x=_whole_run(),
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),  # over the oldest data
    )


def _make_ticks_plot(plot: Plot, detail: str = "") -> rrb.TimeSeriesView:
    """Plot columns as they are recorded: every tick around events, else one a second."""
    return _make_plot(plot_title(plot, detail), *streams.entities_of(plot))


def _figure_plot(plot: Plot) -> rrb.TimeSeriesView:
    """Plot columns of the measured figures."""
    return _make_plot(figure_plot_title(plot), figure_columns.figure_columns_of(plot)[0].entity)


def _make_means_plot(plot: Plot) -> rrb.TimeSeriesView:
    """Plot the mean of each second."""
    return _make_plot(
        plot_title(plot, "mean of each second"), *map(mean_path, streams.entities_of(plot))
    )


def _make_error_plot(config: Config) -> rrb.TimeSeriesView:
    return _around_band(
        config,
        "Error of each second: least, mean, greatest, µm",
        streams.OVERVIEW.path,
        streams.TRUE_MEAN.path,
    )


def _around_band(config: Config, name: str, *paths: str) -> rrb.TimeSeriesView:
    """Plot over twice the band: the start, tens of µm off, would make the hold invisible."""
    band_um = config.limits.band_um
    return _make_plot(name, "/loop/band", *paths, span=(-2 * band_um, 2 * band_um), marks=True)


def _make_lanes() -> rrb.StateTimelineView:
    contents = [
        "+ /state/controller",
        "+ /state/shape_loop",
        "+ /state/verdict",
        "+ /state/safe_level",
        "+ /state/fault",
    ]
    return rrb.StateTimelineView(
        name="States", origin="/state", contents=contents, time_view=_whole_run()
    )


def _text_log() -> rrb.TextLogView:
    return rrb.TextLogView(
        name="Events, UTC",
        origin="/events",
        columns=rrb.TextLogColumns(
            timeline_columns=[_NO_TIME], text_log_columns=["loglevel", "body"]
        ),
        format_options=rrb.TextLogFormat(monospace_body=False),
    )


def _make_overview(config: Config) -> rrb.Vertical:
    """The first tab: error, means, states and summary of the whole run, and the log."""
    plots = rrb.Vertical(
        _make_error_plot(config),
        _make_means_plot(columns.POSITION),
        rrb.Horizontal(_make_means_plot(columns.DRIVE), _make_means_plot(columns.FLOW)),
        _make_lanes(),
        row_shares=[3, 1.6, 1.6, 2.6],
    )
    page = rrb.TextDocumentView(name="Summary", origin=SUMMARY_PATH)
    return rrb.Vertical(
        rrb.Horizontal(plots, page, column_shares=[3.2, 1]),
        _text_log(),
        row_shares=[4.4, 1],
        name="Overview",
    )


def list_learned_plots(config: Config) -> dict[str, tuple[str, ...]]:
    """Plots of what a loop of this configuration learns: the paths of each, by name."""
    found: dict[str, tuple[str, ...]] = {}
    if config.pump.probe_um:
        found[figure_plot_title(figure_columns.PUMP_CURVE)] = (streams.PUMP.path,)
    if config.estimates_centre:
        found |= {plot_title(plot): streams.entities_of(plot) for plot in plots_of(Group.ESTIMATE)}
    return found


def _make_loop_tab(config: Config) -> rrb.Vertical:
    further = [_make_plot(name, *paths) for name, paths in list_learned_plots(config).items()]
    plots = [*map(_make_ticks_plot, LOOP_PLOTS), *further]
    return rrb.Vertical(
        _around_band(
            config,
            plot_title(columns.ERROR, f"with the band, {_TICKS}"),
            *streams.entities_of(columns.ERROR),
        ),
        *plots,
        row_shares=[3, *(2 for _ in plots)],
        name="Loop",
    )


def _make_environment_tab(config: Config) -> rrb.Vertical:
    # Two plots a row: in one column they are too low for the legend of four temperatures
    plots = [_make_means_plot(plot) for plot in plots_of(Group.ENVIRONMENT)]
    rows = [rrb.Horizontal(*plots[first : first + 2]) for first in range(0, len(plots), 2)]
    return rrb.Vertical(*rows, _make_error_plot(config), name="Environment")


def _make_map(kind: str, name: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(name=name, origin=f"/shape/map/{kind}")


def _make_shape_tab(config: Config) -> rrb.Vertical:
    """The tab of the figure: maps, then sag and terms over time, then the quality of the cycles."""
    # The maps on top, from the whole shape to what a cycle's noise leaves uncertain.
    maps = rrb.Horizontal(
        _make_map("height", "Height, mm"),
        _make_map("difference", "Change since hold began, µm"),
        rrb.Tabs(
            _make_map("difference_no_defocus", "Less piston, tilt, defocus"),
            _make_map("difference_no_tilt", "Less piston, tilt"),
            active_tab=0,
        ),
        _make_map("scatter", "Standard deviation, µm"),
        _make_map("uncertainty", "Noise of a cycle, 1σ, µm"),
        rrb.TextDocumentView(name="Colours", origin="/shape/legend"),
    )
    # Below them sag and low orders in time, then the quality of a cycle.
    band_um = config.limits.band_um
    rows = [
        maps,
        rrb.Horizontal(
            _make_plot(
                figure_plot_title(figure_columns.SAG_CHANGE, "trim"),
                streams.SAG.path,
                *streams.entities_of(columns.TRIM),
                span=(-band_um, band_um),
                marks=True,
            ),
            _make_plot(
                figure_plot_title(figure_columns.LOW_ORDERS, "since the hold began"),
                streams.CHANGE.path,
                span=(-band_um / 4, band_um / 4),
            ),
            rrb.BarChartView(
                name=f"Change of Z2..Z{zernike_terms.ZERNIKE_TERMS}, µm",
                origin=shapes.BARS_PATH,
                plot_legend=rrb.PlotLegend(visible=False),
            ),
        ),
        rrb.Horizontal(
            _figure_plot(figure_columns.FOCUS),
            _figure_plot(figure_columns.FIGURE_RMS),
            _figure_plot(figure_columns.SLOPE_RESIDUAL),
            _figure_plot(figure_columns.FRINGE_QUALITY),
            _figure_plot(figure_columns.LATENCY),
            *(_make_ticks_plot(plot) for plot in plots_of(Group.SHAPE) if plot != columns.TRIM),
        ),
    ]
    # A shape from each frame shows vibrations too.
    if config.shape.mode == "track":
        terms = f"Z{zernike_terms.FIRST_FIGURE_INDEX} (top) to Z{zernike_terms.ZERNIKE_TERMS}"
        fall = f"{terms}, change since hold began; a column a second, now on the right"
        vibrations = _figure_plot(figure_columns.VIBRATIONS)
        rows.insert(
            2,
            rrb.Horizontal(rrb.Spatial2DView(name=fall, origin=shapes.WATERFALL_PATH), vibrations),
        )
    if config.recording.thumbnails:
        names = frame_names(config)
        rows.append(
            rrb.Horizontal(
                *(rrb.Spatial2DView(name=name, origin=f"/frames/{name}") for name in names)
            )
        )
    return rrb.Vertical(*rows, row_shares=[4, 3, 2, 3, 3][: len(rows)], name="Shape")


def frame_names(config: Config) -> tuple[str, ...]:
    """Return the patterns of which a run has the thumbnails that are shown."""
    if config.shape.mode == "track":
        return ("crossed",)
    return tuple(f"{axis}_sin_{k}" for axis in "xy" for k in (0, 1))


def _make_timing_tab() -> rrb.Vertical:
    ticks = [_make_ticks_plot(plot, _TICKS) for plot in plots_of(Group.TIMING)]
    return rrb.Vertical(*ticks, _figure_plot(figure_columns.LATENCY), name="Timing")
