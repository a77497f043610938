"""The tab in which a configuration is edited: its text, the help of its keys, check, save, restart.

Only the role `tune` sees it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from nicegui import ui

from membrane_ctrl.config.reference import Key, TableHelp, list_tables
from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import errors
from membrane_ctrl.service.access import STOP, request
from membrane_ctrl.service.configuration_editor import (
    CheckedText,
    ConfigurationEditor,
    ConfigurationText,
)
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_restart import begin_restart
from membrane_ctrl.service.hold_starter import HoldStarter, find_name_of_run
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import CONFIGURATIONS, RUN_LISTS
from membrane_ctrl.web.confirmation import confirm
from membrane_ctrl.web.messages import show_message

EDITS: Role = "tune"
_KEYS_MOST = 30


class ConfigurationPanel:
    """The elements of the tab.

    Parameters
    ----------
    feed : HoldFeed
        Of the hold that a restart stops.
    user : WebUser
        Needs the role `EDITS`.
    editor : ConfigurationEditor
        Reads, checks and saves the files.
    starter : HoldStarter
        Starts the hold again with what was saved.
    on_behalf : callable
        Returns who asks, for the stop before a restart.
    """

    def __init__(
        self,
        feed: HoldFeed,
        user: WebUser,
        editor: ConfigurationEditor,
        starter: HoldStarter,
        on_behalf: Callable[[], dict[str, str]],
    ) -> None:
        self._feed = feed
        self._user = user
        self._editor = editor
        self._starter = starter
        self._on_behalf = on_behalf
        self._loaded: ConfigurationText | None = None
        with ui.row().classes("items-end w-full"):
            self._choice = ui.select([], label="configuration", on_change=self._load)
            self._choice.style("min-width: 12rem").props('aria-label="configuration to edit"')
            self._new = ui.input("save under another name").props('aria-label="new name"')
            self._new.style("min-width: 14rem")
        with ui.row().classes("w-full items-start no-wrap max-lg:flex-wrap"):
            with ui.column().classes("col-grow min-w-0"):
                self._text = ui.codemirror("", language="TOML", line_wrapping=True)
                self._text.classes("w-full").style("height: 32rem")
                self._build_buttons()
                self._findings = ui.column().classes("gap-0 w-full").props('role="status"')
            with ui.column().style("width: 26rem; max-width: 100%"):
                self._build_help()

    async def load_list(self) -> None:
        """List the configurations; keeps what is being edited, else shows that of the newest run,
        which has its name.
        """
        try:
            listed = await RUN_LISTS.run(self._starter.list_configurations)
        except PoolFullError as error:
            show_message(str(error), good=False)
            return
        names = [each.name for each in listed if each.file is not None]
        chosen = find_name_of_run(self._feed.seen.name, names) or next(iter(names), None)
        if self._choice.value in names:
            chosen = self._choice.value
        self._choice.set_options(names, value=chosen)

    def _build_buttons(self) -> None:
        with ui.row():
            ui.button("Check", icon="rule", on_click=self._check).props("no-caps outline")
            ui.button("Save", icon="save", on_click=self._save).props("no-caps")
            restart = ui.button(
                "Save and restart", icon="restart_alt", on_click=self._confirm_restart
            )
            restart.props("no-caps color=deep-orange-9")

    def _build_help(self) -> None:
        search = ui.input("key or table, such as kp_per_s").classes("w-full")
        search.props('clearable aria-label="search the keys"')
        self._help = ui.column().classes("gap-1 w-full")
        search.on_value_change(lambda event: self._show_help(str(event.value or "")))
        self._show_help("")

    def _show_help(self, wanted: str) -> None:
        """Show the keys whose name has the wanted text, or the tables without one."""
        self._help.clear()
        with self._help:
            if not wanted.strip():
                for table in list_tables():
                    _show_table(table)
                return
            found = find_keys(wanted)
            for table, key in found[:_KEYS_MOST]:
                _show_key(table, key)
            if not found:
                ui.label("no such key")

    async def _load(self) -> None:
        name = str(self._choice.value or "")
        if not name or (self._loaded is not None and self._loaded.name == name):
            return
        found = await self._run(self._editor.read, name)
        if isinstance(found, ConfigurationText):
            self._loaded = found
            self._text.set_value(found.text)
            self._findings.clear()

    @property
    def _name(self) -> str:
        return str(self._new.value or "").strip() or str(self._choice.value or "")

    async def _check(self) -> bool:
        """Check the text and show the findings; whether a hold would accept it."""
        checked = await self._run(self._editor.check, self._name, self._text.value)
        if not isinstance(checked, CheckedText):
            return False
        self._findings.clear()
        with self._findings:
            for line in checked.errors:
                ui.label(line).classes("text-negative").style("overflow-wrap: anywhere")
            for line in checked.warnings:
                ui.label(line).classes("text-warning").style("overflow-wrap: anywhere")
            if checked.is_usable:
                ui.label("can be used; devices are checked at the start of a hold")
        return checked.is_usable

    async def _save(self) -> bool:
        """Save the text if it passes the check."""
        if not role_includes(self._user.role, EDITS) or not await self._check():
            return False
        name = self._name
        same = self._loaded is not None and self._loaded.name == name
        digest = self._loaded.digest if same and self._loaded is not None else ""
        saved = await self._run(self._editor.save, name, self._text.value, digest, self._user.name)
        if not isinstance(saved, ConfigurationText):
            return False
        self._loaded = saved
        self._new.set_value("")
        show_message(f"{name}: saved; the former file is in former/", good=True)
        await self.load_list()
        self._choice.set_value(name)
        return True

    async def _confirm_restart(self) -> None:
        """Ask, save, stop the hold, and start it again."""
        does = (
            "The running hold ends and the pump stops; then the next one checks its devices, "
            "inflates the mirror and holds it."
        )
        title = f"Save {self._name} and restart?"
        is_sure = await confirm(title, (does,), "Save and restart", "deep-orange-9")
        if not is_sure or not await self._save():
            return
        assert self._loaded is not None
        stop = request(STOP, f"web: {self._user.name} restarts with {self._loaded.name}", "")
        stop["on_behalf"] = self._on_behalf()
        await self._restart(self._loaded.name, stop)

    async def _restart(self, name: str, stop: dict[str, Any]) -> None:
        """Restart the hold; show why it failed."""
        try:
            restart = await begin_restart(self._feed, self._starter, name, self._user.name, stop)
        except (errors.InputError, PoolFullError) as error:
            show_message(f"{name} is saved, but the hold is not restarted: {error}", good=False)
            return
        show_message("Restarting; the state is above.")
        outcome = await asyncio.shield(restart)
        if not outcome.done and not self._findings.is_deleted:
            with self._findings:
                ui.label(outcome.text).classes("text-negative")

    async def _run(self, function: Callable[..., object], *arguments: object) -> object:
        """Call a function of the editor on its thread; shows why it failed and returns None."""
        try:
            return await CONFIGURATIONS.run(function, *arguments)
        except errors.CommandError as error:
            show_message("; ".join(error.lines), good=False)
        except PoolFullError as error:
            show_message(str(error), good=False)
        return None


def find_keys(wanted: str) -> list[tuple[TableHelp, Key]]:
    """Return the keys whose name, or whose table's name, contains a text."""
    text = wanted.strip().strip("[]").lower()
    return [
        (table, key)
        for table in list_tables()
        for key in table.keys
        if any(text in f"{place}.{key.name}" for place in (*table.places, table.driver))
    ]


def _show_table(table: TableHelp) -> None:
    """Show a table of the configuration; a click opens its keys."""
    with ui.expansion(table.title).classes("w-full").props("dense") as keys:
        ui.label(table.meaning).classes("text-caption")

        place = ui.column().classes("gap-0")

    def fill() -> None:
        """Show the keys once somebody looks: there are three hundred."""
        if keys.value and not place.default_slot.children:
            with place:
                for key in table.keys:
                    _show_key(table, key)

    keys.on_value_change(fill)


def _show_key(table: TableHelp, key: Key) -> None:
    """Show a key: unit, range and default, what it means, and when to change it."""
    with ui.column().classes("gap-0 q-mb-sm"):
        ui.label(f"{key.name}").classes("text-bold").tooltip(table.title)
        facts = [f"[{each}]" for each in table.places[:1]]
        facts += [part for part in (key.unit, key.range, f"default {key.default}") if part]
        ui.label("; ".join(facts).replace("`", "")).classes("text-caption")
        ui.label(f"{key.meaning} {key.advice}")
