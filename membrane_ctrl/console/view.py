"""The console on a terminal. It fits 80 x 24; a wider terminal gets longer lines, not more items."""

import math
from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.model import ConsoleView, ShapeView
from membrane_ctrl.console.why import NONE, duration, number, percent
from membrane_ctrl.model import states, telemetry

_EIGHTHS = " ▁▂▃▄▅▆▇█"


def level_bar(fraction: float, width: int, style: str = "cyan") -> Text:
    """A bar of `width` characters, filled to `fraction` (0..1; NaN is empty)."""
    filled = round(min(max(fraction, 0.0), 1.0) * width) if math.isfinite(fraction) else 0
    return Text("█" * filled, style=style) + Text("░" * (width - filled), style="dim")


def signed_bars(values: Sequence[float], full: float, band: float) -> tuple[Text, Text]:
    """Draw a history as bars above (upper line) and below (lower line) a common zero.

    `full` is the value of a full-height bar; bars beyond `band` are red, the others green. NaN is a gap, zero the
    thinnest upward bar.
    """
    upper, lower = Text(), Text()
    for value in values:
        if not math.isfinite(value):
            upper.append(" ")
            lower.append(" ")
            continue
        colour = "green" if abs(value) <= band else "red"
        eighths = min(8, max(1, math.ceil(8 * abs(value) / full)))
        if value >= 0:
            upper.append(_EIGHTHS[eighths], colour)
            lower.append(" ")
        else:
            upper.append(" ")
            # there are no hanging block characters: draw the rest of the cell in the background colour
            lower.append(_EIGHTHS[8 - eighths], Style(color=colour, reverse=True))
    return upper, lower


def full_scale(values: Sequence[float], least: float) -> float:
    """The smallest of 1, 2, 5 x 10^n that covers all values, and is at least `least`."""
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    if largest <= least:
        return least
    decade = 10.0 ** math.floor(math.log10(largest))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if largest <= step * decade * (1 + 1e-9))


_STATE_STYLES = {
    states.State.HOLD: "bold green",
    states.State.FAULT: "bold white on red",
    states.State.LOWER: "bold yellow",
}
_SHAPE_STYLES = {states.ShapeState.TRACKING: "green", states.ShapeState.SUSPENDED: "yellow"}
_VERDICT_STYLES = {"ok": "green", "degraded": "yellow", "rejected": "red"}
_BAR_WIDTH = 10
_CALM = 0.25  # of the band: on a finer scale noise would look like trouble


def console_panel(view: ConsoleView, config: Config, run: str) -> Panel:
    """The whole console; `run` is the run folder."""
    time_left = f"{duration(view.left_s)} left" if math.isfinite(view.left_s) else "until stopped"
    title = Text.assemble(" ", (view.state.name.lower(), _STATE_STYLES.get(view.state, "bold")))
    title.append(f" for {duration(view.state_age_s)} ")
    return Panel(
        Group(_headline(view, config), Text(), _figures(view, config)),
        title=title,
        title_align="left",
        subtitle=Text(f" run {duration(view.elapsed_s)}, {time_left} · {run} ", style="dim", overflow="ellipsis"),
        subtitle_align="left",
        border_style="red" if view.fault or view.silent_s else "green" if view.state == states.State.HOLD else "blue",
    )


def _headline(view: ConsoleView, config: Config) -> Text:
    """The standing fault, else why the pump is where it is."""
    if view.silent_s:
        return Text(f"no tick for {view.silent_s:.1f} s", style="bold red")
    outside = view.row is not None and abs(view.row.error_um) > config.limits.band_um
    style = "bold red" if view.fault else "bold yellow" if outside else "bold"
    return Text(view.why, style=style, overflow="fold")


def _figures(view: ConsoleView, config: Config) -> Table:
    table = Table.grid(padding=(0, 1))
    table.add_column(style="dim", justify="right", min_width=8, no_wrap=True)
    table.add_column(ratio=1)
    row = view.row
    if row is None:
        table.add_row("", "waiting for the first tick")
        return table
    table.add_row("error", _error(view, config))
    for label, bars in _trend(view, config):
        table.add_row(label, bars)
    table.add_row("mirror", _mirror(row))
    table.add_row("gains", Text(view.gains))
    table.add_row("pump", _pump(row, config))
    table.add_row("flow", _flow(row))
    table.add_row("gas", _gas(view, row))
    table.add_row("", "")
    for label, line in _shape(view.shape):
        table.add_row(label, line)
    table.add_row("", "")
    table.add_row("lateness", _lateness(view, row))
    table.add_row("faults", _faults(view))
    if view.recording:  # one line only: with a full disk every file reports an error
        table.add_row("recorder", Text(view.recording, style="bold yellow", no_wrap=True, overflow="ellipsis"))
    return table


def _error(view: ConsoleView, config: Config) -> Text:
    row = view.row
    assert row is not None
    inside = abs(row.error_um) <= config.limits.band_um
    style = "bold green" if inside else "bold red" if math.isfinite(row.error_um) else "dim"
    text = Text(f"{number(row.error_um, 2, 'um', sign=True):>10}", style=style)
    mean, std = number(view.error_mean_um, 2, sign=True), number(view.error_std_um, 2)
    text.append(f"   last minute: mean {mean}, std {std} um, ", style="default")
    text.append(f"{percent(view.in_band_fraction)} within ±{config.limits.band_um:g}", style="default")
    return text


def _trend(view: ConsoleView, config: Config) -> list[tuple[str, Text]]:
    full_um = full_scale(view.trend_um, config.limits.band_um * _CALM)
    upper, lower = signed_bars(view.trend_um, full_um, config.limits.band_um)
    return [(f"+{full_um:g} um", upper), (f"-{full_um:g} um", lower)]


def _mirror(row: telemetry.TelemetryRow) -> Text:
    text = Text.assemble("reading ", (number(row.displacement_um, 2, sign=True), "bold"))
    text.append(f"  setpoint {number(row.setpoint_um, 2, 'um', sign=True)}")
    if math.isfinite(row.truth_displacement_um):
        text.append(f"  truth {number(row.truth_displacement_um, 2, 'um', sign=True)}", style="cyan")
        text.append(f" (laser {number(row.truth_laser_bias_um, 2, sign=True)})", style="dim")
    return text


def _pump(row: telemetry.TelemetryRow, config: Config) -> Text:
    text = level_bar(row.pump_fraction, _BAR_WIDTH)
    text.append(f" {percent(row.pump_fraction)}, {number(row.flow_um_per_s, 2)} of ", style="default")
    text.append(f"{config.loop.flow_max_um_per_s:g} um/s", style="default")
    if row.vent_fraction > 0:
        text.append(f"  vent {percent(row.vent_fraction)} open", style="yellow")
    return text


def _flow(row: telemetry.TelemetryRow) -> Text:
    parts = [("P", row.p_um_per_s), ("I", row.i_um_per_s), ("D", row.d_um_per_s)]
    parts += [("feed-forward", row.feedforward_um_per_s)]
    return Text("  ".join(f"{name} {number(value, 2, sign=True)}" for name, value in parts) + " um/s")


def _gas(view: ConsoleView, row: telemetry.TelemetryRow) -> Text:
    text = Text(f"leak {number(row.leak_um_per_s, 2, 'um/s')}")
    if view.too_tight:
        text.append(" too tight: open the bleed", style="bold yellow")
    ambient_hpa = row.ambient_pressure_pa / 100.0
    text.append(f"  gauge {number(row.gauge_pressure_pa, 1, 'Pa')}  air {number(ambient_hpa, 2, 'hPa')}")
    text.append(f" {number(row.air_temperature_c, 2, '°C')}")
    return text


def _shape(shape: ShapeView) -> list[tuple[str, RenderableType]]:
    state = Text(shape.state.name.lower(), style=_SHAPE_STYLES.get(shape.state, "default"))
    state.append(f"  trim {number(shape.trim_um, 2, 'um', sign=True)}", style="default")
    estimate = shape.estimate
    change = number(shape.sag_change_um, 3, sign=True)
    if change != NONE:
        sigma = number(shape.change_sigma_um, 3)
        state.append(f"  sag {change} ± {sigma} um since {duration(shape.reference_s)}", style="default")
    if shape.note:
        state.append(f"  {shape.note}", style="yellow")
    if estimate is None:
        return [("shape", state), ("cycle", Text("none yet", style="dim"))]
    cycle = Text(estimate.verdict, style=_VERDICT_STYLES[estimate.verdict])
    cycle.append(f"  {duration(shape.age_s)} ago, {estimate.kind}, ", style="default")
    cycle.append(f"residual {number(estimate.slope_residual_urad, 1, 'urad')}, ", style="default")
    cycle.append(f"in {number(1e3 * estimate.latency_s, 0, 'ms')}", style="default")
    cycle.append(f"  {shape.rejected}/{shape.cycles} rejected", style="yellow" if shape.rejected else "dim")
    return [("shape", state), ("cycle", cycle)]


def _lateness(view: ConsoleView, row: telemetry.TelemetryRow) -> Text:
    text = Text(f"{number(row.lateness_ms, 1, 'ms')}, worst of the minute {number(view.lateness_max_ms, 1, 'ms')}")
    missed = int(row.missed_ticks)
    text.append(f", {missed} of {int(row.tick) + missed} ticks missed", style="yellow" if missed else "default")
    return text


def _faults(view: ConsoleView) -> Text:
    if view.fault:
        text = Text(view.fault, style="bold red")
        return text.append(f"; {view.remedy}", style="default") if view.remedy else text
    if not view.faults:
        return Text("none")
    return Text(f"none now, {view.faults} in this run; last: {view.last_fault}")
