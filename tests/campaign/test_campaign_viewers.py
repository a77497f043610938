"""A hold with its page, fifty viewers, one a real Chromium, and one that has stopped reading:
nobody notices.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from tests.studies import viewers
from tests.support.browser import browser_tab
from tests.support.figures import at_most, show
from tests.support.machine_needs import needs

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.campaign,
    pytest.mark.timeout(900),
    needs("chromium"),
]
# the error changes with every update; kept over a reload of the page, which a browser does that was
# hung up on
WATCHED = """sessionStorage.loads = +(sessionStorage.loads || 0) + 1;
new MutationObserver(changes => {
  const field = document.querySelector('[data-field=error_um]');
  if (field && changes.some(change => field.contains(change.target)))
    sessionStorage.seen = [sessionStorage.seen, Date.now()].filter(Boolean).join();
}).observe(document, {childList: true, subtree: true, characterData: true})"""


class Chromium:
    """A browser on the page: the longest times without an update, and how often it loaded the page,
    of each cycle.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.gaps_s: list[float] = []
        self.loads: list[int] = []
        self._opened = 0
        self._open, self._over = threading.Event(), threading.Event()

    @contextmanager
    def opened(self, link: str) -> Iterator[None]:
        self._open.clear()
        self._over.clear()
        self._opened += 1
        thread = threading.Thread(target=lambda: asyncio.run(self._look(link)))
        thread.start()
        try:
            assert self._open.wait(180.0)
            yield
        finally:
            self._over.set()
            thread.join()

    async def _look(self, link: str) -> None:
        async with browser_tab(link, self._folder / f"profile{self._opened}") as tab:
            await tab.call("Page.enable")
            await tab.call("Page.addScriptToEvaluateOnNewDocument", source=WATCHED)
            await tab.show_as(1500, 1000)
            await tab.until("sessionStorage.seen")
            self._open.set()
            await asyncio.to_thread(self._over.wait)
            seen_ms = await tab.value("[...sessionStorage.seen.split(','), Date.now()].map(Number)")
            self.loads.append(int(await tab.value("+sessionStorage.loads")))
            self.gaps_s.append(float(np.diff(seen_ms).max()) / 1e3)


def test_fifty_viewers_and_a_stalled_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTEST_CURRENT_TEST")  # NiceGUI looks for it
    chromium = Chromium(tmp_path)
    figures = viewers.measure_viewers(viewers.VIEWERS - 1, 2, chromium.opened)
    gap = at_most("longest time without an update, Chromium", max(chromium.gaps_s), "s", 5.0)
    loads = at_most("pages that Chromium loaded", sum(chromium.loads), "", 2, "cycles", 2)
    show("viewers", [*figures, gap, loads])
    late, missed, *_, lost, kept, _, grown_mb = figures
    assert len(chromium.gaps_s) == 2
    assert late.reference_value is not None
    assert late.value < max(2 * late.reference_value, 5.0)
    assert missed.value <= max(
        3 * (missed.reference_value or 0.0), 0.01 * 100 * viewers.PHASE_S
    )  # 1 % of the ticks
    assert lost.met
    assert kept.met
    assert grown_mb.met
