"""Pictures of the hold: the run at a glance, surroundings, distributions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.names import State
from membrane_ctrl.review.analysis import Analysis
from membrane_ctrl.review.bands import density
from membrane_ctrl.review.figures_svg import BLUE, GREEN, GREY, ORANGE, RED, VIOLET, picture, svg
from membrane_ctrl.review.gaps import broken_at_gaps
from membrane_ctrl.review.report_json import timeline
from membrane_ctrl.review.words import one_line

Column = NDArray[np.float64]

_STATE_COLOURS = {
    State.STANDBY: "#c9ccd1", State.CHECK: "#9ecae1", State.INFLATE: "#56b4e9", State.SETTLE: ORANGE,
    State.HOLD: GREEN, State.MANUAL: VIOLET, State.TUNE: "#f0e442", State.LOWER: ORANGE, State.FAULT: RED,
}  # fmt: skip
# Of a mark's text: more would not fit beside its line, and the timeline has all of it.
_LETTERS_MOST = 40
_FOUND_COLOURS = {"pressure step": VIOLET, "leak step": ORANGE, "noise change": ORANGE, "shape jump": BLUE}


def hours_or_less(time_s: Column | float, span_s: float) -> tuple[Any, str]:
    """Times in the unit that suits the span, and its name."""
    for seconds, name in ((86400.0 * 3, "d"), (3600.0 * 3, "h"), (60.0 * 5, "min")):
        if span_s >= seconds:
            unit_s = {"d": 86400.0, "h": 3600.0, "min": 60.0}[name]
            return np.asarray(time_s) / unit_s, name
    return np.asarray(time_s), "s"


def overview(analysis: Analysis) -> str:
    """Error with its envelope, the band, states, what was found and marked."""
    level, band_um = broken_at_gaps(analysis.level), analysis.run.config.limits.band_um
    span_s = analysis.ticks.end_s - analysis.ticks.start_s
    time, unit = hours_or_less(level["time_s"], span_s)
    with picture(2, 1, 4.2, sharex=True, height_ratios=[8, 1.1]) as (figure, (plot, lane)):
        plot.axhspan(-band_um, band_um, color=GREEN, alpha=0.09, lw=0)
        plot.fill_between(
            time,
            level["min_error_um"],
            level["max_error_um"],
            color=GREY,
            alpha=0.35,
            lw=0,
            label="least to greatest",
        )
        plot.plot(time, level["mean_error_um"], color=BLUE, label=f"error, mean of {analysis.level_s:g} s")
        if np.isfinite(level["mean_true_error_um"]).any():
            plot.plot(time, level["mean_true_error_um"], color=GREEN, lw=0.9, label="true centre (twin)")
        plot.set_ylim(-3 * band_um, 3 * band_um)
        plot.set(ylabel="setpoint − centre, µm", title="The run at a glance")
        _found(plot, analysis, span_s)
        plot.legend(loc="upper right", ncols=3)
        _lane(lane, analysis, span_s)
        lane.set_xlabel(f"time since {analysis.run.origin_utc:%Y-%m-%d %H:%M:%S} UTC, {unit}")
        return svg(figure)


def _found(plot: Any, analysis: Analysis, span_s: float) -> None:
    top = plot.get_ylim()[1]
    for event in analysis.found:
        at, _ = hours_or_less(event.time_s, span_s)
        colour = _FOUND_COLOURS.get(event.kind, RED)
        plot.axvline(at, color=colour, lw=0.8, ls=":")
        plot.plot([at], [0.96 * top], marker="v", ms=5, color=colour, clip_on=False)
    for noted in timeline(analysis):
        if noted.get("kind") in {"mark", "fault"}:
            at, _ = hours_or_less(float(noted.get("mono_s") or 0.0), span_s)
            colour = RED if noted["kind"] == "fault" else "black"
            plot.axvline(at, color=colour, lw=1)
            text = one_line(str(noted.get("text") or noted.get("name") or "fault"))
            if len(text) > _LETTERS_MOST:
                text = f"{text[: _LETTERS_MOST - 1]}…"
            plot.annotate(
                text, (at, 0.8 * top), rotation=90, fontsize=7, color=colour, ha="right", va="top", parse_math=False
            )


def _lane(lane: Any, analysis: Analysis, span_s: float) -> None:
    """States as coloured stretches, named where there is room."""
    states = [event for event in timeline(analysis) if event.get("kind") == "state"]
    edges_s = [float(event.get("mono_s") or 0.0) for event in states]
    edges_s.append(max(analysis.ticks.end_s, *edges_s, 0.0))
    for event, start_s, end_s in zip(states, edges_s, edges_s[1:], strict=False):
        try:
            state = State[str(event.get("state", "")).upper()]
        except KeyError:
            continue
        (start, end), _ = hours_or_less(np.array([start_s, end_s]), span_s)
        lane.axvspan(start, end, color=_STATE_COLOURS[state], lw=0)
        if end_s - start_s > 0.06 * span_s:
            lane.text((start + end) / 2, 0.5, state.name.lower(), ha="center", va="center", fontsize=8, color="white")
    lane.set(ylim=(0, 1), yticks=[])
    lane.grid(False)


def surroundings(analysis: Analysis) -> str:
    """Air, leak and pump, lateness."""
    level = broken_at_gaps(analysis.level)
    time, unit = hours_or_less(level["time_s"], analysis.ticks.end_s - analysis.ticks.start_s)
    with picture(2, 2, 4.2, sharex=True) as (figure, plots):
        pressure, temperature, flow, late = plots.ravel()
        _envelope(pressure, time, level, "ambient_pressure_pa", BLUE)
        pressure.set(title="Ambient pressure, Pa")
        pressure.ticklabel_format(useOffset=False)
        _envelope(temperature, time, level, "air_temperature_c", ORANGE)
        temperature.set(title="Air temperature, °C")
        flow.plot(time, level["mean_flow_um_per_s"], color=GREY, lw=0.8, label="flow")
        flow.plot(time, level["mean_leak_um_per_s"], color=RED, label="leak")
        flow.set(title="Flow and leak, µm/s", xlabel=unit)
        flow.legend(loc="upper right", ncols=2)
        late.plot(time, level["max_lateness_ms"], color=GREY, lw=0.8, label="greatest")
        late.plot(time, level["mean_lateness_ms"], color=BLUE, label="mean")
        late.set(title="Lateness of the tick, ms", xlabel=unit)
        if np.nanmax(level["max_lateness_ms"], initial=0.0) > 0:
            late.set_yscale("log")
        late.legend(loc="upper right", ncols=2)
        return svg(figure)


def _envelope(plot: Any, time: Column, level: dict[str, Column], name: str, colour: str) -> None:
    plot.fill_between(time, level[f"min_{name}"], level[f"max_{name}"], color=colour, alpha=0.2, lw=0)
    plot.plot(time, level[f"mean_{name}"], color=colour)


def distributions(analysis: Analysis) -> str:
    """Histogram, Allan deviation, spectrum."""
    reading, true = analysis.reading, analysis.true
    with picture(1, 3, 3.3) as (figure, (histogram, allan, spectrum)):
        edges, counts = analysis.ticks.histogram_um, analysis.ticks.histogram_counts
        merged = counts.reshape(-1, 5).sum(axis=1)
        middle = edges[:-1].reshape(-1, 5).mean(axis=1) + (edges[1] - edges[0]) / 2
        share = 100 * merged / max(1, counts.sum())
        histogram.bar(middle, share, width=5 * (edges[1] - edges[0]), color=BLUE, lw=0.3, ec=BLUE)
        band_um = analysis.run.config.limits.band_um
        for side in (-band_um, band_um):
            histogram.axvline(side, color=GREEN, lw=1)
        histogram.set(title="Single readings", xlabel="setpoint − reading, µm", ylabel="share, %")
        for series, colour, name in ((reading, BLUE, "reading"), (true, GREEN, "true centre")):
            if series is None:
                continue
            if series.allan.tau_s.size:
                allan.loglog(series.allan.tau_s, series.allan.deviation, "o-", ms=3, color=colour, label=name)
            frequency_hz, power = density(series.spectrum, series.slow)
            if np.isfinite(power).any():
                spectrum.loglog(frequency_hz, np.sqrt(power), color=colour, lw=0.8, label=name)
        allan.set(title="Overlapping Allan deviation", xlabel="τ, s", ylabel="µm")
        spectrum.set(title="Amplitude spectral density", xlabel="Hz", ylabel="µm/√Hz")
        for plot in (allan, spectrum):
            if plot.lines:
                plot.legend()
        return svg(figure)
