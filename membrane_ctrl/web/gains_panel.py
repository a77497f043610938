"""Gains chosen by hand: sliders, what they would do, and a trial on the hold."""

from __future__ import annotations

import json
import math
from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import urlencode

from nicegui import ui

from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.controller.commands import TABLE
from membrane_ctrl.model import errors
from membrane_ctrl.model.run_status import gains_words
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.web.confirmation import confirm
from membrane_ctrl.web.gains_charts import CHARTS
from membrane_ctrl.web.gains_views import ChosenGains, ExploredGains, GainsSource, GainsViews
from membrane_ctrl.web.messages import show_message
from membrane_ctrl.web.sending import send_and_show

TRIES: Role = "tune"  # as for `ctl gains`
_LOOK_S = 1.0
_FETCH_S = 30.0
_TRIALS_MIN = (2, 5, 10, 30)
# A trial ends by itself when its time is over; a shorter one cannot be asked for
_SHORTEST_TRIAL_S = 1.0
_STATES = frozenset(state.name.lower() for state in TABLE["gains"].states)
_TITLES = {
    "bode": "open loop",
    "responses": "responses",
    "noise": "sensitivity and spectrum",
    "nyquist": "Nyquist plot",
}
_NOTHING = (
    "Nothing to explore yet: a tuning session that has observed its weather is needed, or a run "
    "with 200 s of undisturbed hold."
)


class GainsPanel:
    """The sliders of one viewer.

    The setting of a session or run is common to its viewers, so it survives a reload of the page. A
    viewer without the role `tune` sees it, and moves sliders of his own until it changes.

    Parameters
    ----------
    views : GainsViews
        Common to all viewers: what can be explored, and how the sliders are set.
    feed : HoldFeed
        Of the hold on which gains are tried.
    hold : str
        Name of the hold in addresses.
    user : WebUser
        Trying, keeping and saving need the role `tune`; without it the sliders are the viewer's
        own.
    on_behalf : callable
        Returns who asks, for commands.
    wanted : str
        Name of the session or run to begin with; empty for the newest.
    """

    def __init__(
        self,
        views: GainsViews,
        feed: HoldFeed,
        hold: str,
        user: WebUser,
        on_behalf: Callable[[], dict[str, str]],
        wanted: str = "",
    ) -> None:
        self._views = views
        self._feed = feed
        self._hold = hold
        self._user = user
        self._on_behalf = on_behalf
        self._wanted = wanted
        self._source: GainsSource | None = None
        self._explored: ExploredGains | None = None
        self._shown = ChosenGains("", None, "")  # where the sliders are
        self._common: ChosenGains | None = None  # the newest common setting that was shown
        self._is_placing = False  # the sliders are set by the page
        self._is_drawing = self._is_stale = False
        ui.label("Choose gains by hand").classes("text-h6")
        self._text = ui.label().props('role="status"').style("overflow-wrap: anywhere")
        with ui.column().classes("w-full") as self._body:
            self._build_trial()
            with ui.row().classes("w-full items-start"):
                with ui.column().style("width: 26rem; max-width: 100%"):
                    self._build_sliders()
                self._table = ui.table(rows=[], columns=[]).props("dense flat")
                self._table.props('aria-label="figures of the gains"').classes("max-w-full")
            self._build_charts()
        self._body.set_visibility(False)
        self._show_trial()
        ui.timer(_LOOK_S, self._show_trial)
        ui.timer(_LOOK_S, self._follow_others)

    async def load(self) -> None:
        """List what can be explored; keeps what is shown, and draws it again after another tab."""
        self._text.set_text("Looking for sessions and runs.")
        try:
            names = await self._views.list_sources(self._hold)
        except (errors.CommandError, PoolFullError) as error:
            self._text.set_text(str(error))
            return
        if self._wanted and self._wanted not in names:
            names = [self._wanted, *names]
        chosen = self._choice.value if self._choice.value in names else self._wanted
        self._is_placing = True
        self._choice.set_options(names, value=chosen or next(iter(names), None))
        self._is_placing = False
        if not names:
            self._text.set_text(_NOTHING)
        elif self._source is None:
            await self._open()
        else:
            self._text.set_text(self._source.text)
            await self._draw()

    def _build_sliders(self) -> None:
        self._choice = ui.select([], label="session or run", on_change=self._handle_source)
        self._choice.classes("w-full").props('aria-label="session or run"')
        self._start = ui.select([], label="start from", on_change=self._handle_start)
        self._start.classes("w-full").props('aria-label="start from"')
        self._speed = _Slider(
            "response, closed-loop time constant: fast to slow", True, self._handle_move
        )
        self._damping = _Slider("robustness: lively to calm; SIMC has 4", False, self._handle_move)
        self._filter = _Slider("measurement filter: little to much", True, self._handle_move)
        self._author = ui.label().classes("text-caption").props('role="status"')
        self._command = (
            ui.label()
            .classes("text-caption")
            .style("font-family: monospace; overflow-wrap: anywhere")
        )
        with ui.row():
            copy = ui.button("Copy the command", icon="content_copy", on_click=self._copy)
            copy.props("no-caps flat dense")
            self._save = ui.button("Save into the session", icon="save", on_click=self._save_gains)
            self._save.props("no-caps outline dense")
            self._save.tooltip("As gains.toml, for `tune apply`; needs the role tune")

    def _build_trial(self) -> None:
        """The buttons of a trial are above the sliders: a second viewer looks for them."""
        with ui.row().classes("items-center w-full"):
            self._try = ui.button("Try on the hold", icon="science", on_click=self._try_gains)
            self._try.props("no-caps color=amber-5 text-color=black")
            self._try.tooltip("The hold returns to its gains by itself; needs the role tune")
            self._minutes = ui.select({each: f"{each} min" for each in _TRIALS_MIN}, value=5)
            self._minutes.props('dense aria-label="duration of the trial"')
            self._keep = ui.button("Keep them", icon="done_all", on_click=self._keep_gains)
            self._keep.props("no-caps color=amber-5 text-color=black")
            self._back = ui.button("Go back", icon="undo", on_click=self._go_back)
            self._back.props("no-caps color=amber-5 text-color=black")
            self._trial = ui.label().props('role="status" aria-label="gains of the hold"')

    def _build_charts(self) -> None:
        columns = "grid-template-columns: repeat(auto-fit, minmax(min(22rem, 100%), 1fr))"
        self._charts: dict[str, ui.echart] = {}
        with ui.element("div").classes("w-full").style(f"display: grid; gap: 1rem; {columns}"):
            for name in CHARTS:
                with ui.element("div").classes("min-w-0") as place:
                    place.props(f'role="img" aria-label="{_TITLES[name]}"')
                    chart = ui.echart({"series": []}).classes("w-full").style("height: 26rem")
                    self._charts[name] = chart

    def _handle_source(self) -> Awaitable[None] | None:
        """Open the session or run that the viewer has chosen; its name stays in the address."""
        if self._is_placing:
            return None
        query = {"hold": self._hold, "tab": "tune", "gains": str(self._choice.value or "")}
        ui.navigate.history.replace(f"?{urlencode(query)}")
        return self._open()

    async def _open(self) -> None:
        """Read the chosen session or run, and set the sliders as its viewers have them, or to its
        gains.
        """
        name = str(self._choice.value or "")
        if not name:
            return
        self._text.set_text(f"Reading {name}.")
        try:
            source = await self._views.open_source(self._hold, name)
        except (errors.CommandError, PoolFullError, OSError) as error:
            self._source = None
            self._body_visible(False)
            self._text.set_text(str(error))
            return
        if name != self._choice.value:  # another has been chosen meanwhile
            return
        # The ranges of the sliders come before their values, which would be cut off
        self._source = source
        self._text.set_text(source.text)
        self._body_visible(True)
        self._speed.set_range(*source.time_constants_s)
        self._damping.set_range(*source.dampings)
        self._filter.set_range(*source.filters_s)
        # The setting of all viewers, else the proposal
        names = list(source.settings)
        first = "proposed" if "proposed" in names else names[0]
        self._is_placing = True
        self._start.set_options(names, value=first)
        self._is_placing = False
        self._common = self._views.find_chosen(self._hold, name)
        if self._common is not None and self._common.start in names:
            self._place(self._common)
        else:
            self._place(ChosenGains(first, None, ""))
        await self._draw()

    def _body_visible(self, is_visible: bool) -> None:
        self._body.set_visibility(True)
        self._table.set_visibility(is_visible)
        for chart in self._charts.values():
            chart.set_visibility(is_visible)

    def _handle_start(self) -> Awaitable[None] | None:
        """Set the sliders to gains with a name, and show exactly those."""
        if self._is_placing or self._source is None:
            return None
        return self._choose(ChosenGains(str(self._start.value), None, self._user.name))

    def _handle_move(self) -> Awaitable[None] | None:
        """Show the gains to which the viewer has moved a slider."""
        if self._is_placing or self._source is None:
            return None
        setting = (self._speed.value, self._damping.value, self._filter.value)
        return self._choose(ChosenGains(str(self._start.value), setting, self._user.name))

    async def _choose(self, chosen: ChosenGains) -> None:
        """Show a setting; that of a viewer with the role `tune` is for all."""
        if role_includes(self._user.role, TRIES):
            self._common = chosen
            self._views.choose(self._hold, str(self._choice.value), chosen)
        self._place(chosen)
        await self._draw()

    async def _follow_others(self) -> None:
        """Show what another viewer has chosen."""
        common = self._views.find_chosen(self._hold, str(self._choice.value or ""))
        is_known = self._source is not None and common is not None
        if not is_known or common is self._common:
            return
        assert common is not None
        assert self._source is not None
        self._common = common
        if common.start in self._source.settings:
            self._place(common)
            await self._draw()

    def _place(self, chosen: ChosenGains) -> None:
        """Set the sliders."""
        assert self._source is not None
        self._shown = chosen
        time_constant_s, damping, filter_s = chosen.setting or self._source.settings[chosen.start]
        self._is_placing = True
        self._start.set_value(chosen.start)
        self._speed.set_value(time_constant_s)
        self._damping.set_value(damping)
        self._filter.set_value(filter_s)
        self._is_placing = False
        self._author.set_text(f"set by {chosen.author}" if chosen.author else "")

    async def _draw(self) -> None:
        """Show the present setting; while one is computed and fetched, only the newest waits."""
        self._is_stale = True
        if self._is_drawing:
            return
        self._is_drawing = True
        try:
            while self._is_stale:
                self._is_stale = False
                await self._show_setting()
        finally:
            self._is_drawing = False

    async def _show_setting(self) -> None:
        """Compute the present setting, show its figures, and let the browser fetch its charts."""
        name, start, setting = str(self._choice.value), self._shown.start, self._shown.setting
        try:
            found = await self._views.explore(self._hold, name, start, setting)
        except (errors.CommandError, PoolFullError) as error:
            self._text.set_text(str(error))
            return
        self._explored = found
        self._command.set_text(found.command)
        self._table.columns = [
            {"name": head, "label": head, "field": head, "align": "right" if head else "left"}
            for head in ("", *found.heads)
        ]
        self._table.rows = [
            dict(zip(("", *found.heads), cells, strict=True)) for cells in found.rows
        ]
        self._table.update()
        self._show_trial()
        # `repr` keeps every digit: the charts are those that were made just now, for all viewers
        query = {"hold": self._hold, "name": name, "start": start}
        if setting is not None:
            query["setting"] = ",".join(repr(each) for each in setting)
        ids = {each: chart.id for each, chart in self._charts.items()}
        try:
            await ui.run_javascript(
                f"await membraneDrawCharts({json.dumps(ids)}, '/gains?{urlencode(query)}')",
                timeout=_FETCH_S,
            )
        except TimeoutError:
            return

    def _show_trial(self) -> None:
        """Show the gains of the hold, how long a trial lasts, and which buttons may be used."""
        seen = self._feed.seen
        status: dict[str, Any] = {} if seen.silent else seen.status
        gains = status.get("gains")
        left_s = status.get("trial_left_s")
        on_trial = left_s is not None and math.isfinite(left_s)
        words = f"the hold has {gains_words(gains, left_s)}" if gains else "no hold runs"
        self._trial.set_text(words)
        may = self._may_tune and status.get("state") in _STATES
        found = self._explored
        allowed = {
            self._try: may and found is not None and not found.refusal,
            self._keep: may and on_trial,
            self._back: may and on_trial,
        }
        saves = self._source is not None and self._source.takes_gains
        allowed[self._save] = (
            saves
            and role_includes(self._user.role, TRIES)
            and found is not None
            and not found.refusal
        )
        for button, is_allowed in allowed.items():
            if button.enabled != is_allowed:
                button.set_enabled(is_allowed)
        self._keep.set_visibility(on_trial)
        self._back.set_visibility(on_trial)

    @property
    def _may_tune(self) -> bool:
        return role_includes(self._user.role, TRIES) and role_includes(self._feed.seen.role, TRIES)

    async def _copy(self) -> None:
        ui.clipboard.write(self._command.text)
        show_message("Copied.")

    async def _save_gains(self) -> None:
        found = self._explored
        if found is None or not role_includes(self._user.role, TRIES):
            return
        name = str(self._choice.value)
        try:
            message = await self._views.save(self._hold, name, found.loop, self._user.name)
        except (errors.CommandError, PoolFullError) as error:
            show_message(str(error), good=False)
            return
        show_message(message, good=True)

    async def _try_gains(self) -> None:
        """Ask, and set the gains on trial."""
        found, minutes = self._explored, int(self._minutes.value)
        if found is None or found.refusal:
            return
        keys = ", ".join(f"{key} = {value:g}" for key, value in found.loop.items())
        lines = (
            f"{keys}.",
            self._trial.text.capitalize() + ".",
            f"The hold returns to its present gains after {minutes} min, and at once after a fault "
            "or with *Go back*, unless somebody keeps the new ones.",
        )
        if not await confirm("Try these gains on the hold?", lines, "Try them", "amber-5"):
            return
        await self._send({"do": "gains", "loop": found.loop, "value": 60.0 * minutes}, "tries")

    async def _keep_gains(self) -> None:
        lines = ("They stay until the end of this run; *Configuration* makes them permanent.",)
        if await confirm("Keep the gains that are on trial?", lines, "Keep them", "amber-5"):
            await self._send({"do": "keep"}, "keeps")

    async def _go_back(self) -> None:
        """End the trial: its time is over in a second."""
        await self._send({"do": "gains", "loop": {}, "value": _SHORTEST_TRIAL_S}, "ends the trial")

    async def _send(self, asked: dict[str, Any], does: str) -> None:
        if not self._may_tune:
            show_message(f"{asked['do']}: needs the role {TRIES}", good=False)
            return
        asked |= {"why": f"web: {self._user.name} {does}", "on_behalf": self._on_behalf()}
        await send_and_show(self._feed, asked)


class _Slider:
    """A slider with its title and value; of a decade scale, with the logarithm inside."""

    def __init__(self, title: str, is_time: bool, on_change: Callable[[], Any]) -> None:
        self._is_time = is_time
        with ui.row().classes("w-full justify-between no-wrap"):
            ui.label(title).classes("text-caption")
            self._label = ui.label().classes("text-caption text-no-wrap")
        self._slider = ui.slider(min=0, max=1, step=0.01).props(f'aria-label="{title}"')
        self._slider.on_value_change(self._show)
        self._slider.on_value_change(on_change)

    @property
    def value(self) -> float:
        """What it is set to."""
        inside = float(self._slider.value or 0.0)
        return float(10.0**inside) if self._is_time else inside

    def set_value(self, value: float) -> None:
        """Set it."""
        self._slider.set_value(math.log10(value) if self._is_time else value)
        self._show()

    def set_range(self, low: float, high: float) -> None:
        """Set what it reaches."""
        ends = (math.log10(low), math.log10(high)) if self._is_time else (low, high)
        # with a colon they are numbers: as texts, 16 is less than 2
        self._slider.props(f":min={ends[0]:.4f} :max={ends[1]:.4f}")

    def _show(self) -> None:
        self._label.set_text(f"{self.value:.2g} s" if self._is_time else f"{self.value:.1f}")
