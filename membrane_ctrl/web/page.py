"""The page of one viewer: the hold now, its history, its figure, what it may be told, and the runs
before it.
"""

import contextlib
import gzip
import json
import time
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from nicegui import ui

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.status import alarm_lines, lock_lines
from membrane_ctrl.model.columns import MISSING, PUBLISHED
from membrane_ctrl.service.access import (
    ACTIONS,
    STOP,
    UNLOCK,
    Action,
    WebUser,
    may,
    on_behalf,
    outranks,
    request,
)
from membrane_ctrl.service.feed import SPANS_S, HoldFeed, history, marks
from membrane_ctrl.service.hold_starter import HoldStarter
from membrane_ctrl.service.work_pools import (
    FIGURES,
    LIVE_CHARTS,
    LONG_CHARTS,
    SESSIONS,
    PoolFullError,
    pool_of_command,
)
from membrane_ctrl.web import figures
from membrane_ctrl.web.fleet_panel import fleet_panel
from membrane_ctrl.web.log_lines import find_new_lines
from membrane_ctrl.web.messages import show_message
from membrane_ctrl.web.no_hold import NoHoldPanel
from membrane_ctrl.web.runs_panel import runs_panel
from membrane_ctrl.web.tuning_panel import CHOOSES, SessionWatch, TuningPanel

_LOOK_S = 1.0
_SESSION_DIGITS = 8
_FETCH_S = 30.0  # for a browser to fetch a chart
_CHART_EVERY_S = {60.0: 1.0, 600.0: 2.0, 3600.0: 5.0}  # longer spans: once a minute
_LONG_CHART_LIFE_S = 30.0
_FIRST_SIGNAL = "error_um"  # of the chart
# a phone is narrow
_CSS = ".nicegui-log .q-scrollarea__content { white-space: pre-wrap; overflow-wrap: anywhere }"
_PRIMARY = "#3276bb"  # white on it is legible (4.7 : 1); on NiceGUI's own blue it is not
_COLOURS = {
    "hold": "positive",
    "fault": "negative",
    "settle": "info",
    "inflate": "info",
    "tune": "warning",
}


class SharedViews:
    """What all viewers of a hold see alike, made once: charts, maps, the tuning session.

    Browsers fetch charts and maps when they are ready, so that none pile up for a slow one.
    """

    def __init__(self, feeds: Mapping[str, HoldFeed]) -> None:
        self._feeds = feeds
        self._live_charts = figures.Shared(self._chart, LIVE_CHARTS, life_s=_LOOK_S)
        self._long_charts = figures.Shared(self._chart, LONG_CHARTS, life_s=_LONG_CHART_LIFE_S)
        self.maps = figures.Shared(self._map, FIGURES, life_s=60.0)
        watches = {
            name: SessionWatch(feed.logs) for name, feed in feeds.items() if feed.logs is not None
        }
        self.sessions = figures.Shared(lambda hold: watches[hold].look(), SESSIONS, life_s=_LOOK_S)

    async def chart(self, hold: str, signal: str, span: str, utc: bool) -> bytes:
        """Options of the history chart, as JSON in gzip. Raises PoolFullError if too many are asked
        for.
        """
        charts = self._live_charts if SPANS_S[span] in _CHART_EVERY_S else self._long_charts
        return await charts.get(hold, signal, span, utc)

    def _chart(self, hold: str, signal: str, span: str, utc: bool) -> bytes:
        feed, span_s = self._feeds[hold], SPANS_S[span]
        made = marks(feed, feed.logs, span_s)
        options = figures.chart(signal, history(feed, feed.logs, signal, span_s), utc, made)
        return gzip.compress(json.dumps(options).encode(), 1)

    def _map(self, hold: str, removed: str, _time_s: float) -> figures.MapPicture:
        """The newest figure less some terms; a figure of another time is another map."""
        seen = self._feeds[hold].seen
        assert seen.figure is not None
        return figures.map_picture(seen.figure, seen.reference, figures.REMOVED[removed])


class WebPage:
    """The elements of a viewer's page, and what it is set to show."""

    def __init__(
        self,
        feeds: Mapping[str, HoldFeed],
        hold: str,
        user: WebUser,
        views: SharedViews,
        starter: HoldStarter | None = None,
    ) -> None:
        self._feeds, self._hold, self._user, self._views = feeds, hold, user, views
        self._starter = starter
        self._feed = feeds[hold]
        self._logs = self._feed.logs
        self._utc = True
        self._span, self._signal = "10 min", _FIRST_SIGNAL
        self._removed = "nothing"
        self._charted_s = -1e9
        self._drawn: tuple[float, str] = (0.0, "")
        self._coloured = ""
        self._buttons: list[tuple[ui.button, Action]] = []
        self._asking = False
        # of this viewer, in records
        self._session = f"page {ui.context.client.id[:_SESSION_DIGITS]}"

    def build(self) -> None:
        """Put the page together."""
        self._dark = ui.dark_mode(None)
        ui.add_css(_CSS)
        ui.colors(primary=_PRIMARY)
        with ui.header().classes("items-center justify-between q-py-xs"):
            self._name = ui.label().classes("text-h6")
            self._state = ui.badge().classes("text-body1 q-pa-sm").props('aria-label="state"')
            with ui.row().classes("items-center"):
                ui.switch("UTC", value=True, on_change=lambda e: self._set("_utc", e.value)).props(
                    "color=dark keep-color"
                )
                ui.button(icon="dark_mode", on_click=self._toggle_dark).props(
                    'flat round color=white aria-label="dark"'
                )
                ui.label(f"{self._user.name} ({self._user.role})").classes("text-caption")
        if len(self._feeds) > 1:
            fleet_panel(self._feeds)
        with ui.tabs().classes("w-full") as tabs:
            now, look_back, tune = ui.tab("Now"), ui.tab("Look back"), ui.tab("Tune")
            for tab in (look_back, tune):
                tab.set_visibility(self._logs is not None)  # the runs of a hold elsewhere are there
        with ui.tab_panels(tabs, value=now).classes("w-full"):
            with ui.tab_panel(now):
                self._build_now()
            if self._logs is not None:
                with ui.tab_panel(look_back):
                    load = runs_panel(self._logs, self._hold, self._user, lambda: self._utc)
                    tabs.on_value_change(
                        lambda event: load() if event.value == look_back.props["name"] else None
                    )
                with ui.tab_panel(tune):
                    TuningPanel(
                        lambda: self._views.sessions.get(self._hold), self._user, self._may_choose
                    )
        with ui.footer().classes(
            "justify-center q-pa-xs !bg-white dark:!bg-[#121212]"
        ):  # always on the screen
            stop = ui.button(
                STOP.label, icon=STOP.icon, color="negative", on_click=lambda: self._confirm(STOP)
            )
            stop.classes("text-h6").style("width: min(100%, 24rem)").tooltip(STOP.does)
            self._buttons.append((stop, STOP))
        # a button that was clicked keeps the focus: the keys work there, too
        ui.keyboard(on_key=self._key, repeating=False, ignore=["input", "select", "textarea"])
        self._look()
        ui.timer(_LOOK_S, self._look)
        ui.timer(_LOOK_S, self._draw)

    def _may_choose(self) -> bool:
        return outranks(self._user.role, CHOOSES) and outranks(self._feed.seen.role, CHOOSES)

    def _build_now(self) -> None:
        self._why = ui.label().classes("text-subtitle1").props('role="status"')
        self._alarm = ui.label().classes("text-negative text-bold").props('role="alert"')
        if self._logs is not None:
            NoHoldPanel(self._feed, self._hold, self._user, self._starter)
        with ui.row().classes("w-full items-stretch no-wrap max-lg:flex-wrap"):
            with ui.column().classes("col-grow"):
                self._numbers = self._build_numbers()
                self._build_chart()
            with ui.column().style("width: 24rem; max-width: 100%"):
                self._build_actions()
                self._build_figure()
        self._events = ui.log(max_lines=200).classes("w-full h-48").props('aria-label="events"')
        self._shown_events: tuple[str, ...] = ()

    def _build_numbers(self) -> dict[str, ui.label]:
        found = {}
        with (
            ui.grid()
            .classes("w-full gap-2")
            .style("grid-template-columns: repeat(auto-fill, minmax(8.5rem, 1fr))")
        ):
            for column in PUBLISHED:
                with ui.card().classes("q-pa-sm gap-0"):
                    ui.label(column.title).classes("text-caption")
                    found[column.name] = (
                        ui.label(MISSING).classes("text-h6").props(f'data-field="{column.name}"')
                    )
        return found

    def _build_chart(self) -> None:
        with ui.row().classes("items-center"):
            ui.toggle(
                list(SPANS_S), value=self._span, on_change=lambda e: self._set("_span", e.value)
            ).props("dense")
            ui.select(
                {column.name: column.title for column in PUBLISHED},
                value=self._signal,
                on_change=lambda e: self._set("_signal", e.value),
            ).props('dense aria-label="signal"')
        self._chart = ui.echart({"series": []}).classes("w-full").style("height: 22rem")

    def _build_actions(self) -> None:
        with ui.grid(columns=3).classes("w-full gap-1"):
            for action in (*ACTIONS, UNLOCK):
                button = ui.button(
                    action.label, icon=action.icon, on_click=lambda _, a=action: self._confirm(a)
                )
                button.props("dense no-caps stack").tooltip(action.does)
                self._buttons.append((button, action))

    def _build_figure(self) -> None:
        with ui.row().classes("items-center"):
            ui.label("figure without")
            ui.select(
                list(figures.REMOVED),
                value=self._removed,
                on_change=lambda e: self._set("_removed", e.value),
            ).props('dense aria-label="terms to remove"')
        self._map = (
            ui.image()
            .classes("w-full")
            .style("max-width: 24rem; aspect-ratio: 1")
            .props('alt="figure"')
        )
        self._map_words = ui.label("no figure yet").classes("text-caption")
        self._terms = ui.echart({"series": []}).classes("w-full").style("height: 12rem")

    def _toggle_dark(self) -> None:
        """From the system's choice to dark, then to light and back."""
        self._dark.set_value(not self._dark.value)

    def _set(self, name: str, value: object) -> None:
        setattr(self, name, value)
        self._charted_s, self._drawn = -1e9, (0.0, "")

    def _look(self) -> None:
        """Show the state and the events."""
        seen = self._feed.seen
        self._show_status()
        if seen.events != self._shown_events:
            for line in find_new_lines(self._shown_events, seen.events):
                self._events.push(line)
            self._shown_events = seen.events

    async def _draw(self) -> None:
        """Show the figure and the history, if they are new; the next look waits for the browser."""
        seen = self._feed.seen
        if seen.figure is not None and self._drawn != (seen.figure.time_s, self._removed):
            self._drawn = (seen.figure.time_s, self._removed)
            picture = await self._views.maps.get(self._hold, self._removed, seen.figure.time_s)
            query = {"hold": self._hold, "removed": self._removed, "time_s": seen.figure.time_s}
            self._map.set_source(f"/map?{urlencode(query)}")
            self._map_words.set_text(picture.words)
            self._terms.options.clear()
            self._terms.options.update(picture.terms)
        span_s = SPANS_S[self._span]
        if time.monotonic() - self._charted_s > _CHART_EVERY_S.get(span_s, 60.0):
            self._charted_s = time.monotonic()
            query = {
                "hold": self._hold,
                "signal": self._signal,
                "span": self._span,
                "utc": self._utc,
            }
            # the prefix of the public address, which NiceGUI puts into the page
            fetched = (
                f"const answer = await fetch(window.path_prefix + '/chart?{urlencode(query)}'); "
                "if (answer.ok)"
            )
            drawn = (
                f"runMethod({self._chart.id}, 'run_chart_method', ['setOption', await "
                "answer.json()])"
            )
            with contextlib.suppress(TimeoutError):
                await ui.run_javascript(f"{fetched} {drawn}", timeout=_FETCH_S)

    def _show_status(self) -> None:
        seen = self._feed.seen
        status, row = seen.status, seen.status.get("row") or {}
        silent = seen.silent
        state = seen.state_name
        self._name.set_text(" ".join(part for part in (self._hold, seen.name or "no hold") if part))
        self._state.set_text(state)
        ended_well = silent and state != "fault"
        colour = "grey" if ended_well else _COLOURS.get(state, "warning")
        if colour != self._coloured:
            self._coloured = colour
            self._state.props(
                f"color={colour} text-color={'white' if colour == 'negative' else 'black'}"
            )
        self._why.set_text(silent or str(status.get("why") or "as it should be"))
        self._alarm.set_text("; ".join(alarm_lines(status)))
        for column in PUBLISHED:
            value = None if silent else row.get(column.name)
            self._numbers[column.name].set_text(column.format_value(value))
        for button, action in self._buttons:
            allowed = not silent and may(self._user, seen.role, action) and state in action.states
            if button.enabled != allowed:
                button.set_enabled(allowed)

    async def _key(self, event: Any) -> None:
        """The console's keys: h, p, m, s."""
        if (
            not event.action.keydown
            or event.modifiers.ctrl
            or event.modifiers.alt
            or event.modifiers.meta
        ):
            return
        paused = bool(self._feed.seen.status.get("paused"))
        wanted = {"h": "hold", "p": "resume" if paused else "pause", "m": "mark", "s": "stop"}
        action = next((a for a in (*ACTIONS, STOP) if a.do == wanted.get(str(event.key))), None)
        if action is not None and may(self._user, self._feed.seen.role, action):
            await self._confirm(action)

    async def _confirm(self, action: Action) -> None:
        """Ask for the input and for a confirmation, send, and say what became of it."""
        if self._asking:  # a key beside the open dialog
            return
        with ui.dialog() as dialog, ui.card():
            ui.label(action.label).classes("text-h6")
            ui.label(action.does)
            if action is UNLOCK:
                ui.label("Type the word of the lock, or nothing for your own lock:")
                for line in lock_lines(self._feed.seen.status):
                    ui.label(line).classes("text-negative text-bold")
            given = None
            if action.asks:  # a hidden one would take the focus, and Enter with it
                given = ui.input(
                    f"{action.asks}{f', {action.unit}' if action.unit else ''}"
                ).classes("w-full")
                given.props(
                    'autofocus inputmode="text"'
                )  # a phone's decimal keys may lack the minus or the point
                given.on("keydown.enter", lambda: dialog.submit("yes"))
            take_over = ui.checkbox("take command from whoever has it")
            with ui.row():
                sure = ui.button("Do it", on_click=lambda: dialog.submit("yes"))
                sure.props("color=primary" if action.asks else "color=primary autofocus")
                ui.button("Cancel", on_click=lambda: dialog.submit(""), color=None).props("flat")
        self._asking = True
        try:
            answer = await dialog
        finally:
            self._asking = False
        if not dialog.is_deleted:  # with the viewer
            dialog.delete()
        if not answer:
            return
        if not may(
            self._user, self._feed.seen.role, action
        ):  # the role may have changed while the dialog was open
            show_message(f"{action.label}: needs the role {action.role}", good=False)
            return
        try:
            asked = request(
                action,
                f"web: {self._user.name}",
                str(given.value or "") if given else "",
                bool(take_over.value),
            )
        except ValueError as error:
            show_message(str(error), good=False)
            return
        asked["on_behalf"] = on_behalf(self._user, self._session)
        try:
            outcome = await pool_of_command(action.do).run(self._feed.ask, asked)
        except PoolFullError as error:
            outcome = Outcome.failed(action.label, f"not sent: {error}")
        show_message(outcome.text, outcome.done)
