"""Several holds as one list: `ctl fleet` and the page's table, also when some are not there."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import time
from contextlib import AsyncExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.control_port.ctl import Where, fleet
from membrane_ctrl.control_port.service_client import ServiceAddress
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.service.ended_run import EndKind
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.web.fleet_panel import fleet_rows
from tests.support.browser import browser_tab
from tests.support.machine_needs import needs
from tests.web.test_page import served
from tests.worlds.fleet_file import fleet_file
from tests.worlds.port_run import keep_ticking, port_run


async def test_the_terminal_lists_all_holds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = fleet_file(tmp_path, "north", "south", "spare")
    async with port_run(tmp_path / "north"), port_run(tmp_path / "south") as south:
        south.state = State.FAULT
        south.tick()
        assert await asyncio.to_thread(command, ["ctl", "fleet", str(file)]) == Exit.DEVICE_FAILED
        north, faulty, spare = capsys.readouterr().out.splitlines()
        assert north.split()[:4] == ["north", "hold", "0.25", "µm"]
        assert faulty.split()[:2] == ["south", "fault"]
        assert spare.startswith("spare  no contact")
        assert "no hold is listening" in spare
        assert "--socket" not in spare, "the fleet file names it"
        assert "0.250" not in spare
        assert (
            await asyncio.to_thread(command, ["ctl", "fleet", str(file), "--json"])
            == Exit.DEVICE_FAILED
        )
        found = json.loads(capsys.readouterr().out)
        assert [found[name].get("state") for name in ("north", "south", "spare")] == [
            "hold",
            "fault",
            None,
        ]
    assert (
        await asyncio.to_thread(command, ["ctl", "fleet", str(fleet_file(tmp_path, "north"))]) == 4
    )


def test_files_are_beside_the_fleet_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "fleet.toml").write_text(
        '[[holds]]\nname = "here"\nsocket = "runs/control.sock"\n[[holds]]\nname = '
        '"far"\nurl = "https://bench2.lab:7480/"\n'
        'token_file = "token"\nauthority_file = "/etc/lab.pem"\n'
    )
    (tmp_path / "lab" / "token").write_text("abc\n")
    monkeypatch.chdir(tmp_path)
    lab = tmp_path / "lab"
    found = fleet(Path("lab/fleet.toml"))
    assert found["here"] == Where(lab / "runs" / "control.sock", logs=lab / "runs")
    far = found["far"]
    address = ServiceAddress("https://bench2.lab:7480/", "abc", Path("/etc/lab.pem"))
    assert far.service == address
    assert HoldFeed(far).logs is None, "its runs are on its host"
    assert HoldFeed(found["here"]).logs == lab / "runs"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds"),
        ("holds = []\n", "holds"),
        ('[[holds]]\nname = "a"\n', "give either socket or url"),
        ('[[holds]]\nname = "a"\nsocket = "s"\nurl = "https://b/"\n', "give either socket or url"),
        (
            '[[holds]]\nname = "a"\nurl = "http://far/"\ntoken_file = "fleet.toml"\n',
            "no token",
        ),
        (
            '[[holds]]\nname = "a"\nsocket = "s"\n[[holds]]\nname = "a"\nsocket = "t"\n',
            "two have the same name",
        ),
        ('[[holds]]\nname = "<b>"\nsocket = "s"\n', "name"),
    ],
)
def test_a_fleet_that_cannot_be_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "fleet.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        fleet(tmp_path / "fleet.toml")


def test_the_table_shows_alarms_first_and_no_old_numbers() -> None:
    feeds = {name: HoldFeed(Where()) for name in ("good", "bad", "gone", "stopped", "tripped")}
    now_s = time.monotonic()
    status = {"state": "hold", "why": "", "row": {"error_um": 0.256}}
    good = dataclasses.replace(feeds["good"].seen, problem="", seen_s=now_s, status=status)
    feeds["good"].seen = good
    feeds["bad"].seen = dataclasses.replace(
        good, status={**status, "notices": [{"topic": "maintenance", "text": "the leak grows"}]}
    )
    feeds["gone"].seen = dataclasses.replace(good, seen_s=now_s - 100.0)
    for name, kind, is_regular in (
        ("stopped", EndKind.STOPPED, True),
        ("tripped", EndKind.FAULT, False),
    ):
        ended = SimpleNamespace(kind=kind, is_regular=is_regular, headline=f"run ended: {name}")
        feeds[name].seen = dataclasses.replace(
            good,
            problem="no hold runs",
            ended=ended,  # type: ignore[arg-type]
        )
    shown = [
        tuple(row[key] for key in ("hold", "state", "error", "description", "is_red"))
        for row in fleet_rows(feeds)
    ]
    assert shown == [
        ("good", "hold", 0.26, "as it should be", False),
        ("bad", "hold", 0.26, "the leak grows", True),
        ("gone", "no contact", None, "no status for 100 s", True),
        ("stopped", "ended", None, "run ended: stopped", False),
        ("tripped", "fault", None, "run ended: tripped", True),
    ]


@needs("chromium")
@pytest.mark.campaign
@pytest.mark.real_time
async def test_twenty_holds_on_one_page(tmp_path: Path) -> None:
    names = [f"mirror{number}" for number in range(20)]
    file = fleet_file(tmp_path, *names)
    async with AsyncExitStack() as stack, AsyncExitStack() as last:
        runs = [await stack.enter_async_context(port_run(tmp_path / name)) for name in names[:-1]]
        runs.append(await last.enter_async_context(port_run(tmp_path / names[-1])))
        tasks = [asyncio.create_task(keep_ticking(run)) for run in runs]
        try:
            link = await stack.enter_async_context(served(tmp_path, "--fleet", str(file)))
            tab = await stack.enter_async_context(browser_tab(link, tmp_path / "profile"))
            rows = "[...document.querySelectorAll('tbody tr')].map(r => r.innerText)"
            await tab.until(
                f"{rows}.filter(r => r.includes('hold') && r.includes('0.25')).length === 20"
            )
            await tab.screenshot(tmp_path / "fleet.png")
            tasks[-1].cancel()
            await last.aclose()
            await tab.until(f"{rows}.filter(r => r.includes('no contact')).length === 1")
            await tab.value(
                "[...document.querySelectorAll('a')].find(a => a.innerText === 'mirror7').click()"
            )
            await tab.until(
                "location.search === '?hold=mirror7' && "
                "document.body.innerText.includes('mirror7 the-run')"
            )
            await tab.value(
                "[...document.querySelectorAll('button')].find(b => "
                "b.innerText.includes('Pause')).click()"
            )
            await tab.until(
                "[...document.querySelectorAll('button')].some(b => b.innerText.trim() === 'DO IT')"
            )
            await tab.click("Do it")
            await tab.until("document.body.innerText.includes('pause: done')")
            assert [bool(run.asked) for run in runs] == [number == 7 for number in range(20)]
        finally:
            for task in tasks:
                task.cancel()
