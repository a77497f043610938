"""The console on a terminal, from 60 x 15 characters: a higher one gets more items, a wider one a
longer trend.
"""

import math
from collections.abc import Sequence

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.keys import HELP
from membrane_ctrl.console.model import ConsoleView, ShapeView
from membrane_ctrl.console.why import (
    format_duration,
    format_number,
    format_percent,
    list_used_sensors,
)
from membrane_ctrl.model import columns, telemetry
from membrane_ctrl.model.columns import COLUMNS, MISSING, PUBLISHED, TERMS, columns_of
from membrane_ctrl.model.event_base import Event, LogLevel
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import StateEntered
from membrane_ctrl.run_files.held_error import HeldError

_LOCKS_SHOWN = 3  # a low terminal needs room for the figures; `ctl status` lists all
_NOTICES_SHOWN = 3
_EIGHTHS = " ▁▂▃▄▅▆▇█"
_STATE_STYLES = {
    telemetry.State.HOLD: "bold green",
    telemetry.State.FAULT: "bold white on red",
    telemetry.State.LOWER: "bold yellow",
}
_SHAPE_STYLES = {telemetry.ShapeState.TRACKING: "green", telemetry.ShapeState.SUSPENDED: "yellow"}
_VERDICT_STYLES = {"ok": "green", "degraded": "yellow", "rejected": "red"}
_BAR_WIDTH = 10
_CALM = 0.25  # of the band: on a finer scale noise would look like trouble
_LABELS = 8  # characters
_EDGES = 5 + _LABELS  # borders, padding and labels beside a trend
_BAR_ROWS_MAX = 6
_EVENTS_MIN = 4  # lines with their heading: fewer are not worth a list
_LEVEL_STYLES = {LogLevel.ERROR: "bold red", LogLevel.WARNING: "yellow"}
# in a low terminal these are omitted first
_DISPENSABLE = (
    "",
    "gains",
    "flow",
    "lateness",
    "cycle",
    "gas",
    "mirror",
    "trend",
    "shape",
    "held",
    "pump",
)
# Published columns that the lines below show each in its own way; a line shows the others of its
# group behind them.
_PLACED = frozenset(
    {
        "error_um",
        "displacement_um",
        "setpoint_um",
        "target_um",
        "pump_fraction",
        "vent_fraction",
        "flow_um_per_s",
        "leak_um_per_s",
        "trim_um",
        "lateness_ms",
        "missed_ticks",
    }
)


def level_bar(fraction: float, width: int, style: str = "cyan") -> Text:
    """A bar of block characters.

    Parameters
    ----------
    fraction : float
        How much of it is filled, 0 to 1; values beyond are limited, NaN is empty.
    width : int
        Characters.
    style : str
        Rich style of the filled part.
    """
    filled = 0
    if math.isfinite(fraction):
        filled = round(min(max(fraction, 0.0), 1.0) * width)
    return Text("█" * filled, style=style) + Text("░" * (width - filled), style="dim")


def signed_bars(values: Sequence[float], full: float, band: float, rows: int = 1) -> list[Text]:
    """Draw a history as bars above and below a common zero.

    Parameters
    ----------
    values : sequence of float
        NaN is a gap, zero the thinnest upward bar.
    full : float
        Value of a bar of full height.
    band : float
        Bars beyond it are red, the others green.
    rows : int
        Lines for either side.

    Returns
    -------
    list of Text
        From the top.
    """
    lines = [Text() for _ in range(2 * rows)]
    for value in values:
        colour = "green" if abs(value) <= band else "red"
        # Height in eighths of a line; a value other than NaN is visible
        eighths = 0
        if math.isfinite(value):
            eighths = min(8 * rows, max(1, math.ceil(8 * rows * abs(value) / full)))
        for row, line in enumerate(lines):
            up = row < rows
            in_row = min(8, max(0, eighths - 8 * (rows - 1 - row if up else row - rows)))
            if not in_row or up != (value >= 0):
                line.append(" ")
            elif up:
                line.append(_EIGHTHS[in_row], colour)
            else:
                # there are no hanging block characters: draw the rest of the cell in the background
                # colour
                line.append(_EIGHTHS[8 - in_row], Style(color=colour, reverse=True))
    return lines


def full_scale(values: Sequence[float], least: float) -> float:
    """The smallest of 1, 2, 5 x 10^n that covers all values: a scale that seldom changes.

    Parameters
    ----------
    values : sequence of float
        NaN does not count.
    least : float
        The scale is never finer, so that noise does not fill the bars.
    """
    largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
    if largest <= least:
        return least
    decade = 10.0 ** math.floor(math.log10(largest))
    return next(
        step * decade for step in (1.0, 2.0, 5.0, 10.0) if largest <= step * decade * (1 + 1e-9)
    )


class ConsolePage:
    """The whole console in the height there is.

    Parameters
    ----------
    view : ConsoleView
        What the model shows at this moment.
    config : Config
        Of the run, for the band.
    run : str
        The run folder.
    foot : str
        The last line: keys, their answers, or a question; empty without a keyboard.
    asks : bool
        The last line is a question.
    help_ : bool
        Explain the keys instead of listing events.
    link : str
        Of the page; empty without one.
    """

    def __init__(
        self,
        view: ConsoleView,
        config: Config,
        run: str,
        foot: str = "",
        asks: bool = False,
        help_: bool = False,
        link: str = "",
    ) -> None:
        self._view = view
        self._config = config
        self._run = run
        self._foot = foot
        self._asks = asks
        self._help = help_
        self._link = link

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        # Omit items, the least important first, until the rest fits: lines wrap, so each attempt is
        # drawn and measured. What is left over goes to a taller trend, then to events
        height = options.height or console.height
        trend_s = options.max_width - _EDGES

        def spare(omitted: int) -> int:
            panel = self._make_panel(trend_s, _DISPENSABLE[:omitted], rows=1, below=0)
            return height - len(console.render_lines(panel, options.update(height=None)))

        needed = len(HELP) + 1 if self._help else 0
        omitted, below = next(
            ((n, left) for n in range(len(_DISPENSABLE)) if (left := spare(n)) >= needed),
            (len(_DISPENSABLE), max(0, spare(len(_DISPENSABLE)))),
        )
        rows = 1
        if not self._help:
            rows = 1 + max(0, min(_BAR_ROWS_MAX - 1, (below - _EVENTS_MIN) // 6))
        yield self._make_panel(trend_s, _DISPENSABLE[:omitted], rows, below - 2 * (rows - 1))

    def _make_panel(self, trend_s: int, omitted: Sequence[str], rows: int, below: int) -> Panel:
        """The console without some items, `rows` lines on either side of the trend's zero, and
        `below` more.
        """
        view = self._view
        time_left = "until stopped"
        if math.isfinite(view.left_s):
            time_left = f"{format_duration(view.left_s)} left"
        title = Text.assemble(" ", (view.state.name.lower(), _STATE_STYLES.get(view.state, "bold")))
        title.append(f" for {format_duration(view.state_age_s)} ")
        # Items that the window has no room for are omitted; the caller says which.
        trend: Sequence[tuple[str, Text]] = ()
        if "trend" not in omitted:
            trend = _make_trend_items(view, self._config, trend_s, rows)
        figures = _make_figures_table(view, self._config, trend, omitted)
        parts: list[RenderableType] = [
            _make_headline(view, self._config),
            *([] if "" in omitted else [Text()]),
            figures,
        ]
        parts += _make_help_lines(below) if self._help else _make_event_lines(view, below)
        if self._link:
            page = f"page  {self._link}"
            parts.append(Text(page, style="dim", no_wrap=True, overflow="ellipsis"))
        if self._foot:
            style = "bold yellow" if self._asks else "dim"
            parts.append(Text(self._foot, style=style, no_wrap=True, overflow="ellipsis"))
        # The border shows the state from afar.
        held = view.state == telemetry.State.HOLD
        border = "green" if held else "blue"
        if view.fault or view.silent_s:
            border = "red"
        return Panel(
            Group(*parts),
            title=title,
            title_align="left",
            subtitle=Text(
                f" run {format_duration(view.elapsed_s)}, {time_left} · {self._run} ",
                style="dim",
                overflow="ellipsis",
            ),
            subtitle_align="left",
            border_style=border,
        )


def _make_event_lines(view: ConsoleView, lines: int) -> list[RenderableType]:
    """The last events in so many lines, the newest at the bottom."""
    if lines < _EVENTS_MIN:
        return [Text()] * lines
    made: list[RenderableType] = [Text("events, in UTC", style="dim")]
    for event_line in view.events[1 - lines :]:
        event = from_dict(event_line)
        line = Text(
            str(event_line.get("time_utc", ""))[11:19] + "  ",
            style="dim",
            no_wrap=True,
            overflow="ellipsis",
        )
        made.append(line.append(event.sentence, style=_style_event(event)))
    return [*made, *[Text()] * lines][:lines]


def _style_event(event: Event) -> str:
    """Errors and warnings in their colours, green for the end of a notice, bold for a state."""
    if event.level in _LEVEL_STYLES:
        return _LEVEL_STYLES[event.level]
    if isinstance(event, StateEntered):
        return "bold"
    return "green" if event.closes else "default"


def _make_help_lines(lines: int) -> list[RenderableType]:
    """The keys, and the commands that do the same from elsewhere, as far as the lines go."""
    made: list[RenderableType] = [Text()]
    for key, does, command in HELP:
        line = Text(f"{key:>3}  ", style="bold", no_wrap=True, overflow="ellipsis").append(
            does, style="default"
        )
        made.append(
            line.append(f"   (membrane-ctrl ctl {command})" if command else "", style="dim")
        )
    return [*made, *[Text()] * lines][:lines]


def _make_headline(view: ConsoleView, config: Config) -> Text:
    """The standing fault, else why the pump is where it is."""
    if view.silent_s:
        return Text(f"no tick for {view.silent_s:.1f} s", style="bold red")
    outside = view.row is not None and abs(view.row.error_um) > config.limits.band_um
    style = "bold yellow" if outside else "bold"
    if view.fault:
        style = "bold red"
    line = Text(overflow="fold")
    for lock in view.locks[:_LOCKS_SHOWN]:
        line.append(f"LOCKED {lock}\n", style="bold white on red")
    if len(view.locks) > _LOCKS_SHOWN:
        line.append(
            f"LOCKED by {len(view.locks) - _LOCKS_SHOWN} more locks\n", style="bold white on red"
        )
    line.append(view.why, style=style)
    if not view.next_step:
        return line
    return line.append(f"\n{view.next_step}", style="default")


def _make_figures_table(
    view: ConsoleView, config: Config, trend: Sequence[tuple[str, Text]], omitted: Sequence[str]
) -> Table:
    """The items of the console, a line each, without those that are omitted; then the notices."""
    table = Table.grid(padding=(0, 1))
    table.add_column(style="dim", justify="right", min_width=_LABELS, no_wrap=True)
    table.add_column(ratio=1)
    row = view.row
    if row is None:
        table.add_row("", "waiting for the first tick")
        return table
    for label, line in (
        ("error", _format_error(view, config)),
        *trend,
        ("held", _format_held(view.held)),
        ("mirror", _format_mirror(row)),
        ("gains", Text(view.gains)),
        ("pump", _format_pump(row, view.flow_most_um_per_s)),
        ("flow", _format_flow(row)),
        ("gas", _format_gas(view, row)),
        ("", Text()),
        *_make_shape_items(view.shape, row),
        *([("scalar", Text(view.held_scalar))] if view.held_scalar else []),
        ("", Text()),
        ("lateness", _format_lateness(view, row)),
        ("faults", _format_faults(view)),
    ):
        if label not in omitted:
            table.add_row(label, line)
    hidden = len(view.notices) - _NOTICES_SHOWN
    more = [f"and {hidden} more"] if hidden > 0 else []  # with a full disk every file has a notice
    for text in [*view.notices[:_NOTICES_SHOWN], *more]:
        table.add_row("notice", Text(text, style="bold yellow", no_wrap=True, overflow="ellipsis"))
    return table


def _format_error(view: ConsoleView, config: Config) -> Text:
    """The error, and how much of the last minute it was within the band."""
    row = view.row
    assert row is not None
    inside = abs(row.error_um) <= config.limits.band_um
    style = "bold red" if math.isfinite(row.error_um) else "dim"
    if inside:
        style = "bold green"
    error = COLUMNS["error_um"]
    text = Text(f"{row.format_quantity('error_um', sign=True):>10}", style=style)
    std = error.format_value(view.error_std_um)
    text.append(f"   last minute's readings: std {std} {error.unit}, ", style="default")
    text.append(
        f"{format_percent(view.in_band_fraction)} within ±{config.limits.band_um:g}",
        style="default",
    )
    return text


def _format_held(held: HeldError) -> Text:
    """How well the run has held until now: the figures of its closing report."""
    if not held.seconds:
        return Text("not for one second yet", style="dim")
    return Text.assemble(f"{held.name}, 1 s means: ", (held.figures_text, "bold"))


def _make_trend_items(
    view: ConsoleView, config: Config, seconds: int, rows: int
) -> list[tuple[str, Text]]:
    """The bars of the last seconds with their labels; a blank label is not an item that can be
    omitted.
    """
    shown = view.trend_um[-max(1, seconds) :]
    full_um = full_scale(shown, config.limits.band_um * _CALM)
    labels = [f"+{full_um:g} µm", *[" "] * (2 * rows - 2), f"-{full_um:g} µm"]
    return list(zip(labels, signed_bars(shown, full_um, config.limits.band_um, rows), strict=True))


def _list_other_columns(row: telemetry.TelemetryRow, *groups: columns.Group) -> str:
    """Known values of the published columns of some groups that have no place of their own."""
    shown = [
        each.name for each in PUBLISHED if each.plot.group in groups and each.name not in _PLACED
    ]
    return "".join(
        f"  {row.format_labelled(name)}" for name in shown if math.isfinite(getattr(row, name))
    )


def _format_mirror(row: telemetry.TelemetryRow) -> Text:
    """Reading, setpoint and estimate; with the twin, the truth beside them."""
    text = Text.assemble("reading ", (row.format_quantity("displacement_um", sign=True), "bold"))
    text.append(
        "  "
        f"{row.format_labelled('setpoint_um', sign=True)}{_list_other_columns(row, columns.Group.LOOP, columns.Group.ESTIMATE)}"  # noqa: E501
    )
    if math.isfinite(row.estimate_sigma_um):
        text.append(
            f"  centre ± {row.format_quantity('estimate_sigma_um')} by {list_used_sensors(row)}",
            style="green",
        )
    if math.isfinite(row.truth_displacement_um):
        text.append(
            f"  truth {row.format_quantity('truth_displacement_um', sign=True)}", style="cyan"
        )
        text.append(
            f" (laser {row.format_quantity('truth_laser_bias_um', sign=True)})", style="dim"
        )
    return text


def _format_pump(row: telemetry.TelemetryRow, most_um_per_s: float) -> Text:
    flow = COLUMNS["flow_um_per_s"]
    text = level_bar(row.pump_fraction, _BAR_WIDTH)
    text.append(
        f" {format_percent(row.pump_fraction)}, {flow.format_value(row.flow_um_per_s)} of ",
        style="default",
    )
    text.append(
        f"{most_um_per_s:g} {flow.unit}{_list_other_columns(row, columns.Group.PUMP)}",
        style="default",
    )
    if row.vent_fraction > 0:
        text.append(f"  vent {format_percent(row.vent_fraction)} open", style="yellow")
    return text


def _format_flow(row: telemetry.TelemetryRow) -> Text:
    terms = columns_of(TERMS)
    parts = [
        f"{each.label} {each.format_value(getattr(row, each.name), sign=True)}" for each in terms
    ]
    return Text(f"{'  '.join(parts)} {terms[0].unit}")


def _format_gas(view: ConsoleView, row: telemetry.TelemetryRow) -> Text:
    text = Text(row.format_labelled("leak_um_per_s"))
    if view.too_tight:
        text.append(" too tight: open the bleed", style="bold yellow")
    return text.append(_list_other_columns(row, columns.Group.ENVIRONMENT))


def _make_shape_items(
    shape: ShapeView, row: telemetry.TelemetryRow
) -> list[tuple[str, RenderableType]]:
    """Two items: the shape loop with trim and change of sag, and the newest cycle with its
    quality.
    """
    state = Text(shape.state.name.lower(), style=_SHAPE_STYLES.get(shape.state, "default"))
    trim = row.format_labelled("trim_um", sign=True)
    others = _list_other_columns(row, columns.Group.SHAPE)
    state.append(f"  {trim}{others}", style="default")
    estimate = shape.estimate
    change = format_number(shape.sag_change_um, 3, sign=True)
    if change != MISSING:
        sigma = format_number(shape.change_sigma_um, 3)
        state.append(
            f"  sag {change} ± {sigma} µm since {format_duration(shape.reference_s)}",
            style="default",
        )
    if shape.note:
        state.append(f"  {shape.note}", style="yellow")
    if estimate is None:
        return [("shape", state), ("cycle", Text("none yet", style="dim"))]
    cycle = Text(estimate.verdict, style=_VERDICT_STYLES[estimate.verdict])
    cycle.append(f"  {format_duration(shape.age_s)} ago, {estimate.kind}, ", style="default")
    cycle.append(
        f"residual {format_number(estimate.slope_residual_urad, 1, 'µrad')}, ", style="default"
    )
    cycle.append(f"in {format_number(1e3 * estimate.latency_s, 0, 'ms')}", style="default")
    cycle.append(
        f"  {shape.rejected}/{shape.cycles} rejected", style="yellow" if shape.rejected else "dim"
    )
    return [("shape", state), ("cycle", cycle)]


def _format_lateness(view: ConsoleView, row: telemetry.TelemetryRow) -> Text:
    late = COLUMNS["lateness_ms"]
    text = Text(
        f"{row.format_quantity('lateness_ms')}, worst of the minute "
        f"{late.format_value(view.lateness_max_ms)}"
    )
    text.append(f" {late.unit}{_list_other_columns(row, columns.Group.TIMING)}")
    missed = int(row.missed_ticks)
    text.append(
        f", {missed} of {int(row.tick) + missed} ticks missed",
        style="yellow" if missed else "default",
    )
    return text


def _format_faults(view: ConsoleView) -> Text:
    if view.fault:
        text = Text(view.fault, style="bold red")
        if not view.remedy:
            return text
        return text.append(f"; {view.remedy}", style="default")
    if not view.faults:
        return Text("none")
    return Text(f"none now, {view.faults} in this run; last: {view.last_fault}")
