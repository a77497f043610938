"""What each role may do with the page: every button is pressed, also those that a browser does not
offer, and every dialog is confirmed.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

import pytest
from nicegui import Client, core, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments, handle_event
from nicegui.page import page

from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_starter import HoldStarter, StartOptions
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.web.page import WebPage
from membrane_ctrl.web.shared_views import FIRST_FIGURE, HEIGHT, SharedViews
from tests.worlds.designed_session import make_designed_session
from tests.worlds.port_run import PortRun, keep_ticking, port_run
from tests.worlds.sound_figure import SOUND_FIGURE

# the least role of each button; those of tune are not built, or disabled, for others
BUTTONS: dict[str, Role] = {
    "dark_mode": "read",
    "help_outline": "read",
    "Refresh": "read",
    "Report": "read",  # writing one needs `operate`: `report_problem`
    "Report of this run": "read",
    "Open in Rerun": "read",
    "Copy the command": "read",
    "Start a hold": "operate",
    "Use this figure": "operate",
    "Mark": "operate",
    "Capture set": "operate",
    "Quiet alarms": "operate",
    "Hold": "operate",
    "Pause": "operate",
    "Resume": "operate",
    "Setpoint": "operate",
    "Manual flow": "operate",
    "Shape loop on": "operate",
    "Shape loop off": "operate",
    "Clear fault": "operate",
    "Unlock": "operate",
    "Lower": "operate",
    "Vent": "operate",
    "Lock": "operate",
    "STOP": "operate",
    "Keep gains": "tune",
    "Try on the hold": "tune",
    "Keep them": "tune",
    "Go back": "tune",
    "Save into the session": "tune",
    "Check": "tune",
    "Save": "tune",
    "Save and restart": "tune",
}
AGREES = ("Do it", "Start", "Try them", "Keep them", "Save and restart")
OF_OPERATE = {
    "hold",
    "pause",
    "resume",
    "setpoint",
    "manual",
    "shape_on",
    "shape_off",
    "mark",
    "capture",
    "ack",
    "lower",
    "vent",
    "latch",
    "unlock",
    "stop",
}
CONFIGURATION = "[loop]\nkp_per_s = 0.5\n"


class Starter(HoldStarter):
    """Starts nothing."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, folder / "configurations", units=False)
        self.started: list[str] = []

    def can_start(self) -> bool:
        return True

    def start_hold(self, name: str, who: str, options: StartOptions) -> Future[None]:
        self.started.append(name)
        done: Future[None] = Future()
        done.set_result(None)
        return done


@dataclasses.dataclass
class Viewer:
    """A page without a browser."""

    client: Client
    views: SharedViews
    starter: Starter
    run: PortRun

    def find(self, kind: type[Element]) -> list[Element]:
        return [each for each in self.client.elements.values() if isinstance(each, kind)]

    @property
    def buttons(self) -> list[ui.button]:
        return [each for each in self.find(ui.button) if isinstance(each, ui.button)]

    def fire(self, button: ui.button) -> None:
        """What a click does, also to a disabled button: a role may change while a dialog is
        open.
        """
        given = GenericEventArguments(sender=button, client=self.client, args={})
        for listener in list(button._event_listeners.values()):
            if listener.type == "click":
                handle_event(listener.handler, given)

    async def press(self, button: ui.button) -> None:
        """Click, and confirm the dialog that opens."""
        before = set(self.client.elements)
        self.fire(button)
        for _ in range(10):
            await asyncio.sleep(0.01)
        for each in list(self.client.elements.values()):
            if each.id not in before and isinstance(each, ui.input):
                each.set_value("1")
        for each in self.buttons:
            if each.id not in before and each.text in (*AGREES, "Close"):
                self.fire(each)
        for _ in range(10):
            await asyncio.sleep(0.01)


def _ignore_script(code: str, **_options: object) -> asyncio.Future[None]:
    """There is no browser."""
    done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    done.set_result(None)
    return done


async def until(true: Callable[[], object]) -> None:
    async with asyncio.timeout(120.0):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


@asynccontextmanager
async def viewer_of(folder: Path, role: Role) -> AsyncIterator[Viewer]:
    """The page of a hold with a figure, a tuning session and a configuration."""
    (folder / "configurations").mkdir()
    (folder / "configurations" / "lab.toml").write_text(CONFIGURATION)
    await asyncio.to_thread(make_designed_session, folder)
    before = asyncio.all_tasks()
    feed = HoldFeed(Where(logs=folder))
    starter = Starter(folder)
    views = SharedViews({"": feed})
    async with port_run(folder) as run:
        ticks = asyncio.create_task(keep_ticking(run))
        feed.open()
        client = Client(page("/"), request=None)
        client.run_javascript = _ignore_script  # type: ignore[method-assign]
        try:
            await until(lambda: not feed.seen.silent)
            feed.seen = dataclasses.replace(feed.seen, figure=SOUND_FIGURE)
            editor = ConfigurationEditor(folder / "configurations")
            user = WebUser("anna", role, has_login=True)
            with client:
                WebPage({"": feed}, "", user, views, starter, editor).build()
            yield Viewer(client, views, starter, run)
        finally:
            ticks.cancel()
            client.delete()
            await asyncio.to_thread(feed.close)
            starter.close()
            for task in asyncio.all_tasks() - before:  # such as what sends to the browser
                task.cancel()


async def open_tabs(viewer: Viewer) -> None:
    """Load what the tabs show, and explore the gains of the session."""
    (tabs,) = viewer.find(ui.tabs)
    assert isinstance(tabs, ui.tabs)
    names = [str(tab.props["name"]) for tab in viewer.find(ui.tab)]
    for name in names:
        tabs.set_value(name)
    save = next(each for each in viewer.buttons if each.text == "Save into the session")
    commands = [each for each in viewer.find(ui.label) if isinstance(each, ui.label)]
    await until(lambda: any("ctl gains" in each.text for each in commands))
    if any(each.text == "Save and restart" for each in viewer.buttons):
        (text,) = viewer.find(ui.codemirror)
        assert isinstance(text, ui.codemirror)
        await until(lambda: text.value == CONFIGURATION)
        text.set_value(CONFIGURATION + "# changed\n")
    assert not save.is_deleted


def label_of(button: ui.button) -> str:
    return button.text or str(button.props.get("icon", ""))


@pytest.mark.real_time
@pytest.mark.parametrize("role", ["read", "operate", "tune"])
async def test_every_button_needs_its_role(
    tmp_path: Path, role: Role, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(core, "loop", asyncio.get_running_loop())
    async with viewer_of(tmp_path, role) as viewer:
        await open_tabs(viewer)
        session = next((tmp_path / "tuning").iterdir())
        gains = (session / "gains.toml").read_text()
        shown = viewer.buttons
        unknown = {label_of(each).split(" 1")[0] for each in shown} - set(BUTTONS)
        assert not unknown, "state the role of each button here"
        for button in shown:
            needed = BUTTONS[label_of(button)]
            assert role_includes(role, needed) or button.is_ignoring_events, label_of(button)
        slider = next(each for each in viewer.find(ui.slider) if isinstance(each, ui.slider))
        slider.set_value(slider.value + 0.1)
        for button in shown:
            await viewer.press(button)
        # what was sent before has arrived once this has
        asked = {command.kind for command in viewer.run.asked}
        kept = set(viewer.views.list_references("")) - {FIRST_FIGURE, HEIGHT}
        if role == "read":
            assert not asked
            assert not kept
            assert not viewer.starter.started
        else:
            await until(lambda: {each.kind for each in viewer.run.asked} >= OF_OPERATE)
            assert kept
            assert viewer.starter.started
        find_chosen = partial(viewer.views.gains.find_chosen, "", f"tuning/{session.name}")
        file = tmp_path / "configurations" / "lab.toml"
        if role == "tune":
            await until(lambda: {"gains", "keep"} <= {each.kind for each in viewer.run.asked})
            await until(find_chosen)
            await until(lambda: "# changed" in file.read_text())
            await until(lambda: (session / "gains.toml").read_text() != gains)
        else:
            assert {each.kind for each in viewer.run.asked} <= OF_OPERATE
            assert find_chosen() is None, "others move the sliders for themselves alone"
            assert file.read_text() == CONFIGURATION
            assert (session / "gains.toml").read_text() == gains
