"""A configuration is edited in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.web.configuration_panel import find_keys
from tests.support.browser import Tab
from tests.support.machine_needs import needs
from tests.web.test_page import viewed

TEXT = "[loop]\nkp_per_s = 0.5\n"
EDITOR = "getElement(+document.querySelector('.cm-editor').closest('[id^=c]').id.slice(1)).editor"


def test_keys_are_found_by_name_table_and_driver() -> None:
    assert {key.name for _, key in find_keys("kp_per")} == {"kp_per_s"}
    assert "ti_s" in {key.name for _, key in find_keys("[loop]")}
    assert find_keys("no_such_key") == []


async def click(tab: Tab, label: str) -> None:
    await tab.value(
        "[...document.querySelectorAll('button, .q-tab')].find("
        f"b => b.innerText.trim().toLowerCase().endsWith('{label}')).click()"
    )


@needs("chromium")
@pytest.mark.real_time
async def test_a_configuration_is_checked_before_it_is_saved(tmp_path: Path) -> None:
    folder = tmp_path / "configurations"
    folder.mkdir()
    (folder / "lab.toml").write_text(TEXT)
    logs = tmp_path / "logs"
    logs.mkdir()
    async with viewed(logs, "--configurations", str(folder)) as (_, tab):
        await click(tab, "configuration")
        await tab.until("document.querySelector('.cm-content')?.innerText.includes('kp_per_s')")
        changed = "{changes: {from: 0, insert: '[loop\\n'}}"
        await tab.value(f"{EDITOR}.dispatch({changed})")
        await tab.until("document.querySelector('.cm-content').innerText.startsWith('[loop\\n')")
        await click(tab, "save")
        await tab.until("document.body.innerText.includes('not valid TOML')")
        assert (folder / "lab.toml").read_text() == TEXT
        await tab.value(f"{EDITOR}.dispatch({{changes: {{from: 0, to: 6, insert: '# slow\\n'}}}})")
        await click(tab, "save")
        await tab.until("document.body.innerText.includes('lab: saved')")
        assert (folder / "lab.toml").read_text() == f"# slow\n{TEXT}"
        await tab.value(
            "(() => { const i = document.querySelector('[aria-label=\"search the keys\"]');"
            "i.value = 'kp_per_s'; i.dispatchEvent(new Event('input')); })()"
        )
        await tab.until("document.body.innerText.includes('Proportional gain')")
        await tab.screenshot(tmp_path / "configuration.png")
