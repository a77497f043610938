"""Twenty holds, their page in a real Chromium, and `ctl fleet`: both stay usable, and no tick is
touched.

The holds run in slowed time (tests/worlds/slowed_holds.py), a quarter of the real one: two
processors have no room for twenty at 50 Hz with all their processes. Page, browser and terminal are
real, and as fast as ever.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.support.browser import Tab, browser_tab
from tests.support.figures import Figure, at_most, show
from tests.support.machine_needs import needs
from tests.web.test_page import served
from tests.worlds.fleet_file import fleet_file
from tests.worlds.slowed_holds import slowed_holds

pytestmark = [pytest.mark.real_time, pytest.mark.campaign, needs("chromium")]
NAMES = [f"mirror{number}" for number in range(20)]
SLOWNESS, RATE_HZ = 4.0, 50.0
SETTLES_S, PHASE_S, CYCLES = 90.0, 30.0, 2
ROWS = "[...document.querySelectorAll('tbody tr')].map(r => r.innerText)"
# errors change all the time, and so does the table
WATCHED = """window.seen = [performance.now()];
new MutationObserver(() => window.seen.push(performance.now()))
  .observe(document.querySelector('tbody'), {childList: true, subtree: true, characterData: true})"""  # noqa: E501


def ctl(*words: object) -> tuple[int, list[str], float]:
    """Exit code and lines of `ctl`, and how long it took, s."""
    begin_s = time.monotonic()
    command = [sys.executable, "-m", "membrane_ctrl", "ctl", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout.splitlines(), time.monotonic() - begin_s


@dataclass
class Phase:
    """A part of the holds' time, and what page and terminal took in it."""

    from_s: float = field(default_factory=time.time)
    page_cpu_s: float = 0.0
    page_gap_s: float = 0.0
    fleet_s: float = 0.0


@asynccontextmanager
async def opened(folder: Path, file: Path) -> AsyncIterator[tuple[psutil.Process, Tab]]:
    """The page, and a browser in which it shows that all hold."""
    before = set(psutil.Process().children())
    async with served(folder, "--fleet", str(file)) as link:
        (page,) = set(psutil.Process().children()) - before
        async with browser_tab(link, folder / f"profile{time.time():.0f}") as tab:
            await tab.until(f"{ROWS}.filter(r => r.includes('hold')).length === {len(NAMES)}")
            yield page, tab


async def looked_at(file: Path, page: psutil.Process, tab: Tab) -> Phase:
    """A phase in which a browser shows the page, and a terminal lists the fleet."""
    await tab.value(WATCHED)
    phase, before = Phase(), page.cpu_times()
    code, lines, phase.fleet_s = await asyncio.to_thread(ctl, "fleet", file)
    assert (code, [line.split()[:2] for line in lines]) == (0, [[name, "hold"] for name in NAMES])
    await asyncio.sleep(max(0.0, phase.from_s + PHASE_S - time.time()))
    after = page.cpu_times()
    phase.page_cpu_s = after.user + after.system - before.user - before.system
    phase.page_gap_s = (
        float(np.diff(await tab.value("[...window.seen, performance.now()]")).max()) / 1e3
    )
    return phase


async def used(folder: Path, file: Path, tab: Tab, holds: subprocess.Popen[str]) -> None:
    """One mirror is paused on the page, one driven by hand from a terminal, one ends and begins
    again; no other.
    """
    await tab.value(
        "[...document.querySelectorAll('a')].find(a => a.innerText === 'mirror7').click()"
    )
    await tab.until(
        "location.search === '?hold=mirror7' && document.body.innerText.includes('mirror7 2')"
    )
    pause = "[...document.querySelectorAll('button')].find(b => b.innerText.includes('Pause'))"
    await tab.until(f"!{pause}.disabled")
    await tab.value(f"{pause}.click()")
    await tab.click("Do it")
    await tab.until("document.body.innerText.includes('pause: done')")
    socket = folder / "mirror3" / "control.sock"
    assert (await asyncio.to_thread(ctl, "manual", 1.2, "--socket", socket))[0] == 0
    order(holds, "end mirror19")
    await tab.until(f"{ROWS}.some(r => r.startsWith('mirror19') && r.includes('no contact'))")
    await tab.until(f"{ROWS}.some(r => r.startsWith('mirror3') && r.includes('manual'))")
    await tab.screenshot(folder / "fleet.png")
    code, lines, _ = await asyncio.to_thread(ctl, "fleet", file)
    line_of = dict(zip(NAMES, lines, strict=True))
    assert code == 4
    assert "no contact" in line_of["mirror19"]
    assert "manual" in line_of["mirror3"]
    others = [
        line.split()[1]
        for name, line in line_of.items()
        if name not in ("mirror3", "mirror7", "mirror19")
    ]
    assert others == ["hold"] * 17
    order(holds, "begin mirror19")
    await tab.until(f"{ROWS}.some(r => r.startsWith('mirror19') && r.includes('hold'))")


def order(holds: subprocess.Popen[str], line: str) -> None:
    assert holds.stdin is not None
    holds.stdin.write(f"{line}\n")
    holds.stdin.flush()


def figures(folder: Path, phases: dict[bool, list[Phase]]) -> list[Figure]:
    """Of all holds together; of one that began twice, its first run."""
    late_ms: dict[bool, list[float]] = {True: [], False: []}
    missed = {True: 0, False: 0}
    for name in NAMES:
        at_s, late, lost = np.load(min((folder / name).glob("*/ticks.npy"))).T
        for seen, part in phases.items():
            for phase in part:
                within = (at_s >= phase.from_s) & (at_s < phase.from_s + PHASE_S)
                late_ms[seen].extend(late[within])
                missed[seen] += int(np.ptp(lost[within]))
    alone, beside = (np.array(late_ms[seen]) * SLOWNESS for seen in (False, True))
    watched = phases[True]
    return [
        at_most("ticks", beside.size, "", None, "no page", alone.size),
        at_most(
            "tick lateness p99",
            np.percentile(beside, 99),
            "ms",
            None,
            "no page",
            np.percentile(alone, 99),
        ),
        at_most("tick lateness, worst", beside.max(), "ms", None, "no page", alone.max()),
        at_most("ticks missed", missed[True], "", 0, "no page", missed[False]),
        at_most(
            "longest time without a new table", max(phase.page_gap_s for phase in watched), "s", 5.0
        ),
        at_most(
            "processor of the page",
            100 * max(phase.page_cpu_s for phase in watched) / PHASE_S,
            "%",
            50.0,
        ),
        at_most(
            "`ctl fleet`, its start included", max(phase.fleet_s for phase in watched), "s", 10.0
        ),
    ]


async def test_twenty_holds_are_watched_and_used(tmp_path: Path) -> None:
    file = fleet_file(tmp_path, *NAMES)
    phases: dict[bool, list[Phase]] = {False: [], True: []}
    with slowed_holds(tmp_path, SLOWNESS, NAMES) as holds:
        await asyncio.sleep(SETTLES_S)
        for cycle in range(CYCLES):
            phases[False].append(Phase())
            await asyncio.sleep(PHASE_S)
            async with opened(tmp_path, file) as (page, tab):
                phases[True].append(await looked_at(file, page, tab))
                if cycle == CYCLES - 1:
                    await used(tmp_path, file, tab, holds)
    found = figures(tmp_path, phases)
    show("fleet", found)
    ticks, _, _, missed, _, cpu, _ = found
    assert ticks.value >= 0.9 * len(NAMES) * CYCLES * PHASE_S * RATE_HZ / SLOWNESS
    assert missed.value <= max(3 * (missed.reference_value or 0.0), 0.01 * ticks.value)
    assert cpu.met
