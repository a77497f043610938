"""The report of one run as a page: verdict, findings, hold quality, pump, figure and timeline."""

import shlex
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from membrane_ctrl.model import program
from membrane_ctrl.model.events import Fault
from membrane_ctrl.report_pages.blocks import (
    PageBlock,
    PageDrawing,
    PageFacts,
    PageSection,
    PageTable,
    PageText,
    PageWarnings,
    ReportPage,
    TextMark,
)
from membrane_ctrl.report_pages.render import render_page
from membrane_ctrl.review.formatting import (
    format_number,
    format_signed,
    format_span,
    format_time_beside,
)
from membrane_ctrl.review.report import figures
from membrane_ctrl.review.report.json import make_timeline, make_verdict
from membrane_ctrl.review.report.pump_history import PumpSeen, explain_pump_change
from membrane_ctrl.review.statistics import (
    climate_review,
    compare,
    drift,
    held_scalars,
    power_spectrum,
    shape_review,
)
from membrane_ctrl.review.statistics.analysis import Analysis
from membrane_ctrl.review.statistics.error_series import ErrorSeries
from membrane_ctrl.run_files.held_error import format_in_band

# A month has thousands of lines; the JSON report has them all.
_LINES_MOST = 200
READING = "reading (in the loop)"
TRUE = "true centre (twin)"
MARKS = {"good": TextMark.GOOD, "look": TextMark.LOOK, "bad": TextMark.BAD}
_EXAMINE = Markup(
    "<code>membrane-ctrl review {run} --from +{start_s:.0f}s --to +{end_s:.0f}s</code>"
)
_NOTHING_FOUND = (
    "None besides what the hold reported: no door, flow step, laser glitch or loss, lateness "
    "burst, noise change, drift, excursion or jump."
)
_REPORTED_MOST = 20
_SCALAR_NAMES = {"vertex": "vertex", "focus": "focus", "best_fit": "best fit"}


def render_report(
    analysis: Analysis,
    other: Analysis | None = None,
    differences: Sequence[compare.Difference] = (),
    history: Sequence[PumpSeen] = (),
) -> str:
    """Return a report's HTML, optionally with another run and the differences from it.

    Parameters
    ----------
    analysis : Analysis
        The run.
    other : Analysis, optional
        The run to compare with.
    differences : sequence of Difference
        Of the two runs (`compare.compare_analyses`).
    history : sequence of PumpSeen
        The pump in this and earlier runs (`pump_history`); shown if there are at least two.
    """
    sections = [
        PageSection("", _list_headlines(analysis)),
        PageSection("Detected events", _list_found(analysis)),
        PageSection(
            "Hold quality",
            [
                _tabulate_windows(analysis),
                *_list_details(analysis),
                PageDrawing(figures.draw_distributions(analysis)),
            ],
        ),
        PageSection(
            "Pump, leak, feed-forward, ticks",
            [PageFacts(_pump_facts(analysis)), PageDrawing(figures.everything_else(analysis))],
        ),
    ]
    if analysis.shape is not None:
        sections.append(PageSection("Figure", _list_shape(analysis.shape)))
    if analysis.scalars is not None:
        sections.append(PageSection("What was held", _list_scalars(analysis.scalars)))
    if analysis.climate is not None:
        sections.append(PageSection("Climate", _list_climate(analysis.climate)))
    if len(history) > 1:
        blocks = _list_history(history, analysis.run.config.pump.change_max)
        sections.append(PageSection("Pump over the runs", blocks))
    if other is not None:
        blocks = _list_comparison(analysis, other, differences)
        sections.append(PageSection(f"Against {other.run.name}", blocks))
    sections.append(PageSection("Timeline", _list_timeline(analysis)))
    return render_page(
        ReportPage(
            title=analysis.run.name,
            sections=sections,
            beside_heading=_describe_time(analysis),
            footer=_describe_origin(analysis),
        )
    )


def _describe_time(analysis: Analysis) -> str:
    ticks = analysis.ticks
    began = f"{analysis.run.utc(ticks.start_s):%Y-%m-%d %H:%M:%S} UTC"
    return f"{began}, {format_span(ticks.end_s - ticks.start_s)}"


def _describe_origin(analysis: Analysis) -> str:
    run = analysis.run
    recorded = ""
    if run.recorded_by:
        recorded = f", recorded by {run.recorded_by}"
    return f"{program.program_identity()}, report of {run.folder.name}{recorded}"


def _list_headlines(analysis: Analysis) -> list[PageBlock]:
    """List what a reader needs first: the verdict, what is unusual, and the run at a glance."""
    word, sentence = make_verdict(analysis)
    blocks: list[PageBlock] = [PageText(sentence, MARKS[word])]
    if analysis.anomalies:
        blocks.append(PageWarnings([(each.name, each.seen) for each in analysis.anomalies]))
    blocks.append(PageDrawing(figures.draw_overview(analysis)))
    return blocks


def _list_found(analysis: Analysis) -> list[PageBlock]:
    if not analysis.found:
        return [PageText(_NOTHING_FOUND), *_list_reported(analysis)]
    name = shlex.quote(analysis.run.name)
    rows = [
        [
            f"{analysis.run.utc(event.time_s):%Y-%m-%d %H:%M:%S}",
            event.kind,
            f"{format_number(event.size)} {event.unit}",
            f"{event.confidence:.3f}",
            _EXAMINE.format(run=name, start_s=max(event.start_s, 1), end_s=event.end_s),
        ]
        for event in analysis.found[:_LINES_MOST]
    ]
    table = PageTable(["UTC", "what", "size", "confidence", "look at it"], rows)
    return [table, *_list_rest(len(analysis.found)), *_list_reported(analysis)]


def _list_reported(analysis: Analysis) -> list[PageBlock]:
    """What the hold's own rules reported, and what the run is too short to show."""
    blocks: list[PageBlock] = []
    if analysis.unjudged:
        words = "; ".join(analysis.unjudged)
        blocks.append(PageText(f"Not judged, as the run is too short: {words}."))
    reported = [
        (f"{analysis.run.utc(each.mono_s):%H:%M:%S}", each.event.sentence)
        for each in make_timeline(analysis)
        if isinstance(each.event, Fault) or (each.event.opens and each.event.opens_notice)
    ]
    if reported:
        blocks += [PageText("Reported by the hold:"), PageFacts(reported[:_REPORTED_MOST])]
    return blocks


def _tabulate_windows(analysis: Analysis) -> PageTable:
    """Tabulate the hold's error by means over windows of increasing length."""
    rows = []
    for name, series in ((READING, analysis.reading), (TRUE, analysis.true)):
        if series is None:
            continue
        for window in series.windows:
            errors_um = (window.mean_um, window.std_um, window.p99_7_um, window.max_um)
            rows.append(
                [
                    name,
                    f"{window.window_s:g} s",
                    f"{window.count}",
                    *map(format_number, errors_um),
                    format_in_band(window.in_band),
                ]
            )
    band = f"in ±{analysis.run.config.limits.band_um:g} µm"
    head = ["", "means of", "count", "mean µm", "std µm", "p99.7 µm", "maximum µm", band]
    return PageTable(head, rows)


def _list_details(analysis: Analysis) -> list[PageBlock]:
    if analysis.true is None:
        series = analysis.reading
        name = READING
    else:
        series = analysis.true
        name = TRUE
    if series is None:
        return []
    ticks = analysis.ticks
    whole_s = ticks.end_s - ticks.start_s
    beside = format_time_beside(ticks.faults_s, ticks.paused_s, ticks.moving_s, whole_s)
    std_um = format_number(ticks.raw_reading.std)
    single = f"std {std_um} µm, {100 * ticks.raw_in_band:.2f} % within the band"
    unread = f"{format_number(ticks.unread_s)} s held without readings"
    facts = [
        (f"drift, {name}", _format_slope(series.drift, "µm/h")),
        ("not counted as held", ", ".join(beside) or "nothing"),
        ("single readings", f"{single}; {unread}"),
        (f"RMS by frequency, {name}", _format_bands(series)),
    ]
    return [PageFacts(facts)]


def _format_bands(series: ErrorSeries) -> str:
    there = [
        band
        for band in power_spectrum.band_rms(series.spectrum, series.slow)
        if band.rms_um == band.rms_um
    ]
    if not there:
        return "too short to say"
    bands = [
        f"{format_number(b.from_hz)}–{format_number(b.high_hz)} Hz: {format_number(b.rms_um)} µm"
        for b in there
    ]
    unresolved = format_span(power_spectrum.unseen_s(there))
    return f"{'; '.join(bands)}; not resolved: motion slower than {unresolved}"


def _pump_facts(analysis: Analysis) -> list[tuple[str, str]]:
    ticks = analysis.ticks
    pump = ticks.pump
    late = ticks.lateness_ms
    median, least, most = analysis.leak_um_per_s
    facts = [
        (
            "pump",
            f"{100 * pump.mean_fraction:.1f} ± {100 * pump.std_fraction:.1f} % of full, running "
            f"{100 * pump.running_share:.1f} % of the time",
        ),
        (
            "wear",
            f"{format_number(pump.starts_per_hour)} starts and "
            f"{format_number(pump.travel_per_hour)} full strokes an hour",
        ),
        ("at a limit", f"{100 * pump.saturated_share:.2f} % of ticks"),
        (
            "leak",
            f"{format_number(median)} µm/s (from {format_number(least)} to {format_number(most)})",
        ),
    ]
    benefit = analysis.benefit
    if benefit is not None:
        facts.append(
            (
                "feed-forward",
                f"std of 1 s means {format_number(benefit.with_um)} µm, without it "
                f"{format_number(benefit.without_um)} µm (computed)",
            )
        )
    facts.append(
        (
            "lateness",
            f"p50 {format_number(late.find_quantile(0.5))}, "
            f"p99 {format_number(late.find_quantile(0.99))}, "
            f"maximum {format_number(late.largest)} ms; {ticks.missed_ticks} ticks missed",
        )
    )
    return facts


def _list_history(history: Sequence[PumpSeen], change_max: float) -> list[PageBlock]:
    change = explain_pump_change(history, change_max)
    rows = [
        [
            f"{seen.started_utc:%Y-%m-%d %H:%M}",
            seen.run,
            f"{seen.scale:.3f} ± {seen.sigma:.3f}",
            format_number(seen.leak_um_per_s),
        ]
        for seen in history[-_LINES_MOST:]
    ]
    head = ["UTC", "run", "flow / curve of the newest run", "leak and offset µm/s"]
    return [
        *([PageWarnings([("pump", change)])] if change else []),
        PageDrawing(figures.pump_history(history, change_max)),
        PageTable(head, rows),
    ]


def _list_shape(shape: shape_review.ShapeReview) -> list[PageBlock]:
    drifting = [
        f"Z{j} {_format_slope(term, 'µm/h')}"
        for j, term in enumerate(shape.drift_um_per_hour, 2)
        if term.is_significant
    ]
    first = format_span(float(shape.time_s[0]))
    points = [
        f"{name} {format_number(float(change_um.std()))} µm"
        for name, change_um in shape.points_um.items()
    ]
    facts = [
        ("cycles", f"{shape.time_s.size} used of {shape.cycles}, {shape.rejected} rejected"),
        ("changes are since", f"the first settled one, at {first} of the run"),
        ("standard deviation", f"{format_number(shape.mean_sd_um)} µm, mean over the area"),
        ("A, B, C", ", ".join(points)),
        ("drifting terms", ", ".join(drifting) or "none"),
        ("sag by camera − laser", _format_slope(shape.disagreement, "µm/h")),
    ]
    facts += [(f"{pair.lag_s:.0f} s apart", _describe_pair(pair)) for pair in shape.pairs]
    blocks: list[PageBlock] = [PageFacts(facts), PageDrawing(figures.draw_stability(shape))]
    if shape.pairs:
        blocks.append(PageDrawing(figures.draw_pairs(shape)))
    return blocks


def _list_scalars(series: held_scalars.HeldSeries) -> list[PageBlock]:
    """Vertex, focus and distance from the reference with error bars, and the image of a star."""
    last = series.scalars[-1]
    focus_mm = series.values_of("focus_mm")
    change_um = 1e3 * (focus_mm - focus_mm[0])
    reference = "the first settled figure"
    if series.stored_reference:
        reference = "the stored figure"
    facts = [
        ("held by the loop", _SCALAR_NAMES[series.holds]),
        ("changes are since", reference),
        ("vertex, last", _format_value(last.vertex_um, last.vertex_sigma_um, "µm of sag")),
        (
            "focus, last",
            f"{last.focus_mm:.4f} mm, change "
            f"{_format_value(change_um[-1], 1e3 * last.focus_sigma_mm, 'µm')}",
        ),
        ("focus over the run", f"from {min(change_um):+.3g} to {max(change_um):+.3g} µm"),
        ("RMS of the change, last", _format_value(last.rms_um, last.rms_sigma_um, "µm")),
        ("at the best depth", f"{format_number(last.least_rms_um)} µm: the limit of one actuator"),
    ]
    facts += _describe_image(series)
    return [PageFacts(facts), PageDrawing(figures.draw_scalars(series))]


def _list_climate(climate: climate_review.ClimateReview) -> list[PageBlock]:
    """Temperature and humidity, and what they predict of the figure."""
    facts = []
    for name, values, unit in (
        ("film", climate.film_c, "°C"),
        ("ring", climate.ring_c, "°C"),
        ("relative humidity", climate.humidity_percent, "%"),
    ):
        known = values[np.isfinite(values)]
        seen = "no sensor"
        if known.size:
            seen = f"{known.min():.2f} to {known.max():.2f} {unit}, at the end {known[-1]:.2f}"
        facts.append((name, seen))
    figures_um = climate.figure_um[np.isfinite(climate.figure_um)]
    if figures_um.size:
        change = _format_value(float(figures_um[-1]), climate.last_sigma_um, "µm RMS")
        facts += [
            (
                "strain since the hold began",
                f"film {format_signed(climate.film_ppm)}, ring {format_signed(climate.ring_ppm)} "
                "in 1e-6",
            ),
            (
                "predicted change of the figure at a held centre",
                f"{change} at the end, {format_signed(climate.spherical_um)} µm of it spherical; "
                f"largest {format_number(float(figures_um.max()))} (notice beyond "
                f"{climate.notice_um:g})",
            ),
        ]
    return [PageFacts(facts), PageDrawing(figures.draw_climate(climate))]


def _describe_image(series: held_scalars.HeldSeries) -> list[tuple[str, str]]:
    """The image of a star on the axis, by the last figure."""
    image = series.image
    if image is None:
        return [("image of a star", "the mirror has no focus in front of it")]
    wave = f"at {series.wavelength_um:g} µm"
    radius_80_mm = 1e-3 * image.radius_80_um
    sigma_mm = 1e-3 * series.radius_80_sigma_um
    radii = (
        f"50 % of the light within {format_number(1e-3 * image.radius_50_um)} mm, 80 % within "
        f"{_format_value(radius_80_mm, sigma_mm, 'mm')} (radius)"
    )
    strehl = _format_value(image.strehl, series.strehl_sigma, "")
    if not image.resolved:
        radii = f"not resolved {wave}: the paths differ by {image.path_rms_um:.3g} µm RMS"
        strehl = "near 0"
    return [
        ("focus of a star", f"{image.focus_mm:.3f} mm above the vertex"),
        (f"image of a star {wave}", radii),
        (f"Strehl ratio {wave}", strehl),
        (
            f"Strehl ratio of the change {wave}",
            f"{series.change_strehl:.4f} (optics correct the reference)",
        ),
    ]


def _format_value(value: float, sigma: float, unit: str) -> str:
    """A value with its standard deviation, if that is known."""
    text = format_number(value)
    if sigma == sigma:
        text += f" ± {format_number(sigma, 2)}"
    return f"{text} {unit}".rstrip()


def _describe_pair(pair: shape_review.CyclePair) -> str:
    return (
        f"RMS change {format_number(pair.rms_um)} µm (pair shown), "
        f"{format_number(pair.all_rms_um)} µm (all {pair.pairs}); "
        f"uncertainty {format_number(pair.mean_sigma_um)} µm"
    )


def _list_comparison(
    analysis: Analysis, other: Analysis, differences: Sequence[compare.Difference]
) -> list[PageBlock]:
    _, sentence = make_verdict(other)
    if analysis.is_part and not other.is_part:
        sentence = f"Part of this run against the whole other run. {sentence}"
    rows = [
        [
            d.name,
            format_number(d.ours),
            format_number(d.theirs),
            d.unit,
            d.verdict_text,
            format_number(d.p_value, 2),
            d.note,
        ]
        for d in differences
    ]
    return [
        PageText(sentence),
        PageTable(["", "this run", "other run", "", "difference", "p", ""], rows),
        PageDrawing(figures.draw_overview(other)),
    ]


def _list_timeline(analysis: Analysis) -> list[PageBlock]:
    timeline = make_timeline(analysis)
    rows = [
        [
            f"{analysis.run.utc(each.mono_s):%Y-%m-%d %H:%M:%S}",
            each.event.kind,
            each.event.sentence,
        ]
        for each in timeline[:_LINES_MOST]
    ]
    return [PageTable(["UTC", "what", ""], rows), *_list_rest(len(timeline))]


def _format_slope(slope: drift.FittedSlope, unit: str) -> str:
    if slope.per_hour != slope.per_hour:
        return "too short to say"
    rate, low, high = map(format_signed, (slope.per_hour, slope.low, slope.high))
    text = f"{rate} {unit} (95 %: {low} to {high})"
    if slope.is_significant:
        return text
    return f"{text}, not significant"


def _list_rest(count: int) -> list[PageBlock]:
    """List how many lines a table leaves out."""
    if count <= _LINES_MOST:
        return []
    return [PageText(f"{count - _LINES_MOST} more in the JSON report.")]
