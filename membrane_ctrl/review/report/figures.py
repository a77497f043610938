"""Pictures of the hold: the run at a glance, everything else over time, distributions."""

import io
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from membrane_ctrl.model import colours, events, run_events, zernike_terms
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.colours import DIVERGING_MAP, SEQUENTIAL_MAP, Colour
from membrane_ctrl.model.columns import (
    DRAWN,
    ERROR,
    Plot,
    TelemetryColumn,
    aggregated_of,
    columns_of,
    plot_title,
    plots_of,
)
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.review.formatting import format_span, one_line
from membrane_ctrl.review.report.json import make_timeline
from membrane_ctrl.review.report.pump_history import PumpSeen
from membrane_ctrl.review.statistics import (
    climate_review,
    held_scalars,
    power_spectrum,
    shape_review,
)
from membrane_ctrl.review.statistics.analysis import Analysis
from membrane_ctrl.run_files.shapes import without_terms

BLUE, ORANGE, GREEN, RED, VIOLET, GREY = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#8a8f98",
)
# Of a picture over the whole page, and of a panel: two or three stand side by side on a wide page,
# and a phone shows one at its full width with letters of 9 px.
WIDTH_IN, PANEL_IN = 10.5, 5.2

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
    # makes reports reproducible
    "svg.hashsalt": "membrane",
    "svg.fonttype": "none",
}


# Colours that are too pale on white.
_DARKER: dict[Colour, str] = {
    colours.BLUE: BLUE,
    colours.WHITE: "#444b55",
    colours.YELLOW: "#a89b00",
}
# An occasional missing cycle or second is not a gap.
_STEPS = 3.0
_LEAST_S = 5.0
_STATE_COLOURS = {
    State.STANDBY: "#c9ccd1",
    State.CHECK: "#9ecae1",
    State.INFLATE: "#56b4e9",
    State.SETTLE: ORANGE,
    State.HOLD: GREEN,
    State.MANUAL: VIOLET,
    State.TUNE: "#f0e442",
    State.LOWER: ORANGE,
    State.FAULT: RED,
}
# Of a mark's text: more would not fit beside its line; the timeline has the full text.
_LETTERS_MOST = 40
_SHOWN_BANDS = 3.0  # of the error, at a glance
_FOUND_COLOURS = {
    "pressure step": VIOLET,
    "flow step": ORANGE,
    "noise change": ORANGE,
    "shape jump": BLUE,
}
# The paper's stability plots, from the live cycles. More points than pixels only make the file
# large.
_LINE_POINTS = 1500
_POINT_COLOURS = {"A": BLUE, "B": ORANGE, "C": VIOLET}


def on_white(colour: Colour) -> str:
    """Return a colour of the table of columns for a white background."""
    red, green, blue = colour
    return _DARKER.get(colour, f"#{red:02x}{green:02x}{blue:02x}")


@contextmanager
def make_picture(
    rows: int = 1,
    columns: int = 1,
    height_in: float = 3.0,
    width_in: float = WIDTH_IN,
    **subplots: Any,
) -> Iterator[tuple[Figure, Any]]:
    """Make a figure in the report's style within a `with` block.

    The style holds only within the block: render the figure there, too.

    Parameters
    ----------
    rows, columns : int
        Number of axes.
    height_in, width_in : float
        Inches, all axes and titles included.
    **subplots
        Passed to `Figure.subplots`.

    Yields
    ------
    figure : Figure
    axes : Axes or array of Axes
        As `Figure.subplots` returns them.
    """
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        yield figure, figure.subplots(rows, columns, **subplots)


def render_svg(figure: Figure) -> Markup:
    """The figure as an `<svg>` element that scales with the page."""
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        # text stays text in the page, in the reader's fonts
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font")
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    svg = text[text.index("<svg") :]
    # Without its own size the drawing takes the width of the page
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg)
    return Markup(svg)


def draw_panel(draw: Callable[[Figure, Any], None], height_in: float) -> Markup:
    """Draw one panel as SVG; two or three of them are side by side on a page.

    Parameters
    ----------
    draw : callable
        Called with the figure and its axes, which it fills.
    height_in : float
        Inches; the width is `PANEL_IN`.
    """
    with make_picture(1, 1, height_in, PANEL_IN) as (figure, axes):
        draw(figure, axes)
        return render_svg(figure)


def arrange_panels(panels: Iterable[Markup]) -> Markup:
    """Panels side by side where the page is wide enough, else below each other: HTML."""
    boxes = Markup("").join(Markup("<div>{}</div>").format(panel) for panel in panels)
    return Markup("<div class='panels'>{}</div>").format(boxes)


def broken_at_gaps(columns: Mapping[str, Column], time_name: str = "time_s") -> dict[str, Column]:
    """Columns with a row of NaN in every gap, so that a plot does not bridge it with a straight
    line.

    A gap in the times (s, ascending, in the column `time_name`) is longer than 5 s and three of
    their usual steps.

    Parameters
    ----------
    columns : mapping of Column
        Columns of n rows by name.
    time_name : str
        The column of times.

    Returns
    -------
    dict of Column
        The same columns with a row of NaN in every gap.
    """
    time_s = columns[time_name]
    steps_s = np.diff(time_s)
    longest_s = np.inf
    if steps_s.size:
        longest_s = max(_LEAST_S, _STEPS * float(np.median(steps_s)))
    before = np.flatnonzero(steps_s > longest_s)
    broken = {
        name: np.insert(np.asarray(values, np.float64), before + 1, np.nan, axis=0)
        for name, values in columns.items()
    }
    broken[time_name] = np.insert(time_s, before + 1, time_s[before] + steps_s[before] / 2)
    return broken


def hours_or_less(time_s: Column | float, span_s: float) -> tuple[Any, str]:
    """Convert times to a unit that suits the length of an axis.

    Parameters
    ----------
    time_s : (n,) array or float
        Seconds.
    span_s : float
        Length of the whole axis in seconds, which selects the unit.

    Returns
    -------
    time : array
        The times in that unit.
    unit : str
        `d`, `h`, `min` or `s`.
    """
    for unit_s, least, name in ((86400.0, 3, "d"), (3600.0, 3, "h"), (60.0, 5, "min")):
        if span_s >= least * unit_s:
            return np.asarray(time_s) / unit_s, name
    return np.asarray(time_s), "s"


def draw_overview(analysis: Analysis) -> Markup:
    """Error with its envelope, the band, states, detected events and marks: HTML with a picture for
    wide pages and one for phones.
    """
    wide = _draw_overview(analysis, WIDTH_IN, 4.2)
    narrow = _draw_overview(analysis, PANEL_IN, 4.0)
    return Markup("<div class='on-wide'>{}</div><div class='on-phone'>{}</div>").format(
        wide, narrow
    )


def _draw_overview(analysis: Analysis, width_in: float, height_in: float) -> Markup:
    level = broken_at_gaps(analysis.level)
    band_um = analysis.run.config.limits.band_um
    span_s = analysis.ticks.end_s - analysis.ticks.start_s
    time, unit = hours_or_less(level["time_s"], span_s)
    with make_picture(2, 1, height_in, width_in, sharex=True, height_ratios=[8, 1.1]) as (
        figure,
        (plot, lane),
    ):
        plot.axhspan(-band_um, band_um, color=GREEN, alpha=0.09, lw=0)
        ends = level["min_error_um"], level["max_error_um"]
        plot.fill_between(time, *ends, color=GREY, alpha=0.35, lw=0, label="minimum to maximum")
        plot.plot(
            time, level["mean_error_um"], color=BLUE, label=f"error, mean of {analysis.level_s:g} s"
        )
        if np.isfinite(level["mean_true_error_um"]).any():
            plot.plot(
                time, level["mean_true_error_um"], color=GREEN, lw=0.9, label="true centre (twin)"
            )
        # The scale is that of the band; the title states how far the error goes beyond it.
        most_um = _SHOWN_BANDS * band_um
        plot.set_ylim(-most_um, most_um)
        largest_um = float(np.nanmax(np.abs(ends), initial=0.0))
        beyond = ""
        if largest_um > most_um:
            beyond = f" (up to {largest_um:.3g} µm, beyond the scale)"
        plot.set(ylabel=plot_title(ERROR), title=f"The run at a glance{beyond}")
        _draw_found_events(plot, analysis, span_s)
        plot.legend(loc="upper right", ncols=3 if width_in == WIDTH_IN else 1)
        _draw_lane(lane, analysis, span_s)
        lane.set_xlabel(f"time since {analysis.run.origin_utc:%Y-%m-%d %H:%M:%S} UTC, {unit}")
        return render_svg(figure)


def _draw_found_events(plot: Any, analysis: Analysis, span_s: float) -> None:
    top = plot.get_ylim()[1]
    for found in analysis.found:
        at, _ = hours_or_less(found.time_s, span_s)
        colour = _FOUND_COLOURS.get(found.kind, RED)
        plot.axvline(at, color=colour, lw=0.8, ls=":")
        plot.plot([at], [0.96 * top], marker="v", ms=5, color=colour, clip_on=False)
    for noted in make_timeline(analysis):
        if isinstance(event := noted.event, (events.Fault, run_events.Mark)):
            at, _ = hours_or_less(noted.mono_s, span_s)
            if isinstance(event, events.Fault):
                colour = RED
                text = event.name
            else:
                colour = "black"
                text = event.text
            plot.axvline(at, color=colour, lw=1)
            text = one_line(text)
            if len(text) > _LETTERS_MOST:
                text = f"{text[: _LETTERS_MOST - 1]}…"
            plot.annotate(
                text,
                (at, 0.8 * top),
                rotation=90,
                fontsize=7,
                color=colour,
                ha="right",
                va="top",
                parse_math=False,
            )


def _draw_lane(lane: Any, analysis: Analysis, span_s: float) -> None:
    """States as coloured bars, named where there is room."""
    states = [
        (at.mono_s, at.event.state)
        for at in make_timeline(analysis)
        if isinstance(at.event, events.StateEntered)
    ]
    edges_s = [start_s for start_s, _ in states]
    edges_s.append(max(analysis.ticks.end_s, *edges_s, 0.0))
    for (start_s, name), end_s in zip(states, edges_s[1:], strict=True):
        try:
            state = State[name.upper()]
        except KeyError:
            continue
        (start, end), _ = hours_or_less(np.array([start_s, end_s]), span_s)
        lane.axvspan(start, end, color=_STATE_COLOURS[state], lw=0)
        if end_s - start_s > 0.06 * span_s:
            lane.text(
                (start + end) / 2,
                0.5,
                state.name.lower(),
                ha="center",
                va="center",
                fontsize=8,
                color="white",
            )
    lane.set(ylim=(0, 1), yticks=[])
    lane.grid(False)


def everything_else(analysis: Analysis) -> Markup:
    """Position, flow, pump, gas, air, trim, timing: each plot of the table of columns that the run
    has values for.
    """
    level = broken_at_gaps(analysis.level)
    time, unit = hours_or_less(level["time_s"], analysis.ticks.end_s - analysis.ticks.start_s)
    plots = {
        plot: [each for each in aggregated_of(plot) if _has_values(level, each)]
        for plot in plots_of(*DRAWN)
    }
    shown = {plot: columns for plot, columns in plots.items() if columns and plot != ERROR}

    def draw_plot(_: Figure, axes: Any, plot: Plot) -> None:
        _draw_columns(axes, time, level, shown[plot])
        axes.set(title=plot_title(plot), xlabel=unit)

    return arrange_panels(draw_panel(partial(draw_plot, plot=plot), 2.3) for plot in shown)


def _has_values(level: Mapping[str, Column], each: TelemetryColumn) -> bool:
    return bool(np.isfinite(level[f"mean_{each.name}"]).any())


def _draw_columns(
    axis: Any, time: Column, level: Mapping[str, Column], columns: Sequence[TelemetryColumn]
) -> None:
    """Draw the means of columns of one plot; of a single one minimum and maximum, too."""
    for each in columns:
        axis.plot(
            time, level[f"mean_{each.name}"], color=on_white(each.colour), label=each.short_label
        )
    if len(columns) == 1:
        (each,) = columns
        lowest = level[f"min_{each.name}"]
        highest = level[f"max_{each.name}"]
        axis.fill_between(time, lowest, highest, color=on_white(each.colour), alpha=0.2, lw=0)
    if len(columns_of(columns[0].plot)) > 1:
        axis.legend(loc="upper right", ncols=len(columns))
    axis.ticklabel_format(useOffset=False)


def draw_distributions(analysis: Analysis) -> Markup:
    """Histogram, Allan deviation, spectrum."""
    reading = analysis.reading
    true = analysis.true
    named = [
        (series, colour, name)
        for series, colour, name in ((reading, BLUE, "reading"), (true, GREEN, "true centre"))
        if series is not None
    ]

    def draw_histogram(_: Figure, plot: Any) -> None:
        edges = analysis.ticks.histogram_um
        counts = analysis.ticks.histogram_counts
        merged = counts.reshape(-1, 5).sum(axis=1)
        middle = edges[:-1].reshape(-1, 5).mean(axis=1) + (edges[1] - edges[0]) / 2
        share = 100 * merged / max(1, counts.sum())
        plot.bar(middle, share, width=5 * (edges[1] - edges[0]), color=BLUE, lw=0.3, ec=BLUE)
        band_um = analysis.run.config.limits.band_um
        for side in (-band_um, band_um):
            plot.axvline(side, color=GREEN, lw=1)
        # the first and the last bin count what lies beyond them
        plot.set(
            title="Single readings (outermost bars: and beyond)",
            xlabel="setpoint − reading, µm",
            ylabel="share, %",
        )

    def draw_allan(_: Figure, plot: Any) -> None:
        for series, colour, name in named:
            if series.allan.tau_s.size:
                tau_s = series.allan.tau_s
                deviation_um = series.allan.deviation
                plot.loglog(tau_s, deviation_um, "o-", ms=3, color=colour, label=name)
        plot.set(title="Overlapping Allan deviation", xlabel="τ, s", ylabel="µm")
        _add_legend(plot)

    def draw_spectrum(_: Figure, plot: Any) -> None:
        for series, colour, name in named:
            frequency_hz, power = power_spectrum.combine_densities(series.spectrum, series.slow)
            if np.isfinite(power).any():
                plot.loglog(frequency_hz, np.sqrt(power), color=colour, lw=0.8, label=name)
        plot.set(title="Amplitude spectral density", xlabel="Hz", ylabel="µm/√Hz")
        _add_legend(plot)

    return arrange_panels(
        draw_panel(draw, 3.0) for draw in (draw_histogram, draw_allan, draw_spectrum)
    )


def _add_legend(plot: Any) -> None:
    if plot.lines:
        plot.legend(loc="best")


def pump_history(history: Sequence[PumpSeen], change_max: float) -> Markup:
    """Draw the pump's flow over the runs of a bench, and the leak of each.

    Parameters
    ----------
    history : sequence of PumpSeen
        Oldest first; not empty.
    change_max : float
        `pump.change_max`: the dashed limits are this share above and below the first run that has
        the newest run's curve.

    Returns
    -------
    Markup
        Two panels as SVG.
    """
    first = next(seen for seen in history if seen.same_curve)
    days = [seen.started_utc for seen in history]

    def draw_scale(_: Figure, plot: Any) -> None:
        scales = [seen.scale for seen in history]
        sigmas = [seen.sigma for seen in history]
        plot.errorbar(days, scales, sigmas, fmt="o-", color=BLUE, ms=4)
        for limit in (1 - change_max, 1 + change_max):
            plot.axhline(first.scale * limit, color=RED, lw=0.8, ls="--")
        plot.set(title="Pump's flow against its curve ± 1 σ")
        plot.tick_params(axis="x", rotation=20)

    def draw_leak(_: Figure, plot: Any) -> None:
        plot.plot(days, [seen.leak_um_per_s for seen in history], "o-", color=ORANGE, ms=4)
        plot.set(title="Leak, with any offset of the curve, µm/s")
        plot.tick_params(axis="x", rotation=20)

    return arrange_panels(draw_panel(draw, 2.6) for draw in (draw_scale, draw_leak))


def draw_stability(shape: shape_review.ShapeReview) -> Markup:
    """Heights at A, B, C; camera against laser; the map of the standard deviation; drift of the
    terms.
    """
    # Lines of no more points than a page shows, interrupted at gaps.
    span_s = float(np.ptp(shape.time_s))
    every = max(1, shape.time_s.size // _LINE_POINTS)
    lines = {
        "time_s": shape.time_s,
        "sag": shape.sag_um,
        "laser": shape.laser_um,
        **shape.points_um,
    }
    lines = broken_at_gaps({name: values[::every] for name, values in lines.items()})
    time, unit = hours_or_less(lines["time_s"], span_s)

    def draw_points(_: Figure, plot: Any) -> None:
        for name in shape.points_um:
            plot.plot(time, lines[name], color=_POINT_COLOURS[name], lw=0.9, label=name)
        start = format_span(shape.time_s[0])
        plot.set(title=f"Height at A, B, C since the settled cycle at {start}, µm", xlabel=unit)
        plot.legend(loc="upper right", ncols=3)

    def draw_deviation(figure: Figure, plot: Any) -> None:
        title = "Standard deviation of the height, µm"
        _draw_map(figure, plot, shape.sd_um, title, SEQUENTIAL_MAP, (0, None))
        for name, (x, y) in shape_review.POINTS.items():
            plot.plot(x, y, "o", ms=4, mfc="none", mec="white")
            plot.annotate(
                name, (x, y), color="white", fontsize=8, xytext=(4, 3), textcoords="offset points"
            )

    def draw_loops(_: Figure, plot: Any) -> None:
        plot.plot(time, lines["laser"], color=GREY, lw=0.9, label="laser (in the loop)")
        plot.plot(time, lines["sag"], color=BLUE, lw=0.9, label="sag by the camera")
        plot.set(title="Change of the centre by laser and by camera, µm", xlabel=unit)
        plot.legend(loc="upper right", ncols=2)

    def draw_drift(_: Figure, plot: Any) -> None:
        _draw_drift(plot, shape)

    return arrange_panels(
        draw_panel(draw, 3.1) for draw in (draw_points, draw_deviation, draw_loops, draw_drift)
    )


def draw_scalars(series: held_scalars.HeldSeries) -> Markup:
    """Focus and RMS over the run with error bars, and the image of a star."""
    time, unit = hours_or_less(series.time_s, float(np.ptp(series.time_s)))
    focus_mm = series.values_of("focus_mm")

    def draw_focus(_: Figure, plot: Any) -> None:
        change_um = 1e3 * (focus_mm - focus_mm[0])
        sigma_um = 1e3 * np.nan_to_num(series.values_of("focus_sigma_mm"))
        plot.errorbar(time, change_um, sigma_um, color=BLUE, lw=0.9, elinewidth=0.5)
        plot.set(title="Change of the focus, 1 σ, µm", xlabel=unit)

    def draw_rms(_: Figure, plot: Any) -> None:
        sigma_um = np.nan_to_num(series.values_of("rms_sigma_um"))
        rms_um = series.values_of("rms_um")
        least_um = series.values_of("least_rms_um")
        plot.errorbar(time, rms_um, sigma_um, color=BLUE, lw=0.9, elinewidth=0.5, label="RMS")
        plot.plot(time, least_um, color=ORANGE, lw=0.9, label="at the best depth")
        plot.set(title="Change of the figure without piston and tilt, 1 σ, µm", xlabel=unit)
        plot.legend(loc="upper left", ncols=2)

    panels: list[Callable[[Figure, Any], None]] = [draw_focus, draw_rms]
    image = series.image
    if image is not None and image.resolved:
        shown = image

        def draw_image(figure: Figure, plot: Any) -> None:
            half_um = shown.pixel_um * len(shown.spread) / 2
            extent = (-half_um, half_um, -half_um, half_um)
            relative = np.log10(np.maximum(shown.spread / shown.spread.max(), 1e-4))
            drawn = plot.imshow(relative, extent=extent, origin="lower", cmap=SEQUENTIAL_MAP)
            figure.colorbar(drawn, ax=plot)
            view_um = min(half_um, 3 * shown.radius_80_um)
            plot.set(
                title=f"Image of a star at {series.wavelength_um:g} µm, log10 of the peak",
                xlabel="µm",
                xlim=(-view_um, view_um),
                ylim=(-view_um, view_um),
            )

        panels.append(draw_image)
    return arrange_panels(draw_panel(draw, 3.1) for draw in panels)


def draw_climate(climate: climate_review.ClimateReview) -> Markup:
    """Temperatures and humidity over the run, and the predicted change of the figure."""
    time, unit = hours_or_less(climate.time_s, float(np.ptp(climate.time_s)))

    def draw_temperatures(_: Figure, plot: Any) -> None:
        plot.plot(time, climate.film_c, color=BLUE, lw=0.9, label="film")
        plot.plot(time, climate.ring_c, color=GREY, lw=0.9, label="ring")
        plot.set(title="Temperature, °C", xlabel=unit)
        plot.legend(loc="upper right", ncols=2)

    def draw_humidity(_: Figure, plot: Any) -> None:
        plot.plot(time, climate.humidity_percent, color=BLUE, lw=0.9)
        plot.set(title="Relative humidity, %", xlabel=unit)

    def draw_change(_: Figure, plot: Any) -> None:
        plot.plot(time, climate.figure_um, color=BLUE, lw=0.9)
        plot.axhline(climate.notice_um, color=ORANGE, lw=0.7, ls="--")
        plot.set(title="Predicted change of the figure, RMS, µm (line: notice)", xlabel=unit)

    return arrange_panels(
        draw_panel(draw, 3.1) for draw in (draw_temperatures, draw_humidity, draw_change)
    )


def _draw_drift(plot: Any, shape: shape_review.ShapeReview) -> None:
    noll = zernike_terms.NOLL_INDICES[1:]
    rate = np.array([term.per_hour for term in shape.drift_um_per_hour])
    reach = np.array([(term.high - term.low) / 2 for term in shape.drift_um_per_hour])
    colours = [RED if term.is_significant else GREY for term in shape.drift_um_per_hour]
    if np.isfinite(rate).any():
        plot.bar(noll, rate, yerr=reach, color=colours, error_kw={"lw": 0.7, "ecolor": "#555"})
        # a wandering term with a meaningless interval would hide all the others
        plot.set_yscale("symlog", linthresh=4 * max(float(np.nanmedian(reach)), 1e-6), linscale=2)
    plot.set(title="Drift of the terms, µm/h (95 %)", xlabel="Noll index")


def draw_pairs(shape: shape_review.ShapeReview) -> Markup:
    """Height change of cycles 1 and 10 minutes apart, the same less its low terms, and its
    uncertainty.
    """

    def draw_change(figure: Figure, plot: Any, values: Column, title: str) -> None:
        # a few pixels must not hide the rest
        most = float(np.nanquantile(np.abs(values), 0.99)) or 1e-3
        _draw_map(figure, plot, values, title, DIVERGING_MAP, (-most, most))

    def draw_sigma(figure: Figure, plot: Any, pair: shape_review.CyclePair) -> None:
        if pair.sigma_um is None:
            words = "no covariance was recorded"
            plot.text(0.5, 0.5, words, ha="center", transform=plot.transAxes)
            plot.set_axis_off()
            return
        title = f"Its uncertainty, 1 σ, µm (mean {pair.mean_sigma_um:.4f})"
        _draw_map(figure, plot, pair.sigma_um, title, SEQUENTIAL_MAP, (0, None))

    panels = []
    for pair in shape.pairs:
        title = f"Change over {pair.lag_s:.0f} s, µm (RMS {pair.rms_um:.3f})"
        less = without_terms(pair.change_um, 4)
        panels += [
            draw_panel(partial(draw_change, values=pair.change_um, title=title), 3.0),
            draw_panel(partial(draw_change, values=less, title="Less piston, tilt, defocus"), 3.0),
            draw_panel(partial(draw_sigma, pair=pair), 3.0),
        ]
    return arrange_panels(panels)


def _draw_map(
    figure: Any,
    plot: Any,
    values: Column,
    title: str,
    colours: str,
    span: tuple[float, float | None],
) -> None:
    shown = plot.imshow(
        values,
        extent=(-1, 1, -1, 1),
        cmap=colours,
        vmin=span[0],
        vmax=span[1],
        interpolation="none",
    )
    plot.set(title=title, xticks=[], yticks=[])
    plot.grid(False)
    for side in plot.spines.values():
        side.set_visible(False)
    figure.colorbar(shown, ax=plot, shrink=0.85)
