"""The sliders in a real browser: what gains would do, a trial on the hold, and gains saved."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest

from membrane_ctrl.controller.command_event import make_command_event
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.web.gains_views import parse_setting
from tests.hold.test_page_service import services_of
from tests.support.browser import Tab, browser_tab
from tests.support.machine_needs import needs
from tests.web.test_page import FITS, PRESS, served
from tests.worlds.designed_session import make_designed_session
from tests.worlds.port_run import PortRun, keep_ticking, port_run
from tuning import gains_file

CHARTS = ("open loop", "responses", "sensitivity and spectrum", "Nyquist plot")
COMMAND = "[...document.querySelectorAll('div')].find(d => d.children.length === 0 && d.innerText.startsWith('membrane-ctrl ctl gains')).innerText"  # noqa: E501
CHART = (
    "getElement(+document.querySelector('[aria-label=\"{}\"] canvas')"
    ".closest('[id^=c]').id.slice(1)).chart.getOption()"
)
SPEED = "response, closed-loop time constant: fast to slow"


def slider(title: str) -> str:
    """The part of a slider that takes keys."""
    return f'document.querySelector(\'[aria-label="{title}"] [tabindex="0"]\')'


async def shown_loop(tab: Tab) -> dict[str, float]:
    """The gains of the command that the page shows."""
    text = str(await tab.until(COMMAND))
    return dict(json.loads(text.partition("'")[2].rstrip("'")))


async def _until_asked(run: PortRun, count: int) -> None:
    while len(run.asked) < count:  # noqa: ASYNC110
        await asyncio.sleep(0.1)


async def until_loop(tab: Tab, before: dict[str, float]) -> dict[str, float]:
    async with asyncio.timeout(60.0):
        while (found := await shown_loop(tab)) == before:  # noqa: ASYNC110
            await asyncio.sleep(0.2)
    return found


async def until_shown(tab: Tab, wanted: dict[str, float]) -> None:
    async with asyncio.timeout(60.0):
        while await shown_loop(tab) != wanted:  # noqa: ASYNC110
            await asyncio.sleep(0.2)


@pytest.mark.parametrize("text", ["1,2", "1,2,nan", "1,2,-3", "a,b,c", "1,2,3,4", "inf,1,1"])
def test_a_setting_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"three|convert"):
        parse_setting(text)
    assert parse_setting("") is None
    assert parse_setting("1,2,3") == (1.0, 2.0, 3.0)


@needs("chromium")
@pytest.mark.real_time
async def test_gains_are_explored_tried_and_saved(tmp_path: Path) -> None:
    session = await asyncio.to_thread(make_designed_session, tmp_path)
    async with port_run(tmp_path) as run, served(tmp_path) as link:
        ticks = asyncio.create_task(keep_ticking(run))
        place = f"&tab=tune&gains=tuning/{session.name}"
        try:
            async with browser_tab(link + place, tmp_path / "profile") as tab:
                proposed = await shown_loop(tab)
                saved = gains_file.load_gains(session / "gains.toml").loop
                assert proposed["kp_per_s"] == pytest.approx(saved.kp_per_s, rel=1e-3)
                table = "document.querySelector('[aria-label=\"figures of the gains\"]').innerText"
                for words in ("present", "proposed", "yours", "phase margin", "load peak"):
                    assert words in await tab.until(table)
                for name in CHARTS:
                    await tab.until(f"{CHART.format(name)}.series.every(s => s.data.length > 50)")
                labels = f"{CHART.format('open loop')}.series.flatMap(s => s.markLine?.data ?? []).map(d => d[0]?.label?.formatter).join()"  # noqa: E501
                assert "phase margin" in await tab.value(labels)
                assert "gain margin" in await tab.value(labels)
                # the keyboard moves a slider
                await tab.value(f"{slider(SPEED)}.focus()")
                await tab.press(*["ArrowRight"] * 10)
                slower = await until_loop(tab, proposed)
                await asyncio.sleep(3.0)
                slower = await shown_loop(tab)
                assert slower["kp_per_s"] < proposed["kp_per_s"]
                assert slower["ti_s"] > proposed["ti_s"]
                await tab.screenshot(tmp_path / "gains.png")
                # a second viewer sees the same, and moves the sliders of the first
                async with browser_tab(link + place, tmp_path / "other") as other:
                    assert await shown_loop(other) == slower
                    assert "set by link" in await other.value("document.body.innerText")
                    await other.value(f"{slider(SPEED)}.focus()")
                    await other.press(*["ArrowRight"] * 5)
                    await until_loop(other, slower)
                    await asyncio.sleep(3.0)
                    slower = await shown_loop(other)
                    await until_shown(tab, slower)
                # a reload keeps them
                await tab.show_as(1500, 1000)
                assert await shown_loop(tab) == slower
                for name in CHARTS:
                    await tab.until(f"{CHART.format(name)}.series.every(s => s.data.length > 50)")
                # the charts are there again after another tab
                await tab.value(f"{PRESS.format('NOW')}; 0")
                await tab.until("!document.querySelector('[aria-label=\"Nyquist plot\"]')")
                await tab.value(f"{PRESS.format('TUNE')}; 0")
                for name in CHARTS:
                    await tab.until(f"{CHART.format(name)}.series.every(s => s.data.length > 50)")
                assert await shown_loop(tab) == slower
                # on trial
                await tab.click("scienceTry on the hold")
                await tab.until("!!document.querySelector('.q-dialog')")
                assert run.asked == [], "nothing is sent before the confirmation"
                await tab.click("Try them")
                await tab.until("document.body.innerText.includes('gains: done')")
                (command,) = run.asked
                assert (command.kind, command.value) == ("gains", 300.0)
                assert command.loop is not None
                assert command.loop.kp_per_s == slower["kp_per_s"]
                assert command.loop.measurement_filter_s == slower["measurement_filter_s"]
                run.tick((make_command_event(command, ""),))
                await tab.until("document.body.innerText.includes('on trial, reverted in')")
                await tab.screenshot(tmp_path / "trial.png")
                await tab.click("undoGo back")
                await asyncio.wait_for(_until_asked(run, 2), 60.0)
                back = run.asked[1]
                assert (back.kind, back.value, back.loop) == ("gains", 1.0, run.loop)
                await tab.click("done_allKeep them")
                await tab.until("!!document.querySelector('.q-dialog')")
                await tab.click("Cancel")
                # saved
                await tab.click("saveSave into the session")
                await tab.until("document.body.innerText.includes('Saved. Next:')")
                made = gains_file.load_gains(session / "gains.toml")
                assert (made.loop.kp_per_s, made.author) == (slower["kp_per_s"], "link")
                await tab.show_as(390, 844)
                await tab.until(f"{PRESS.format('TUNE')}, true")
                await tab.until(COMMAND)
                await tab.until(FITS)
        finally:
            ticks.cancel()


@pytest.mark.real_time
def test_the_command_opens_the_page_on_a_session(tmp_path: Path) -> None:
    drop = {"PYTEST_CURRENT_TEST", "DISPLAY", "WAYLAND_DISPLAY"}
    env = {name: value for name, value in os.environ.items() if name not in drop}
    session = make_designed_session(tmp_path)
    words = [sys.executable, "-m", "membrane_ctrl", "tune", "explore"]

    def explore(path: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*words, str(path)], capture_output=True, text=True, env=env, check=False
        )

    refused = explore(tmp_path)
    assert refused.returncode == Exit.BAD_INPUT
    assert services_of(tmp_path) == []
    try:
        for _ in range(2):
            done = explore(session)
            assert done.returncode == Exit.DONE, done.stderr
            query = parse_qs(urlsplit(done.stdout.strip()).query)
            assert query["tab"] == ["tune"]
            assert query["gains"] == [f"tuning/{session.name}"]
            assert query["key"]
            (service,) = services_of(tmp_path)
            # the link's key is changed for a cookie; the tab stays in the address
            with httpx.Client(timeout=60.0) as browser:
                admitted = browser.get(done.stdout.strip())
                place = parse_qs(urlsplit(admitted.headers["location"]).query)
                assert place == {"tab": query["tab"], "gains": query["gains"]}
    finally:
        for service in services_of(tmp_path):
            service.kill()
            service.wait(30.0)
