"""The page in a real browser, on a port that is real: what a viewer sees, sends, and cannot be made
to do.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.events import LockSet
from membrane_ctrl.model.run_events import Mark
from membrane_ctrl.service.ended_run import REPORT_NAME
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.sessions.folder import create_session
from membrane_ctrl.sessions.live_log import LiveLog
from membrane_ctrl.sessions.progress import Progress
from membrane_ctrl.web import cli, report_answers, runs_panel, server
from tests.support import review_runs
from tests.support.browser import Tab, browser_tab
from tests.support.machine_needs import needs
from tests.worlds.free_port import free_port
from tests.worlds.port_run import PortRun, keep_ticking, port_run

_START_S = 180.0
HOSTILE = "<img src=x onerror=\"document.title='owned'\">"


@asynccontextmanager
async def served(folder: Path, *options: str) -> AsyncIterator[str]:
    """`membrane-ctrl serve` on a folder of runs; yields the link that it prints."""
    env = {
        name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"
    }  # NiceGUI looks for it
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        "from membrane_ctrl.web.cli import app; app()",
        "--logs",
        str(folder),
        "--port",
        str(free_port()),
        *options,
        stderr=asyncio.subprocess.PIPE,
        env=env,
    )
    try:
        assert process.stderr is not None
        async with asyncio.timeout(_START_S):
            line = (await process.stderr.readline()).decode()
        assert line.startswith("membrane-ctrl serve: open http"), line
        yield line.split()[-1]
    finally:
        process.terminate()
        await process.wait()


@asynccontextmanager
async def viewed(tmp_path: Path, *options: str) -> AsyncIterator[tuple[PortRun, Tab]]:
    """A hold, the page of it, and a browser that has opened its link."""
    async with port_run(tmp_path) as run, served(tmp_path, *options) as link:
        task = asyncio.create_task(keep_ticking(run))
        try:
            await asyncio.sleep(1.0)
            async with browser_tab(link, tmp_path / "profile") as tab:
                await tab.until(
                    "document.querySelector('[data-field=error_um]').innerText === '0.25'"
                )
                yield run, tab
        finally:
            task.cancel()


@needs("chromium")
@pytest.mark.real_time
async def test_a_viewer_sees_the_hold_and_pauses_it(tmp_path: Path) -> None:
    async with viewed(tmp_path) as (run, tab):
        assert "the-run" in await tab.value("document.body.innerText")
        fetched = "performance.getEntriesByType('resource').filter(r => r.name.includes('/chart?'))"
        await tab.until(f"{fetched}.some(r => r.responseStatus === 200 && r.decodedBodySize > 500)")
        await tab.value(
            "[...document.querySelectorAll('button')].find(b => "
            "b.innerText.includes('Pause')).click()"
        )
        await tab.until(
            "[...document.querySelectorAll('button')].some(b => b.innerText.trim() === 'DO IT')"
        )
        assert run.asked == [], "nothing is sent before the confirmation"
        await tab.value(
            "[...document.querySelectorAll('button')].find(b => b.innerText.trim() === 'DO "
            "IT').click()"
        )
        await tab.until("document.body.innerText.includes('pause: done')")
        assert [(command.kind, command.why) for command in run.asked] == [("pause", "web: link")]
        run.port.note_report(Mark(HOSTILE, "anna"))
        await tab.until("document.body.innerText.includes('onerror')")
        assert await tab.value("document.title") == "membrane_ctrl"
        await tab.screenshot(tmp_path / "page.png")


@needs("chromium")
@pytest.mark.real_time
async def test_several_signals_share_a_chart_and_are_drawn_again(tmp_path: Path) -> None:
    async with viewed(tmp_path) as (_, tab):
        field = "document.querySelector('[aria-label=signals]').closest('.q-select')"
        await tab.value(f"{field}.querySelector('.q-field__control').click()")
        items = "[...document.querySelectorAll('.q-menu .q-item')]"
        await tab.until(f"{items}.some(i => i.innerText.trim() === 'pump')")
        await tab.value(f"{items}.find(i => i.innerText.trim() === 'pump').click()")
        canvas = "document.querySelector('[aria-label=history] canvas')"
        chart = f"getElement(+{canvas}.closest('[id^=c]').id.slice(1)).chart"
        await tab.until(f"{chart}.getOption().grid.length === 2")
        named = f"{chart}.getOption().series.filter(s => s.id && s.unit !== undefined)"
        assert await tab.value(f"{named}.map(s => s.name)") == ["error", "pump"]
        fetched = (
            "performance.getEntriesByType('resource').filter(r => "
            "r.name.includes('/chart?')).length"
        )
        before = await tab.value(fetched)
        await tab.until(f"{fetched} > {before} + 1")


@needs("chromium")
@pytest.mark.real_time
async def test_a_viewer_sees_all_locks_and_types_the_word_of_one(tmp_path: Path) -> None:
    press = (
        "[...document.querySelectorAll('button')].find(b => b.innerText.trim().toLowerCase() === "
        "'{}').click()"
    )
    async with viewed(tmp_path) as (run, tab):
        for number, author in enumerate(("unix:ann", "page:bob")):
            word = f"bofa{number}"
            run.tick(
                (
                    LockSet(
                        word, "hands inside", author, author, "s", "2026-01-02T03:04:05+00:00", 1
                    ),
                )
            )
            await tab.until(
                "document.body.innerText.includes('hands inside') && "
                f"document.body.innerText.includes('{word}')"
            )
        await tab.value(
            "[...document.querySelectorAll('button')].find(b => "
            "b.innerText.includes('Unlock')).click()"
        )
        await tab.until("document.querySelector('.q-dialog input')")
        dialog = str(await tab.value("document.querySelector('.q-dialog').innerText"))
        for part in ("unix:ann", "page:bob", "bofa0", "bofa1", "Type the word"):
            assert part in dialog
        assert await tab.value("document.querySelector('.q-dialog input').value") == "", (
            "a person types the word"
        )
        await tab.until("document.activeElement.tagName === 'INPUT'")
        await tab.press(*"bofa1")
        await tab.value(press.format("do it"))
        await tab.until("document.body.innerText.includes('unlock: done')")
        (command,) = run.asked
        assert (command.kind, command.text, command.who) == ("unlock", "bofa1", "page:link")
        assert (command.account, command.from_person) == ("", True)


STOP = "[...document.querySelectorAll('button')].find(b => b.innerText.includes('STOP'))"
FITS = f"""(() => {{ const page = document.documentElement, place = {STOP}.getBoundingClientRect();
return page.scrollWidth <= page.clientWidth && place.top > 0 && place.bottom <= innerHeight }})()"""
# of the text of an element to what is behind it, as WCAG defines it: 4.5 is legible
CONTRAST = """(element => {
  const light = colour => { const [r, g, b] = colour.match(/[\\d.]+/g).map(v => v / 255)
    .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b };
  let behind = element;
  while (behind && getComputedStyle(behind).backgroundColor.startsWith('rgba')) behind = behind.parentElement;
  const back = behind ? getComputedStyle(behind).backgroundColor : 'rgb(255, 255, 255)';
  const [low, high] = [light(getComputedStyle(element).color), light(back)].sort((a, b) => a - b);
  return (high + 0.05) / (low + 0.05) })"""  # noqa: E501


@needs("chromium")
@pytest.mark.real_time
@pytest.mark.campaign
async def test_a_phone_and_the_keyboard_alone(tmp_path: Path) -> None:
    async with viewed(tmp_path) as (run, tab):
        for dark in (True, False):
            await tab.show_as(390, 844, dark)
            await tab.until("document.querySelector('[data-field=error_um]').innerText === '0.25'")
            for name, has in (
                ("LOOK BACK", "REFRESH"),
                ("TUNE", "No tuning session"),
                ("ALARMS", "no fault or notice"),
                ("NOW", "0.25"),
            ):
                await tab.value(PRESS.format(name))
                await tab.until(
                    f"document.querySelector('[role=tabpanel]').innerText.includes('{has}') "
                    f"&& {FITS}"
                )
                if name == "LOOK BACK":
                    refresh = (
                        "[...document.querySelectorAll('button')].find(b => "
                        "b.innerText.includes('REFRESH'))"
                    )
                    assert await tab.value(f"{CONTRAST}({refresh})") > 4.5
                await asyncio.sleep(
                    1.0
                )  # until the page has answered, which knows the open tab, too
            for what in (
                "[data-field=error_um]",
                "[aria-label=state]",
                ".nicegui-log",
                "header .text-caption",
                "button",
            ):
                assert await tab.value(f"{CONTRAST}(document.querySelector('{what}'))") > 4.5, (
                    what,
                    dark,
                )
            await tab.screenshot(tmp_path / f"phone{dark:d}.png")
        chart = "getElement(+document.querySelector('canvas').closest('[id^=c]').id.slice(1)).chart"
        await tab.until(f"{chart}.getOption().dataZoom.length === 2")
        await tab.value(f"{chart}.dispatchAction({{type: 'dataZoom', start: 40, end: 90}}), 0")
        fetched = (
            "performance.getEntriesByType('resource').filter(r => "
            "r.name.includes('/chart?')).length"
        )
        before = await tab.value(fetched)
        await tab.until(f"{fetched} > {before} + 1")
        zoom = f"{chart}.getOption().dataZoom.map(z => [z.start, z.end])"
        assert await tab.value(zoom) == [[40, 90], [40, 90]], "new data leave the viewer's zoom"
        await tab.press("m")
        await tab.until("document.activeElement.tagName === 'INPUT'")
        await tab.press(*"shut", "Enter")
        await tab.until("document.body.innerText.includes('mark: done')")
        focus = "document.activeElement.innerText"
        for _ in range(60):
            await tab.press("Tab")
            if "Pause" in await tab.value(focus):
                break
        await tab.press("Enter")
        await tab.until(f"{focus}.trim() === 'CANCEL'")  # Enter confirms nothing that moves gas
        await tab.press("Escape")
        await tab.until("!document.querySelector('.q-dialog__inner')")
        await tab.until(f"{focus}.includes('Pause')")
        await asyncio.sleep(1.0)
        await tab.press("s")  # though a button has the focus
        await tab.until(f"{focus}.trim() === 'DO IT'")
        await tab.press("h", "s", "Enter")
        await tab.until("document.body.innerText.includes('stop: done')")
        assert [(each.kind, each.text) for each in run.asked] == [("mark", "shut"), ("stop", "")]


@needs("chromium")
@pytest.mark.real_time
async def test_stop_is_within_reach_while_a_dialog_is_open(tmp_path: Path) -> None:
    async with viewed(tmp_path) as (run, tab):
        await tab.show_as(390, 700)
        await tab.until("document.querySelector('[data-field=error_um]').innerText === '0.25'")
        await asyncio.sleep(1.0)
        await tab.press("p")
        await tab.until("document.querySelectorAll('.q-dialog').length === 1")
        await asyncio.sleep(1.0)
        middle = f"(() => {{ const r = {STOP}.getBoundingClientRect(); return [r.left + r.width / 2, r.top + r.height / 2] }})()"  # noqa: E501
        x, y = await tab.value(middle)
        for kind in ("mousePressed", "mouseReleased"):
            await tab.call(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
            )
        await tab.until(
            "[...document.querySelectorAll('.q-dialog')].some(d => d.innerText.startsWith('STOP'))"
        )
        await tab.screenshot(tmp_path / "stop.png", whole=False)
        await tab.value(
            "[...document.querySelectorAll('.q-dialog')].find(d => d.innerText.startsWith('STOP'))"
            ".querySelector('button').click()"
        )
        await tab.until("document.body.innerText.includes('stop: done')")
        assert [each.kind for each in run.asked] == ["stop"]


CANDIDATES = """| candidate | K 1/s | std µm | Ms | against present |
|---|---:|---:|---:|---:|
| present | 0.300 | 0.210 +- 0.010 | 1.35 | in force |
| least-variance | 0.520 | 0.130 +- 0.008 | 1.58 | better: std x 0.62; worse: Ms x 1.17 |
| simc-slow | 0.410 | 0.160 +- 0.009 | 1.42 | better: std x 0.76; worse: Ms x 1.05 |
"""
PRESS = (
    "[...document.querySelectorAll('[role=tab]')].find(t => "
    "t.innerText.toUpperCase().includes('{}')).click()"
)


@needs("chromium")
@pytest.mark.real_time
@pytest.mark.campaign
async def test_a_candidate_is_chosen_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = create_session(tmp_path, "night", "eve", "the-run", Config(), LoopConfig()).path
    (path / "candidates.md").write_text(CANDIDATES)
    progress = Progress()
    progress.log = LiveLog(path, 50.0, print)
    progress.log_entry("step", "design", planned_s=0.0, after_s=600.0)
    progress.print_line("design: K 0.520 1/s, Ti 2.10 s: std 0.210 -> 0.130 µm")
    keyboard, terminal = os.openpty()  # nobody types
    with os.fdopen(keyboard), os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        async with viewed(tmp_path) as (_, tab):
            names = ("least-variance", "simc-slow")
            asking = asyncio.create_task(
                asyncio.to_thread(progress.ask_question, "apply which candidate?", names)
            )
            await tab.value(PRESS.format("TUNE"))
            await tab.until("document.body.innerText.includes('0.160 +- 0.009')")
            await tab.screenshot(tmp_path / "choice.png")
            await tab.click("simc-slow")
            await tab.until(
                "[...document.querySelectorAll('button')].some(b => b.innerText.trim() === 'DO IT')"
            )
            assert not asking.done(), "nothing is chosen before the confirmation"
            await tab.click("Do it")
            assert await asking == "simc-slow"
            await tab.until("document.body.innerText.includes('simc-slow: done')")
            await tab.until(
                "document.body.innerText.includes('link answers on the page: simc-slow')"
            )
            await tab.until("!document.body.innerText.includes('0.160 +- 0.009')")


def test_other_machines_need_tls_and_names(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli.app, ["--host", "0.0.0.0", "--logs", str(tmp_path)])
    assert isinstance(done.exception, InputError)
    assert "host 0.0.0.0: other machines need TLS and a login" in str(done.exception)
    files = {"certificate_file": "c", "key_file": "k"}
    with pytest.raises(ValidationError, match="need TLS and a login"):
        ServiceConfig(host="0.0.0.0", **files)
    ServiceConfig(host="0.0.0.0", users_file="users", **files)
    assert server.accounts_of(ServiceConfig()).users == {}
    empty = tmp_path / "users"
    empty.write_text("")
    with pytest.raises(InputError, match="no users; add one with"):
        server.accounts_of(ServiceConfig(users_file=str(empty)))


@pytest.mark.parametrize("name", ["..", ".", "", "../secret", "a/b", ".hidden"])
def test_a_report_is_that_of_a_run_in_the_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "logs").mkdir()
    for folder in (tmp_path, tmp_path / "logs"):
        (folder / "report").mkdir(exist_ok=True)
        (folder / REPORT_NAME).write_text("secret")
    assert b"secret" not in bytes(report_answers.report_page(tmp_path / "logs", name).body)


def test_the_report_of_a_run_is_written_and_shown(tmp_path: Path) -> None:
    run = review_runs.written(tmp_path, 0.05)
    assert report_answers.report_page(tmp_path, run.name).status_code == 404
    assert runs_panel.report_problem(run, WebUser("anna", "operate")) == ""
    shown = report_answers.report_page(tmp_path, run.name)
    assert shown.status_code == 200
    assert run.name.encode() in bytes(shown.body)


def test_a_report_of_a_stranger_runs_in_a_sandbox(tmp_path: Path) -> None:
    (tmp_path / "run" / "report").mkdir(parents=True)
    (tmp_path / "run" / REPORT_NAME).write_text("<script>fetch('/')</script>")
    answer = report_answers.report_page(tmp_path, "run")
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("sandbox")
    assert "allow-same-origin" not in policy
    assert report_answers.report_page(tmp_path, "none").status_code == 404


def test_a_reader_starts_no_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[str, ...]] = []
    monkeypatch.setattr(runs_panel, "_command", lambda *words: started.append(words) or "")
    run = tmp_path / "run"
    run.mkdir()
    reader, operator = WebUser("bob", "read"), WebUser("anna", "operate")
    assert "needs the role operate" in runs_panel.report_problem(run, reader)
    assert started == []
    assert runs_panel.report_problem(run, operator) == ""
    assert started == [("report", str(run))]
    (run / "report").mkdir()
    (run / REPORT_NAME).write_text("written")
    assert runs_panel.report_problem(run, reader) == "", "what exists may be read"
    assert len(started) == 1
    assert runs_panel.run_folder(tmp_path, "run") == run
    assert [
        runs_panel.run_folder(tmp_path, name) for name in ("../run", "/etc", "..", "", "a/b", ".x")
    ] == [None] * 6
