"""Takes the pictures of README and documentation: `make pictures`, or `python -m
tests.support.pictures run-*`.

Needs a Vulkan driver (`apt-get install mesa-vulkan-drivers libvulkan1`) and, for report and page,
Chromium. Each picture is of a run made here: a hold of the twin in real time, a night with planted
events, a hold whose laser fails, sets of a screen bowed by 1 mm.
"""

from __future__ import annotations

import asyncio
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import cv2
import numpy as np

from firmware_iface.roles import BenchReading
from membrane_ctrl.model.arrays import AnyArray
from tests.support.browser import Tab, browser_tab
from tests.support.recording_picture import screenshot
from tests.support.review_runs import written
from tests.web.test_commissioning_panel import click, wait_for_text
from tests.web.test_page import PRESS, served
from tests.worlds.designed_session import make_designed_session
from tests.worlds.fleet_file import fleet_file
from tests.worlds.nights import DOOR, GLITCH, JUMP, LEAK, Planted
from tests.worlds.port_run import keep_ticking, port_run
from tests.worlds.slowed_holds import slowed_holds
from tests.worlds.virtual_record import kept_ticks, write_record

IMAGES = Path(__file__).parents[2] / "docs" / "images"
EXAMPLES = Path(__file__).parents[2] / "membrane_ctrl" / "examples"
_WIDTH_PX = 1280  # of a tab of the review, beside others on its page


def command(*arguments: object) -> None:
    """Run a command of the product; its output is on the terminal."""
    subprocess.run([sys.executable, "-m", "membrane_ctrl", *map(str, arguments)], check=True)


def run_pictures(folder: Path) -> dict[str, bytes]:
    """The recording of a hold as it opens, and its shapes."""
    command("hold", "--twin", "--duration", "5m", "--name", "run", "--logs", folder)
    run = next(folder.glob("*-run"))
    return {"run-overview": screenshot(run), "run-shape": screenshot(run, "Shape")}


def review_pictures(folder: Path) -> dict[str, bytes]:
    """The tabs of a night's review, and its report."""
    events = [
        Planted(DOOR, 2500.0, 20.0),
        Planted(LEAK, 4700.0, 60.0),
        Planted(GLITCH, 7000.0, 30.0),
        Planted(JUMP, 9000.0, 3.0),
    ]
    night = written(folder, 3.0, events)
    (night / "summary.json").unlink()
    command("repair", night, "--in-place")  # which makes one with all figures
    found = {f"review-{tab}": _tab(folder, night, "--tab", tab) for tab in ("overview", "shape")}
    parts = {"loop": ("--at", "+2500s"), "tuning": ("--from", "+30m", "--to", "+35m")}
    found |= {
        f"review-{tab}": _tab(folder, night, "--tab", tab, *part) for tab, part in parts.items()
    }
    command("report", night, "--out", folder / "report")
    return found | {"report": _page(folder / "report" / "report.html", 800, 3082)}


def catalogue_picture(folder: Path) -> dict[str, bytes]:
    """The table of some nights."""
    for day, hours in ((21, 0.5), (22, 1.0), (23, 0.2)):
        night = written(
            folder, hours, [Planted(DOOR, 500.0, 20.0)], day, f"202611{day}T180000Z-night"
        )
        (night / "summary.json").unlink()
        command("repair", night, "--in-place")
    return {"review-catalogue": _tab(folder, "--all", "--logs", folder)}


def faults_picture(folder: Path) -> dict[str, bytes]:
    """The review of a hold whose laser fails three times, at last for good."""

    def blind(now_s: float, reading: BenchReading) -> BenchReading:
        dark = 200.0 <= now_s < 201.0 or 400.0 <= now_s < 406.0 or now_s >= 700.0
        return replace(reading, displacement_um=np.nan, displacement_quality=1) if dark else reading

    run = folder / "20261121T180000Z-faults"
    run.mkdir()
    write_record(run, kept_ticks(900.0, blind))
    return {"review-faults": _tab(folder, run, "--tab", "faults")}


def tutorial_picture(folder: Path) -> dict[str, bytes]:
    """The review of the fault that the tutorial plays."""
    command("twin", "play", "laser_knocked", "--logs", folder)
    return {"tutorial-fault": _tab(folder, next(folder.glob("*-laser_knocked")))}


def bowed_picture(folder: Path) -> dict[str, bytes]:
    """Residuals of the calibration of a bowed screen, stated as flat."""
    bowed, flat = folder / "bowed.toml", folder / "flat.toml"
    numbers = "a_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = 80.9\n"
    bowed.write_text(f"[optics.geometry]\n{numbers}[optics.geometry.screen]\nbow_mm = 1.0\n")
    flat.write_text(f"[geometry]\n{numbers}")
    sets = [folder / str(place) for place in range(5)]
    for place, capture in enumerate(sets):
        command(
            "simulate",
            capture,
            "--config",
            bowed,
            "--stated",
            flat,
            "--shrink",
            2,
            "--displacement-um",
            1750 * (place - 2),
        )
    out = folder / "geometry.toml"
    refused = subprocess.run(
        [sys.executable, "-m", "membrane_ctrl", "calibrate", *sets, "--out", out], check=False
    )
    assert refused.returncode == 3
    return {"calibration-bowed-screen": (folder / "geometry-residuals.png").read_bytes()}


# a camera whose pictures are rendered in little time: its figures come also on a busy machine
_QUICK_OPTICS = """
[twin]
port = 0
[optics.camera]
width_px = 612
height_px = 512
pixel_um = 13.8
[shape]
mode = "cycle"
bin_px = 1
"""


def page_pictures(folder: Path) -> dict[str, bytes]:
    """The page of a hold, in a control room and on a phone, and the editor of configurations."""
    (folder / "lab.toml").write_text(_QUICK_OPTICS)
    configurations = folder / "configurations"
    configurations.mkdir()
    shutil.copy(EXAMPLES / "paper-bench.toml", configurations / "bench.toml")
    words = ["hold", "--twin", "--config", folder / "lab.toml", "--name", "night", "--logs", folder]
    none = subprocess.DEVNULL
    run = [sys.executable, "-m", "membrane_ctrl", *map(str, words)]
    hold = subprocess.Popen(run, stdin=none, stdout=none, stderr=none)
    try:
        return asyncio.run(_page_pictures(folder))
    finally:
        hold.send_signal(signal.SIGINT)
        hold.wait(120.0)


async def _page_pictures(folder: Path) -> dict[str, bytes]:
    socket, target = ("--socket", folder / "control.sock"), folder / "page.png"
    phone: list[AnyArray] = []
    options = ("--configurations", str(folder / "configurations"))
    async with served(folder, *options) as link, browser_tab(link, folder / "profile") as tab:
        for text, after_s in (("door opened", 90.0), ("lights off", 120.0)):
            await asyncio.sleep(after_s)
            await asyncio.to_thread(command, "ctl", "mark", text, *socket)
        await tab.show_as(1500, 1560)
        await asyncio.sleep(20.0)
        await tab.until("!document.body.innerText.includes('no figure yet')")
        # a busy machine delays the figures, and the hold reports it
        await tab.until("!document.querySelector('[role=alert]').innerText")
        await tab.screenshot(target, whole=False)
        room = await asyncio.to_thread(target.read_bytes)
        configuration = await _configuration_picture(tab, target)
        steps = (
            "",
            "document.querySelector('canvas').scrollIntoView()",
            PRESS.format("LOOK BACK"),
            PRESS.format("NOW"),
        )
        for dark, asked in ((False, steps[:2]), (True, steps[2:])):
            await tab.show_as(390, 844, dark)
            for step in asked:
                await asyncio.sleep(10.0)
                await tab.value(f"{step}; 0")
                if step == PRESS.format("LOOK BACK"):
                    await tab.until(
                        "document.querySelector('[role=tabpanel]').innerText.includes('night')"
                    )
                if step == PRESS.format("NOW"):
                    await tab.press("m")
                    await tab.until("document.body.innerText.includes('DO IT')")
                await asyncio.sleep(5.0)
                await tab.screenshot(target, whole=False)
                phone += [cv2.imread(str(target)), np.full((844, 20, 3), 255, np.uint8)]
    return {
        "web": room,
        "web-phone": cv2.imencode(".png", np.hstack(phone[:-1]))[1].tobytes(),
        "web-configuration": configuration,
    }


async def _configuration_picture(tab: Tab, target: Path) -> bytes:
    """The editor with a gain changed, its check, and the help of the key."""
    await tab.show_as(1500, 1000)
    await tab.value(f"{PRESS.format('CONFIGURATION')}; 0")
    await tab.until("document.querySelector('.cm-content')?.innerText.length > 20")
    await tab.value(
        "(() => { const field = document.querySelector('[aria-label=\"search the keys\"]');"
        "field.value = 'kp_per_s'; field.dispatchEvent(new Event('input')); })()"
    )
    await tab.until("document.body.innerText.includes('Proportional gain')")
    await tab.click("ruleCheck")
    await tab.until("document.body.innerText.includes('can be used')")
    await asyncio.sleep(3.0)
    await tab.screenshot(target, whole=False)
    await tab.value(f"{PRESS.format('NOW')}; 0")
    return await asyncio.to_thread(target.read_bytes)


def commission_picture(folder: Path) -> dict[str, bytes]:
    """A stage of the guided session in the page."""
    return {"web-commission": asyncio.run(_commission_picture(folder))}


async def _commission_picture(folder: Path) -> bytes:
    (folder / "logs").mkdir()
    target = folder / "commission.png"
    async with (
        served(folder / "logs", "--commissioning", str(folder / "sessions")) as link,
        browser_tab(link, folder / "profile") as tab,
    ):
        for label in ("commission", "practise on the emulated bench", "begin or resume"):
            await click(tab, label)
        await wait_for_text(tab, "Which mirror?")
        await click(tab, "choose")
        await wait_for_text(tab, "Change any of its data?")
        await tab.click("No")
        await wait_for_text(tab, "none is fitted")
        await tab.click("Enter")
        await wait_for_text(tab, "How does the camera see the mirror?")
        await click(tab, "choose")
        await wait_for_text(tab, "What drives the pump?")
        await tab.screenshot(target, whole=False)
    return target.read_bytes()


def tune_picture(folder: Path) -> dict[str, bytes]:
    """The sliders of the tab *Tune*, on a session with made-up data."""
    return {"tune-explore": asyncio.run(_tune_picture(folder))}


async def _tune_picture(folder: Path) -> bytes:
    session = await asyncio.to_thread(make_designed_session, folder)
    target = folder / "tune.png"
    async with port_run(folder) as run, served(folder) as link:
        ticks = asyncio.create_task(keep_ticking(run))
        place = f"{link}&tab=tune&gains=tuning/{session.name}"
        async with browser_tab(place, folder / "profile", 1500, 1640) as tab:
            await tab.until("document.body.innerText.includes('membrane-ctrl ctl gains')")
            slider = 'document.querySelector(\'[aria-label^="response"] [tabindex="0"]\')'
            await tab.value(f"{slider}.focus()")
            for _ in range(25):
                await tab.press("ArrowRight")
            await asyncio.sleep(10.0)
            await tab.value(f"{slider}.blur()")
            await tab.screenshot(target, whole=False)
        ticks.cancel()
    return await asyncio.to_thread(target.read_bytes)


def fleet_picture(folder: Path) -> dict[str, bytes]:
    """The page of six holds, one of which has ended."""
    names = ["north", "south", "east", "west", "spare", "bench"]
    with slowed_holds(folder, 8.0, names) as holds:
        return {"web-fleet": asyncio.run(_fleet_picture(folder, names, holds))}


async def _fleet_picture(folder: Path, names: list[str], holds: subprocess.Popen[str]) -> bytes:
    options = ("--fleet", str(fleet_file(folder, *names)))
    async with served(folder, *options) as link, browser_tab(link, folder / "profile") as tab:
        await asyncio.sleep(220.0)
        await asyncio.to_thread(
            command, "ctl", "manual", 1.2, "--socket", folder / "east" / "control.sock"
        )
        await tab.show_as(1500, 1000, dark=True)
        await asyncio.sleep(20.0)
        assert holds.stdin is not None
        holds.stdin.write("end spare\n")
        holds.stdin.flush()
        await tab.until("document.body.innerText.includes('the run has ended')")
        await tab.screenshot(folder / "fleet.png", whole=False)
    return await asyncio.to_thread((folder / "fleet.png").read_bytes)


def _tab(folder: Path, *asked: object) -> bytes:
    target = folder / "tab.png"
    command("review", *asked, "--screenshot", target)
    picture = cv2.imread(str(target))
    height_px = round(picture.shape[0] * _WIDTH_PX / picture.shape[1])
    return cv2.imencode(
        ".png", cv2.resize(picture, (_WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)
    )[1].tobytes()


def _page(page: Path, width_px: int, height_px: int) -> bytes:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("no Chromium: apt-get install chromium")
    target = page.with_suffix(".png")
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--window-size={width_px},{height_px}",
        f"--user-data-dir={page.parent / 'profile'}",
        f"--screenshot={target}",
    ]
    subprocess.run(
        [chromium, *options, page.as_uri()], check=True, capture_output=True, timeout=120
    )
    return target.read_bytes()


MAKERS: dict[tuple[str, ...], Callable[[Path], dict[str, bytes]]] = {
    ("run-overview", "run-shape"): run_pictures,
    ("review-overview", "review-loop", "review-shape", "review-tuning", "report"): review_pictures,
    ("review-faults",): faults_picture,
    ("review-catalogue",): catalogue_picture,
    ("tutorial-fault",): tutorial_picture,
    ("calibration-bowed-screen",): bowed_picture,
    ("web", "web-phone", "web-configuration"): page_pictures,
    ("web-commission",): commission_picture,
    ("tune-explore",): tune_picture,
    ("web-fleet",): fleet_picture,
}


def main() -> None:
    """Write the pictures whose names match the arguments; without any, all."""
    wanted = sys.argv[1:] or ["*"]
    for names, make in MAKERS.items():
        chosen = [name for name in names if any(fnmatch(name, pattern) for pattern in wanted)]
        if chosen:
            with tempfile.TemporaryDirectory() as folder:
                made = make(Path(folder))
            for name in chosen:
                (IMAGES / f"{name}.png").write_bytes(made[name])
                print(IMAGES / f"{name}.png")


if __name__ == "__main__":
    main()
