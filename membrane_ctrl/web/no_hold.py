"""What the page shows while no hold runs: how the newest run ended, and the start of a hold."""

from __future__ import annotations

from nicegui import ui

from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.model import errors
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_starter import (
    Configuration,
    HoldStarter,
    StartOptions,
    find_name_of_run,
)
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pools import RUN_LISTS
from membrane_ctrl.web.confirmation import confirm
from membrane_ctrl.web.messages import show_message
from membrane_ctrl.web.runs_panel import open_report

_LOOK_S = 1.0


class NoHoldPanel:
    """A card that is shown while no hold runs.

    Parameters
    ----------
    feed : HoldFeed
        Knows whether a hold runs, and how the newest run has ended.
    hold : str
        Name of the hold in addresses.
    user : WebUser
        Starting needs the role `operate`.
    starter : HoldStarter or None
        None: holds of this folder cannot be started here.
    """

    def __init__(
        self, feed: HoldFeed, hold: str, user: WebUser, starter: HoldStarter | None
    ) -> None:
        self._feed = feed
        self._hold = hold
        self._user = user
        self._starter = starter
        self._lines: tuple[str, ...] = ()
        self._listed: list[Configuration] = []
        with ui.card().classes("w-full").props('aria-label="no hold runs"') as self._card:
            self._text = ui.column().classes("gap-0")
            self._report = ui.button(
                "Report of this run", icon="description", on_click=self._open_report, color=None
            ).props("flat no-caps")
            if starter is not None:
                self._build_start()
        self._card.set_visibility(False)
        self._look()
        ui.timer(_LOOK_S, self._look)

    def _build_start(self) -> None:
        with ui.row().classes("items-center"):
            self._choice = ui.select([], label="configuration").style("min-width: 12rem")
            self._choice.props('aria-label="configuration"')
            self._standby = ui.checkbox("wait in standby")
            self._clear = ui.checkbox("clear latched faults")
            self._start = ui.button("Start a hold", icon="play_arrow", on_click=self._confirm)
            self._start.props("no-caps").set_enabled(role_includes(self._user.role, "operate"))
        self._failure = ui.label().classes("text-negative").props('role="alert"')
        ui.timer(0.1, self._list_configurations, once=True)

    async def _list_configurations(self) -> None:
        assert self._starter is not None
        self._listed = await RUN_LISTS.run(self._starter.list_configurations)
        labels = {each.name: _label(each) for each in self._listed}
        usable = [each.name for each in self._listed if not each.problem]
        of_run = find_name_of_run(self._feed.seen.name, usable)
        self._choice.set_options(labels, value=of_run or next(iter(usable), None))

    def _look(self) -> None:
        """Show the panel without a hold, and what is new."""
        seen = self._feed.seen
        self._card.set_visibility(bool(seen.problem))
        # the page's line on the state is the headline
        if seen.ended is not None:
            lines = seen.ended.lines()[1:]
        elif seen.name:
            lines = (f"waiting for the record of {seen.name}: how it ended, and why",)
        else:
            lines = ("no run in this folder yet",)
        self._report.set_visibility(seen.ended is not None)
        if self._starter is not None:
            self._failure.set_text(self._starter.failure)
        if lines == self._lines:
            return
        self._lines = lines
        self._text.clear()
        with self._text:
            for line in lines:
                ui.label(line).style("overflow-wrap: anywhere")

    async def _open_report(self) -> None:
        ended = self._feed.seen.ended
        if ended is not None:
            await open_report(ended.folder, self._hold, self._user)

    async def _confirm(self) -> None:
        """Ask, start, and show what became of it."""
        assert self._starter is not None
        name = str(self._choice.value or "")
        does = "The hold checks its devices, inflates the mirror and holds it."
        if self._standby.value:
            does = "The hold checks its devices and waits in standby."
        is_sure = await confirm(f"Start a hold with {name}?", (does,), "Start")
        if not is_sure or not role_includes(self._user.role, "operate"):
            return
        options = StartOptions(bool(self._standby.value), bool(self._clear.value))
        try:
            self._starter.start_hold(name, self._user.name, options)
        except errors.CommandError as error:
            show_message("; ".join(error.lines), good=False)
            return
        show_message(f"Starting a hold with {name}; it takes some seconds.")


def _label(configuration: Configuration) -> str:
    if configuration.problem:
        return f"{configuration.name} (cannot be used)"
    if configuration.has_devices:
        return configuration.name
    return f"{configuration.name} (simulated bench)"
