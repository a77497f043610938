"""The report for people, one self-contained HTML file, and the command `report`,
which writes it.
"""

import html
import shlex
from collections.abc import Iterable, Sequence

from membrane_ctrl.model import program
from membrane_ctrl.review.formatting import format_number, format_span, format_time_beside
from membrane_ctrl.review.report import figures
from membrane_ctrl.review.report.json import make_timeline, make_verdict
from membrane_ctrl.review.report.pump_history import PumpSeen, pump_change
from membrane_ctrl.review.statistics import compare, drift, power_spectrum, shape_review
from membrane_ctrl.review.statistics.analysis import Analysis
from membrane_ctrl.review.statistics.error_series import ErrorSeries

STYLE = """
:root{color-scheme:light}
*{box-sizing:border-box}
body{margin:0;background:#f3f5f8;color:#20242b;font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 32px;background:#fff;min-height:100vh}
header{display:flex;align-items:baseline;justify-content:space-between;gap:16px;flex-wrap:wrap}
h1,h2,code{overflow-wrap:anywhere}
h1{font-size:21px;margin:0}
h2{font-size:16px;margin:28px 0 8px;border-bottom:1px solid #e3e7ed;padding-bottom:4px}
.when{margin:0;color:#667}
.verdict{font-size:17px;padding:12px 16px;border-left:5px solid;border-radius:4px;margin:16px 0}
.good{border-color:#009e73;background:#eaf7f2}
.look{border-color:#e69f00;background:#fdf5e3}
.bad{border-color:#d55e00;background:#fdece3}
ul.odd{margin:8px 0;padding-left:22px}
figure{margin:14px 0}
svg{width:100%;height:auto;display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:13.5px;font-variant-numeric:tabular-nums}
th{text-align:left;color:#667;font-weight:600;border-bottom:1px solid #d5dae2;padding:4px 10px 4px 0}
td{border-bottom:1px solid #eef0f4;padding:4px 10px 4px 0;vertical-align:top}
td:first-child{white-space:nowrap}
code{font-size:12px;background:#f3f5f8;padding:1px 5px;border-radius:3px}
dl{display:grid;grid-template-columns:max-content 1fr;gap:4px 18px;margin:10px 0;font-size:14px}
dt{color:#667}
dd{margin:0}
footer{margin-top:30px;color:#889;font-size:12px}
@media print{body{background:#fff}main{padding:0}section,figure{break-inside:avoid}}
"""  # noqa: E501

# A month has thousands of lines; the JSON report has them all.
_LINES_MOST = 200
READING = "reading (in the loop)"
TRUE = "true centre (twin)"


def render_report(
    analysis: Analysis,
    other: Analysis | None = None,
    differences: Sequence[compare.Difference] = (),
    history: Sequence[PumpSeen] = (),
) -> str:
    """HTML of a report, optionally with another run and the differences from it
    (`compare.compare_analyses`).

    `history`: the pump in this and earlier runs (`pump_history`).
    """
    run = analysis.run
    word, sentence = make_verdict(analysis)
    parts = [
        f"<header><h1>{_escape_text(run.name)}</h1>"
        f"<p class='when'>{run.utc(analysis.ticks.start_s):%Y-%m-%d %H:%M:%S} UTC, "
        f"{format_span(analysis.ticks.end_s - analysis.ticks.start_s)}</p></header>",
        f"<p class='verdict {word}'>{_escape_text(sentence)}</p>",
        _render_anomalies(analysis),
        f"<figure>{figures.draw_overview(analysis)}</figure>",
        _render_section("Detected events", _render_found(analysis)),
        _render_section("Hold quality", _render_windows(analysis) + _render_details(analysis)),
        f"<figure>{figures.draw_distributions(analysis)}</figure>",
        _render_section("Pump, leak, feed-forward, ticks", _render_pump(analysis)),
        f"<figure>{figures.everything_else(analysis)}</figure>",
    ]
    if analysis.shape is not None:
        parts.append(_render_section("Figure", _render_shape(analysis.shape)))
        parts.append(f"<figure>{figures.draw_stability(analysis.shape)}</figure>")
        if analysis.shape.pairs:
            parts.append(f"<figure>{figures.draw_pairs(analysis.shape)}</figure>")
    if len(history) > 1:
        parts.append(
            _render_section(
                "Pump over the runs", _render_history(history, run.config.pump.change_max)
            )
        )
    if other is not None:
        parts.append(
            _render_section(
                f"Against {_escape_text(other.run.name)}",
                _render_comparison(analysis, other, differences),
            )
        )
        parts.append(f"<figure>{figures.draw_overview(other)}</figure>")
    parts.append(_render_section("Timeline", _render_timeline(analysis)))
    recorded = f", recorded by {_escape_text(run.recorded_by)}" if run.recorded_by else ""
    parts.append(
        f"<footer>{program.program_identity()}, report of "
        f"{_escape_text(str(run.folder.name))}{recorded}</footer>"
    )
    return html_page(run.name, "".join(parts))


def html_page(title: str, body: str) -> str:
    """A page in the report's style; the body is HTML, the title a text."""
    return (
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>{_escape_text(title)}</title><style>{STYLE}</style></head><body><main>{body}</main></body></html>"
    )


def _render_anomalies(analysis: Analysis) -> str:
    items = "".join(
        f"<li><b>{_escape_text(a.name)}</b> {_escape_text(a.seen)}</li>" for a in analysis.anomalies
    )
    return f"<ul class='odd'>{items}</ul>" if items else ""


def _render_found(analysis: Analysis) -> str:
    if not analysis.found:
        return (
            "<p>None: no door, leak step, laser glitch or loss, lateness burst, noise change, "
            "excursion or jump.</p>"
        )
    name = _escape_text(shlex.quote(analysis.run.name))
    rows = [
        [
            f"{analysis.run.utc(event.time_s):%Y-%m-%d %H:%M:%S}",
            event.kind,
            f"{format_number(event.size)} {_escape_text(event.unit)}",
            f"{event.confidence:.3f}",
            f"<code>membrane-ctrl review {name} --from +{max(event.start_s, 1):.0f}s --to "
            f"+{event.end_s:.0f}s</code>",
        ]
        for event in analysis.found[:_LINES_MOST]
    ]
    return html_table(["UTC", "what", "size", "confidence", "look at it"], rows) + _format_rest(
        len(analysis.found)
    )


def _render_windows(analysis: Analysis) -> str:
    rows = [
        [
            name,
            f"{window.window_s:g} s",
            f"{window.count}",
            *(
                format_number(v)
                for v in (window.mean_um, window.std_um, window.p99_7_um, window.max_um)
            ),
            f"{format_number(100 * window.in_band, 6)} %"
            if window.count
            else format_number(window.in_band),
        ]
        for name, series in ((READING, analysis.reading), (TRUE, analysis.true))
        for window in (() if series is None else series.windows)
    ]
    band = f"in ±{analysis.run.config.limits.band_um:g} µm"
    return html_table(
        ["", "means of", "count", "mean µm", "std µm", "p99.7 µm", "maximum µm", band], rows
    )


def _render_details(analysis: Analysis) -> str:
    series, name = (analysis.reading, READING) if analysis.true is None else (analysis.true, TRUE)
    if series is None:
        return ""
    ticks = analysis.ticks
    std_um = format_number(ticks.raw_reading.std)
    single = f"std {std_um} µm, {100 * ticks.raw_in_band:.2f} % within the band"
    return _render_facts(
        [
            (f"drift, {name}", _format_slope(series.drift, "µm/h")),
            (
                "not counted as held",
                ", ".join(
                    format_time_beside(
                        ticks.faults_s, ticks.paused_s, ticks.moving_s, ticks.end_s - ticks.start_s
                    )
                )
                or "nothing",
            ),
            (
                "single readings",
                f"{single}; {format_number(ticks.unread_s)} s held without readings",
            ),
            (f"RMS by frequency, {name}", _render_bands(series)),
        ]
    )


def _render_bands(series: ErrorSeries) -> str:
    there = [
        band
        for band in power_spectrum.band_rms(series.spectrum, series.slow)
        if band.rms_um == band.rms_um
    ]
    if not there:
        return "too short to say"
    said = [
        f"{format_number(b.from_hz)}–{format_number(b.high_hz)} Hz: {format_number(b.rms_um)} µm"
        for b in there
    ]
    unresolved = format_span(power_spectrum.unseen_s(there))
    return f"{'; '.join(said)}; not resolved: motion slower than {unresolved}"


def _render_pump(analysis: Analysis) -> str:
    pump, ticks, late = analysis.ticks.pump, analysis.ticks, analysis.ticks.lateness_ms
    median, least, most = analysis.leak_um_per_s
    benefit = analysis.benefit
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
        (
            "lateness",
            f"p50 {format_number(late.find_quantile(0.5))}, "
            f"p99 {format_number(late.find_quantile(0.99))}, "
            f"maximum {format_number(late.largest)} ms; {ticks.missed_ticks} ticks missed",
        ),
    ]
    if benefit is not None:
        said = (
            f"std of 1 s means {format_number(benefit.with_um)} µm, without it "
            f"{format_number(benefit.without_um)} µm (computed)"
        )
        facts.insert(4, ("feed-forward", said))
    return _render_facts(facts)


def _render_history(history: Sequence[PumpSeen], change_max: float) -> str:
    rows = [
        [
            f"{seen.started_utc:%Y-%m-%d %H:%M}",
            _escape_text(seen.run),
            f"{seen.scale:.3f} ± {seen.sigma:.3f}",
            format_number(seen.leak_um_per_s),
        ]
        for seen in history[-_LINES_MOST:]
    ]
    said = pump_change(history, change_max)
    warning = f"<ul class='odd'><li><b>pump</b> {_escape_text(said)}</li></ul>" if said else ""
    table = html_table(
        ["UTC", "run", "flow / curve of the newest run", "leak and offset µm/s"], rows
    )
    return f"{warning}<figure>{figures.pump_history(history, change_max)}</figure>{table}"


def _render_shape(shape: shape_review.ShapeReview) -> str:
    drifting = [
        f"Z{j} {_format_slope(term, 'µm/h')}"
        for j, term in enumerate(shape.drift_um_per_hour, 2)
        if term.is_significant
    ]
    facts = [
        ("cycles", f"{shape.time_s.size} used of {shape.cycles}, {shape.rejected} rejected"),
        (
            "changes are since",
            f"the first settled one, at {format_span(float(shape.time_s[0]))} of the run",
        ),
        ("standard deviation", f"{format_number(shape.mean_sd_um)} µm, mean over the area"),
        (
            "A, B, C",
            ", ".join(
                f"{name} {format_number(float(v.std()))} µm" for name, v in shape.points_um.items()
            ),
        ),
        ("drifting terms", ", ".join(drifting) or "none"),
        ("sag by camera − laser", _format_slope(shape.disagreement, "µm/h")),
    ]
    facts += [
        (
            f"{pair.lag_s:.0f} s apart",
            f"RMS change {format_number(pair.rms_um)} µm (pair shown), "
            f"{format_number(pair.all_rms_um)} µm (all {pair.pairs}); "
            f"uncertainty {format_number(pair.mean_sigma_um)} µm",
        )
        for pair in shape.pairs
    ]
    return _render_facts(facts)


def _render_comparison(
    analysis: Analysis, other: Analysis, differences: Sequence[compare.Difference]
) -> str:
    rows = [
        [
            d.name,
            format_number(d.ours),
            format_number(d.theirs),
            d.unit,
            d.verdict_text,
            format_number(d.p_value, 2),
            _escape_text(d.note),
        ]
        for d in differences
    ]
    _, sentence = make_verdict(other)
    if analysis.is_part and not other.is_part:
        sentence = f"Part of this run against the whole other run. {sentence}"
    table = html_table(["", "this run", "other run", "", "difference", "p", ""], rows)
    return f"<p>{_escape_text(sentence)}</p>{table}"


def _render_timeline(analysis: Analysis) -> str:
    told = make_timeline(analysis)
    rows = [
        [
            f"{analysis.run.utc(each.mono_s):%Y-%m-%d %H:%M:%S}",
            _escape_text(each.event.kind),
            _escape_text(each.event.sentence),
        ]
        for each in told[:_LINES_MOST]
    ]
    return html_table(["UTC", "what", ""], rows) + _format_rest(len(told))


def _format_slope(slope: drift.FittedSlope, unit: str) -> str:
    if slope.per_hour != slope.per_hour:
        return "too short to say"
    said = f"{slope.per_hour:+.3g} {unit} (95 %: {slope.low:+.3g} to {slope.high:+.3g})"
    return said if slope.is_significant else f"{said}, not significant"


def _format_rest(count: int) -> str:
    return f"<p>{count - _LINES_MOST} more in the JSON report.</p>" if count > _LINES_MOST else ""


def _render_section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>"


def _render_facts(facts: Iterable[tuple[str, str]]) -> str:
    return (
        "<dl>"
        + "".join(f"<dt>{_escape_text(name)}</dt><dd>{said}</dd>" for name, said in facts)
        + "</dl>"
    )


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; its cells are HTML."""
    cells = "".join(f"<th>{title}</th>" for title in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    return (
        "<div "
        f"class='scroll'><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _escape_text(text: str) -> str:
    return html.escape(text)
