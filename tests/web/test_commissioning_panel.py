"""The guided session in a real browser: its questions survive a reload and are answered once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.browser import Tab, browser_tab
from tests.support.machine_needs import needs
from tests.web.test_page import served

_BUTTON = (
    "[...document.querySelectorAll('button, .q-tab, .q-checkbox')].find("
    "b => b.offsetParent && b.innerText.trim().toLowerCase().endsWith('{label}'))"
)


async def click(tab: Tab, label: str) -> None:
    button = _BUTTON.replace("{label}", label)
    await tab.until(f"!!{button}")
    await tab.value(f"{button}.click()")


async def wait_for_text(tab: Tab, text: str) -> None:
    await tab.until(f"document.body.innerText.includes({json.dumps(text)})")


@needs("chromium")
@pytest.mark.real_time
async def test_a_reload_shows_the_question_and_does_not_answer_it(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    sessions = tmp_path / "sessions"
    async with (
        served(logs, "--commissioning", str(sessions)) as link,
        browser_tab(link, tmp_path / "profile") as tab,
    ):
        await click(tab, "commission")
        await click(tab, "practise on the emulated bench")
        await click(tab, "begin or resume")
        await wait_for_text(tab, "Which mirror?")
        await click(tab, "choose")
        await wait_for_text(tab, "Change any of its data?")
        await tab.show_as(390, 844)  # reloads, on a phone
        await click(tab, "commission")
        await wait_for_text(tab, "Change any of its data?")
        wide = await tab.value("document.documentElement.scrollWidth")
        assert wide <= 390, "the page scrolls sideways on a phone"
        state = json.loads((sessions / "lab-1" / "session.json").read_text())
        assert state["answers"] == {"mirror.preset": "paper"}
        await click(tab, "stop safely, resume later")
        await click(tab, "stop the session")
        await wait_for_text(tab, "lab-1: stopped")
        await tab.screenshot(tmp_path / "stopped.png")
