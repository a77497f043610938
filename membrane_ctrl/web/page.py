"""The page of one viewer: the hold now, its history, its figure, its commands, and the runs before
it.
"""

import contextlib
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urlencode

from nicegui import ui

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.control_port.status_lines import alarm_lines, lock_lines
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model.columns import MISSING, PUBLISHED, TelemetryColumn
from membrane_ctrl.service.access import (
    ACTIONS,
    STOP,
    UNLOCK,
    is_action_allowed,
    on_behalf,
    request,
)
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.event_lines import find_new_lines
from membrane_ctrl.service.feed import SPANS_S, HoldFeed
from membrane_ctrl.service.guided_session import GuidedSession
from membrane_ctrl.service.hold_starter import HoldStarter
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import COMMANDS, SAFETY_COMMANDS
from membrane_ctrl.web import figure_map, history_chart
from membrane_ctrl.web.action_dialog import ask_for_confirmation
from membrane_ctrl.web.alarms_panel import alarms_panel
from membrane_ctrl.web.chart_marks import is_now, mark_past
from membrane_ctrl.web.commissioning_panel import COMMISSIONS, CommissioningPanel
from membrane_ctrl.web.configuration_panel import EDITS, ConfigurationPanel
from membrane_ctrl.web.confirmation import confirm
from membrane_ctrl.web.consequences import Consequence, find_consequence
from membrane_ctrl.web.fetched_charts import SCRIPT as FETCHED_CHARTS
from membrane_ctrl.web.fleet_panel import fleet_panel
from membrane_ctrl.web.gains_panel import GainsPanel
from membrane_ctrl.web.held_by import describe_holder
from membrane_ctrl.web.messages import MESSAGE_CSS, show_message
from membrane_ctrl.web.no_hold import NoHoldPanel
from membrane_ctrl.web.runs_panel import runs_panel
from membrane_ctrl.web.sending import send_and_show
from membrane_ctrl.web.shared_views import CHART_EVERY_S, FIRST_FIGURE, LOOK_S, SharedViews
from membrane_ctrl.web.tuning_panel import CHOOSES, TuningPanel

KEEPS: Role = "operate"  # a reference, which all viewers see
_SESSION_DIGITS = 8
_FETCH_S = 30.0  # for a browser to fetch a chart
_FIRST_SIGNALS = ["error_um"]  # of the chart
_PANEL_REM = {1: 22, 2: 30, 3: 38, 4: 46}  # height of the chart by its panels
# One column on a phone: numbers and chart, commands and figure, events. On a wide screen commands
# and figure are beside the others.
_CSS = (
    ".membrane-now { display: grid; gap: 1rem; grid-template-columns: minmax(0, 1fr) }"
    ".membrane-events { height: 12rem }"
    "@media (min-width: 1024px) {"
    ".membrane-now { grid-template: auto minmax(12rem, 1fr) / minmax(0, 1fr) 26rem }"
    ".membrane-side { grid-column: 2; grid-row: 1 / span 2 }"
    ".membrane-events { height: 100%; max-height: 24rem } }"
    ".nicegui-log .q-scrollarea__content { white-space: pre-wrap; overflow-wrap: anywhere }"
    ".membrane-map canvas { touch-action: pan-y; display: block }"
    # above an open dialog, which leaves room for it
    ".membrane-stop { z-index: 7000 }"
    ".q-dialog__inner > div { max-height: calc(100vh - 10rem) !important }"
    # legible on either ground
    ".body--dark .text-negative { color: #ff7b72 !important }"
    ".body--light .text-warning { color: #8a5a00 !important }" + MESSAGE_CSS
)
_PRIMARY = "#3276bb"  # white on it is legible (4.7 : 1); on NiceGUI's own blue it is not
_COLOURS = {
    "hold": "positive",
    "fault": "negative",
    "settle": "info",
    "inflate": "info",
    "tune": "warning",
}
_BUTTON_COLOURS = {
    Consequence.NOTHING: "primary",
    Consequence.MOVES_GAS: "amber-5 text-color=black",
    Consequence.COSTS_HOURS: "deep-orange-9",
}
_KEYS = {"h": "hold", "p": "pause", "m": "mark", "s": "stop"}
_KEYS_HELP = (
    ("h", "hold"),
    ("p", "pause, or resume"),
    ("m", "mark"),
    ("s", "stop"),
    ("?", "these keys"),
    ("Enter", "confirms what leaves the mirror as it is, and STOP"),
    ("Escape", "cancels"),
)


class WebPage:
    """The elements of a viewer's page, and what it is set to show."""

    def __init__(
        self,
        feeds: Mapping[str, HoldFeed],
        hold: str,
        user: WebUser,
        views: SharedViews,
        starter: HoldStarter | None = None,
        editor: ConfigurationEditor | None = None,
        guided: GuidedSession | None = None,
    ) -> None:
        self._editor = editor
        self._guided = guided
        self._feeds = feeds
        self._hold = hold
        self._user = user
        self._views = views
        self._starter = starter
        self._feed = feeds[hold]
        self._logs = self._feed.logs
        self._utc = True
        self._span = "10 min"
        self._signals = list(_FIRST_SIGNALS)
        self._removed: tuple[str, ...] = ()
        self._reference = FIRST_FIGURE
        self._charted_s = -1e9
        self._drawn: tuple[object, ...] = ()
        self._coloured = ""
        self._buttons: list[tuple[ui.button, ActionButton]] = []
        self._asking = False  # a dialog is open
        self._stopping = False  # it is that of STOP
        self._clicked_s: float | None = None  # UTC of the last click on the chart
        # of this viewer, in records
        self._session = f"page {ui.context.client.id[:_SESSION_DIGITS]}"

    def build(self, tab: str = "", gains: str = "") -> None:
        """Put the page together.

        Parameters
        ----------
        tab : str
            Name of the tab to begin with, such as `tune`; empty or unknown for the first.
        gains : str
            Session or run whose gains are explored; empty for the newest.
        """
        self._first_tab = tab
        self._wanted_gains = gains
        self._dark = ui.dark_mode(None)
        ui.add_css(_CSS)
        scripts = (history_chart.SCRIPT, figure_map.SCRIPT, FETCHED_CHARTS)
        ui.add_head_html(f"<script>{chr(10).join(scripts)}</script>")
        ui.colors(primary=_PRIMARY)
        self._build_header()
        if len(self._feeds) > 1:
            fleet_panel(self._feeds)
        self._build_tabs()
        with ui.footer().classes(
            "membrane-stop justify-center q-pa-xs !bg-white dark:!bg-[#121212]"
        ):  # always on the screen
            stop = ui.button(
                STOP.label, icon=STOP.icon, color="negative", on_click=lambda: self._confirm(STOP)
            )
            stop.classes("text-h6").style("width: min(100%, 24rem)").tooltip(STOP.does)
            self._buttons.append((stop, STOP))
        # a button that was clicked keeps the focus: the keys work there, too
        ui.keyboard(on_key=self._key, repeating=False, ignore=["input", "select", "textarea"])
        ui.on("membrane_chart_clicked", self._choose_moment)
        self._look()
        ui.timer(LOOK_S, self._look)
        ui.timer(LOOK_S, self._draw)

    def _build_header(self) -> None:
        """The line on top: hold, state, UTC or local time, dark or light, keys, and who views."""
        with ui.header().classes("items-center justify-between q-py-xs"):
            self._name = ui.label().classes("text-h6")
            self._state = ui.badge().classes("text-body1 q-pa-sm").props('aria-label="state"')
            with ui.row().classes("items-center"):
                ui.switch("UTC", value=True, on_change=lambda e: self._set("_utc", e.value)).props(
                    "color=dark keep-color"
                )
                ui.button(icon="dark_mode", on_click=self._toggle_dark).props(
                    'flat round color=white aria-label="dark or light"'
                )
                ui.button(icon="help_outline", on_click=self._show_keys).props(
                    'flat round color=white aria-label="keys"'
                )
                ui.label(f"{self._user.name} ({self._user.role})").classes("text-caption")

    def _build_tabs(self) -> None:
        """The tabs; those that this viewer's role or this hold does not have are hidden."""
        with ui.tabs().classes("w-full") as tabs:
            now, look_back = ui.tab("Now"), ui.tab("Look back")
            alarms, tune = ui.tab("Alarms"), ui.tab("Tune")
            configuration = ui.tab("Configuration")
            configuration.set_visibility(self._may_edit)
            commission = ui.tab("Commission")
            commission.set_visibility(self._may_commission)
            for tab in (look_back, alarms, tune):
                tab.set_visibility(self._logs is not None)  # the runs of a hold elsewhere are there
        with ui.tab_panels(tabs, value=now).classes("w-full"):
            with ui.tab_panel(now):
                self._build_now()
            if self._logs is None:
                return
            with ui.tab_panel(look_back):
                load_runs = runs_panel(self._logs, self._hold, self._user, lambda: self._utc)
            with ui.tab_panel(alarms):
                load_alarms = alarms_panel(
                    lambda: self._views.alarms(self._hold), lambda: self._utc
                )
            with ui.tab_panel(tune):
                TuningPanel(
                    lambda: self._views.sessions.get(self._hold),
                    self._hold,
                    self._user,
                    self._may_choose,
                )
                ui.separator()
                gains = GainsPanel(
                    self._views.gains,
                    self._feed,
                    self._hold,
                    self._user,
                    lambda: on_behalf(self._user, self._session),
                    self._wanted_gains,
                )
            # Panels load their tables when their tab is opened first, not with the page.
            loads = {
                look_back.props["name"]: load_runs,
                alarms.props["name"]: load_alarms,
                tune.props["name"]: gains.load,
            }
            if self._may_edit:
                with ui.tab_panel(configuration):
                    loads[configuration.props["name"]] = self._build_editor().load_list
            if self._guided is not None and self._may_commission:
                with ui.tab_panel(commission):
                    panel = CommissioningPanel(self._guided, self._user)
                    loads[commission.props["name"]] = panel.load_list

        async def load(event: Any) -> None:
            if event.value in loads:
                await loads[event.value]()

        tabs.on_value_change(load)
        # The address of the page may name the tab to open.
        by_name = {name.lower(): name for name in loads}
        if self._first_tab in by_name:
            tabs.set_value(by_name[self._first_tab])

    @property
    def _may_edit(self) -> bool:
        """Whether this viewer may see and edit the configurations of this folder."""
        is_ours = self._editor is not None and self._starter is not None
        return is_ours and role_includes(self._user.role, EDITS)

    @property
    def _may_commission(self) -> bool:
        """Whether this viewer may see and answer the guided session of this folder."""
        return self._guided is not None and role_includes(self._user.role, COMMISSIONS)

    def _build_editor(self) -> ConfigurationPanel:
        assert self._editor is not None
        assert self._starter is not None
        return ConfigurationPanel(
            self._feed,
            self._user,
            self._editor,
            self._starter,
            lambda: on_behalf(self._user, self._session),
        )

    def _may_choose(self) -> bool:
        return role_includes(self._user.role, CHOOSES) and role_includes(
            self._feed.seen.role, CHOOSES
        )

    def _build_now(self) -> None:
        """The first tab: why, by what and with which alarms the mirror is held; numbers, chart,
        commands.
        """
        self._why = ui.label().classes("text-subtitle1").props('role="status"')
        self._holder = ui.label().props('aria-label="what holds the mirror"')
        self._alarm = ui.label().classes("text-negative text-bold").props('role="alert"')
        if self._logs is not None:
            NoHoldPanel(self._feed, self._hold, self._user, self._starter)
        with ui.element("div").classes("membrane-now w-full"):
            with ui.column().classes("min-w-0"):
                self._numbers = self._build_numbers()
                self._build_chart()
            with ui.column().classes("membrane-side min-w-0"):
                self._build_actions()
                self._build_figure()
            self._events = ui.log(max_lines=200).classes("w-full membrane-events")
            self._events.props('aria-label="events"')
        self._shown_events: tuple[str, ...] = ()

    def _build_numbers(self) -> dict[str, tuple[ui.card, ui.label]]:
        """A card of each published column; those without a value are hidden."""
        found = {}
        with (
            ui.grid()
            .classes("w-full gap-2")
            .style("grid-template-columns: repeat(auto-fill, minmax(min(8.5rem, 24vw), 1fr))")
        ) as self._numbers_place:
            for column in PUBLISHED:
                with ui.card().classes("q-pa-sm max-sm:!p-1 gap-0") as card:
                    ui.label(column.title).classes("text-caption leading-tight")
                    label = ui.label(MISSING).classes("text-h6 leading-tight")
                    label.props(f'data-field="{column.name}"')
                card.tooltip(column.description)
                found[column.name] = (card, label)
        return found

    def _build_chart(self) -> None:
        """The choice of span and signals, the button that marks a clicked moment, and the chart."""
        with ui.row().classes("items-center w-full"):
            ui.toggle(
                list(SPANS_S), value=self._span, on_change=lambda e: self._set("_span", e.value)
            ).props('dense no-caps aria-label="time span"')
            ui.select(
                {column.name: column.title for column in PUBLISHED},
                value=self._signals,
                multiple=True,
                on_change=lambda e: self._choose_signals(e.value),
            ).props(f'dense use-chips max-values={history_chart.SIGNALS_MOST} aria-label="signals"')
            self._mark_here = ui.button(
                "Mark", icon="bookmark", on_click=self._mark_moment, color=None
            ).props("dense outline no-caps")
            self._mark_here.set_visibility(False)
        # the chart itself takes no attributes
        with ui.element("div").classes("w-full").props('role="img" aria-label="history"'):
            self._chart = ui.echart({"series": []}).classes("w-full")
            self._chart.style(f"height: {_PANEL_REM[1]}rem")

    def _build_actions(self) -> None:
        """The commands by what they do to the mirror."""
        for consequence in Consequence:
            ui.label(consequence.value).classes("text-caption")
            with ui.grid(columns=4).classes("w-full gap-1").props('role="group"'):
                for action in (*ACTIONS, UNLOCK):
                    if find_consequence(action) is not consequence:
                        continue
                    button = ui.button(
                        action.label,
                        icon=action.icon,
                        on_click=lambda _, chosen=action: self._confirm(chosen),
                        color=None,
                    )
                    button.props(f"dense no-caps stack color={_BUTTON_COLOURS[consequence]}")
                    button.tooltip(action.does)
                    self._buttons.append((button, action))

    def _build_figure(self) -> None:
        """The choice of a reference and of removed terms, the map, and the bars of the terms."""
        with ui.row().classes("items-center w-full"):
            self._against = ui.select(
                self._views.list_references(self._hold),
                value=self._reference,
                label="change since",
                on_change=lambda e: self._set("_reference", e.value),
            ).props('dense aria-label="change since"')
            keep = ui.button(
                "Use this figure", icon="push_pin", on_click=self._keep_reference, color=None
            ).props("dense outline no-caps")
            keep.tooltip("Keep the newest figure as a reference, for all viewers")
            keep.set_enabled(role_includes(self._user.role, KEEPS))
        ui.label("terms removed from the figure").classes("text-caption")
        with ui.row().classes("items-center gap-x-2 gap-y-0"):
            boxes = {
                name: ui.checkbox(name).props("dense size=sm") for name in figure_map.REMOVABLE
            }
        for box in boxes.values():
            box.on_value_change(
                lambda: self._set(
                    "_removed", tuple(sorted(name for name, box in boxes.items() if box.value))
                )
            )
        with ui.element("div").classes("membrane-map w-full"):
            self._map = ui.element("canvas").props('role="img" aria-label="no figure yet"')
        self._map_words = ui.label("no figure yet").classes("text-caption")
        with ui.element("div").classes("w-full").props('role="img" aria-label="terms"') as terms:
            self._terms = ui.echart({"series": []}).classes("w-full").style("height: 13rem")
        self._terms_place = terms
        self._terms_place.set_visibility(False)

    def _toggle_dark(self) -> None:
        """From the system's choice to dark, then to light and back."""
        self._dark.set_value(not self._dark.value)

    def _set(self, name: str, value: object) -> None:
        setattr(self, name, value)
        self._charted_s = -1e9
        self._drawn = ()

    def _choose_signals(self, signals: list[str]) -> None:
        self._set("_signals", list(signals) or list(_FIRST_SIGNALS))
        self._chart.style(f"height: {_PANEL_REM[len(self._signals)]}rem")

    def _keep_reference(self) -> None:
        if not role_includes(self._user.role, KEEPS):
            return
        name = self._views.add_reference(self._hold)
        if not name:
            show_message("There is no usable figure yet.", good=False)
            return
        self._against.set_options(self._views.list_references(self._hold), value=name)

    def _choose_moment(self, event: Any) -> None:
        """Offer to mark the moment at which the viewer has clicked into the chart."""
        try:
            shown_s = float(event.args) / 1e3
            moment = datetime.fromtimestamp(shown_s, UTC)
        except (TypeError, ValueError, OverflowError, OSError):  # a browser may send anything
            return
        # The chart's axis is in the viewer's time: the script sends what it shows
        offset = None if self._utc else moment.astimezone().utcoffset()
        self._clicked_s = shown_s - (offset.total_seconds() if offset else 0.0)
        mark = next(action for action in ACTIONS if action.do == "mark")
        self._mark_here.set_text(f"Mark {moment:%H:%M:%S}")
        self._mark_here.set_visibility(is_action_allowed(self._user, self._user.role, mark))

    async def _mark_moment(self) -> None:
        """Mark the chosen moment: a present one by the hold, a past one beside its recording."""
        mark = next(action for action in ACTIONS if action.do == "mark")
        if self._clicked_s is None or self._asking:
            return
        if is_now(self._clicked_s) or self._logs is None:
            await self._confirm(mark)
            return
        # A past moment: no hold is asked, so the role is judged here
        given = await self._ask(mark)
        if given is None or not role_includes(self._user.role, mark.role):
            return
        who = f"web: {self._user.name}"
        try:
            outcome = await COMMANDS.run(mark_past, self._logs, self._clicked_s, given.text, who)
        except PoolFullError as error:
            outcome = Outcome.failed(mark.label, str(error))
        if outcome.done:
            self._feed.marks.append((self._clicked_s, given.text.strip()))
            self._mark_here.set_visibility(False)
            self._charted_s = -1e9
        show_message(outcome.text, outcome.done)

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
        wanted = (seen.figure and seen.figure.time_s, self._removed, self._reference)
        if seen.figure is not None and self._drawn != wanted:
            self._drawn = wanted
            await self._draw_figure(seen.figure.time_s)
        span_s = SPANS_S[self._span]
        if time.monotonic() - self._charted_s > CHART_EVERY_S.get(span_s, 60.0):
            self._charted_s = time.monotonic()
            query = {
                "hold": self._hold,
                "signals": ",".join(self._signals),
                "span": self._span,
                "utc": self._utc,
            }
            drawn = f"await membraneDrawHistory({self._chart.id}, '/chart?{urlencode(query)}')"
            await self._run_script(drawn)

    async def _draw_figure(self, time_s: float) -> None:
        """Show the map of the newest figure; the browser fetches its pixels."""
        try:
            found = await self._views.map(self._hold, self._removed, self._reference, time_s)
        except PoolFullError:
            return
        query = {
            "hold": self._hold,
            "removed": ",".join(self._removed),
            "reference": self._reference,
            "time_s": time_s,
        }
        self._map.props(f'aria-label="{found.words}"')
        self._map_words.set_text(found.words)
        self._terms_place.set_visibility(True)
        self._terms.options.clear()
        self._terms.options.update(found.terms)
        await self._run_script(
            f"await membraneDrawMap('c{self._map.id}', '/map?{urlencode(query)}')"
        )

    async def _run_script(self, script: str) -> None:
        """Run a script of the page that fetches something."""
        with contextlib.suppress(TimeoutError):
            await ui.run_javascript(script, timeout=_FETCH_S)

    def _show_status(self) -> None:
        """Show the newest status: state, reason, alarms and numbers, and which buttons may be
        used.
        """
        # 1. The state; grey where nothing moves any more, as after a regular end
        seen = self._feed.seen
        status, row = seen.status, seen.status.get("row") or {}
        silent = seen.silent
        state = seen.state_name
        self._name.set_text(" ".join(part for part in (self._hold, seen.name or "no hold") if part))
        self._state.set_text(state)
        is_regular = seen.ended is None or seen.ended.is_regular
        rests = silent and state != "fault" and is_regular
        colour = "grey" if rests else _COLOURS.get(state, "warning")
        if colour != self._coloured:
            self._coloured = colour
            self._state.props(
                f"color={colour} text-color={'white' if colour == 'negative' else 'black'}"
            )
        # 2. Why, by what, and what needs attention
        self._why.set_text(silent or str(status.get("why") or "as it should be"))
        self._holder.set_text("" if silent else describe_holder(status))
        # after the end, the fault is in the panel about it
        has_ended = bool(seen.problem) and seen.ended is not None
        lines = lock_lines(status) if has_ended else alarm_lines(status)
        self._alarm.set_text("; ".join(lines))
        # 3. The numbers: of a hold that is silent they are not shown, because they may be wrong now
        self._numbers_place.set_visibility(not has_ended)
        for column in PUBLISHED:
            card, label = self._numbers[column.name]
            value = row.get(column.name)
            label.set_text(format_number(column, None if silent else value))
            card.set_visibility(value is not None)
        # 4. The buttons: by both roles, the state, and whether there is anything to change. The
        #    hold judges again
        for button, action in self._buttons:
            allowed = (
                not silent
                and is_action_allowed(self._user, seen.role, action)
                and state in action.states
            )
            allowed = allowed and changes_something(action, status)
            allowed = allowed or (action is STOP and self._can_stop_guided)
            if button.enabled != allowed:
                button.set_enabled(allowed)

    async def _key(self, event: Any) -> None:
        """The console's keys: h, p, m, s; ? shows them."""
        if (
            not event.action.keydown
            or event.modifiers.ctrl
            or event.modifiers.alt
            or event.modifiers.meta
        ):
            return
        if str(event.key) == "?":
            await self._show_keys()
            return
        wanted = _KEYS.get(str(event.key))
        if wanted == "pause" and self._feed.seen.status.get("paused"):
            wanted = "resume"
        action = next((each for each in (*ACTIONS, STOP) if each.do == wanted), None)
        if action is not None and is_action_allowed(self._user, self._feed.seen.role, action):
            await self._confirm(action)

    async def _show_keys(self) -> None:
        """Show the keys until the viewer closes the dialog, unless another one is open."""
        if self._asking:
            return
        self._asking = True
        with ui.dialog() as dialog, ui.card():
            ui.label("Keys").classes("text-h6")
            with ui.grid(columns="auto 1fr"):
                for key, does in _KEYS_HELP:
                    ui.label(key).classes("text-bold")
                    ui.label(does)
            ui.button("Close", on_click=lambda: dialog.submit(""), color=None).props(
                "flat autofocus"
            )
        try:
            await dialog
        finally:
            self._asking = False
        if not dialog.is_deleted:
            dialog.delete()

    async def _ask(self, action: ActionButton) -> Any:
        """Show the dialog of a command, one at a time but for STOP: a key may be pressed beside
        it.
        """
        before = self._asking
        self._asking, self._stopping = True, action is STOP
        try:
            return await ask_for_confirmation(
                action, self._feed.seen.status, self._views.config(self._hold)
            )
        finally:
            self._asking, self._stopping = before, False

    async def _confirm(self, action: ActionButton) -> None:
        """Ask for the input and for a confirmation, send, and show what became of it."""
        # One dialog at a time, except that STOP may come over any other
        if self._stopping or (self._asking and action is not STOP):
            return
        if action is STOP and self._can_stop_guided:
            await self._stop_guided()
            return
        given = await self._ask(action)
        if given is None:
            return
        if not is_action_allowed(
            self._user, self._feed.seen.role, action
        ):  # the role may have changed while the dialog was open
            show_message(f"{action.label}: needs the role {action.role}", good=False)
            return
        try:
            asked = request(action, f"web: {self._user.name}", given.text, given.take_over)
        except ValueError as error:
            show_message(str(error), good=False)
            return
        asked["on_behalf"] = on_behalf(self._user, self._session)
        await send_and_show(self._feed, asked)

    @property
    def _can_stop_guided(self) -> bool:
        """Whether STOP is for a guided session: it runs, and no hold of this page does.

        The feed has not the session's own holds. A hold of the page always comes first.
        """
        is_running = self._guided is not None and self._guided.seen.is_running
        is_alone = bool(self._feed.seen.silent)
        return is_running and is_alone and role_includes(self._user.role, STOP.role)

    async def _stop_guided(self) -> None:
        """Ask, and stop the guided session: it switches its pump off."""
        does = "The pump of the guided session is switched off; it can be resumed."
        self._stopping = True
        try:
            is_sure = await confirm(
                "STOP the guided session?", (does,), "Stop the session", "negative", True
            )
        finally:
            self._stopping = False
        if is_sure and self._guided is not None and self._can_stop_guided:
            await SAFETY_COMMANDS.run(self._guided.stop, self._user.name)


def format_number(column: TelemetryColumn, value: float | None) -> str:
    """A value for its card; a fraction in per cent.

    Parameters
    ----------
    column : TelemetryColumn
        Its decimals and unit.
    value : float or None
        None or NaN: the column has no value now.
    """
    if value is not None and column.name.endswith("_fraction"):
        return f"{100.0 * value:.0f} %"
    return column.format_value(value)


def changes_something(action: ActionButton, status: Mapping[str, Any]) -> bool:
    """Whether a command would change anything, as far as the status shows.

    A button without effect is disabled; the hold would answer it, and change nothing.

    Parameters
    ----------
    action : ActionButton
        The command of the button.
    status : mapping
        The hold's newest status; what it lacks counts as "would change something".
    """
    match action.do:
        case "shape_on":
            return status.get("shape") in (None, "off")
        case "shape_off":
            return status.get("shape") != "off"
        case "pause":
            return not status.get("paused")
        case "resume":
            return status.get("paused") is not False
        case "unlock":
            return bool(status.get("locks"))
        case "keep":
            return status.get("trial_left_s") is not None
        case "quiet":
            return bool(alarm_lines(status))
    return True
