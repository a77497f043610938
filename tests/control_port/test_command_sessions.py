"""Command belongs to a session, not to its user: a second one of the same user is refused and
learns who has it.
"""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.commander import Commander, CommandSession
from membrane_ctrl.control_port.ctl import status_lines
from membrane_ctrl.model.errors import DeviceError
from tests.worlds.port_run import PortRun, port_run


def client_of(run: PortRun, notices: list[str] | None = None) -> PortClient:
    """A client of this process: all have the same name."""
    heard: Callable[[str], Any] = print if notices is None else notices.append
    return PortClient.unix(run.path, heard)


async def call(act: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    return await asyncio.to_thread(act, *arguments, **named)


async def test_a_second_session_of_the_same_user_is_refused_with_the_first_ones_name_process_and_time(  # noqa: E501
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run:
        first, second = await call(client_of, run), await call(client_of, run)
        assert first.greeting["you"] == second.greeting["you"]
        assert (await call(first.ask, do="claim", text="tune morning"))["ok"]
        refused = (await call(second.ask, do="claim", text="tune again"))["refused"]
        status = (await call(second.status))["status"]
        for part in (
            "tune morning",
            f"process {os.getpid()}",
            status["command_session"]["id"],
            "since 20",
        ):
            assert part in refused
        assert first.greeting["you"] in refused
        assert status["commander"] == first.greeting["you"]
        assert any(
            "tune morning" in line and str(os.getpid()) in line for line in status_lines(status)
        )
        for single in ({"do": "setpoint", "value": 1.0}, {"do": "hold"}, {"do": "pause"}):
            assert "tune morning" in (await call(second.ask, **single))["refused"]
        assert (await call(first.ask, do="setpoint", value=1.0))["ok"], "the first is not disturbed"
        assert [command.kind for command in run.asked] == ["setpoint"]
        first.close()
        second.close()


async def test_a_session_has_command_for_longer_than_single_commands_last(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        first = await call(client_of, run)
        await call(first.ask, do="claim", text="tune morning")
        run.now_s += 1e5
        second = await call(client_of, run)
        assert "tune morning" in (await call(second.ask, do="setpoint", value=1.0))["refused"]
        assert (await call(second.status))["status"]["command_session"]["what"] == "tune morning"
        first.close()
        second.close()


async def test_a_session_that_hangs_up_or_releases_gives_up_command(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        second = await call(client_of, run)
        for release in (lambda each: each.close(), lambda each: each.ask(do="release")):
            first = await call(client_of, run)
            assert (await call(first.ask, do="claim", text="tune"))["ok"]
            await call(release, first)
            async with asyncio.timeout(5.0):
                while (await call(second.status))["status"]["command_session"] is not None:  # noqa: ASYNC110
                    await asyncio.sleep(0.02)
            assert (await call(second.status))["status"]["commander"] is None
            first.close()
        events = [(event["who"], event["why"]) for event in run.of_kind("commander")]
        assert (None, "its connection is closed") in events
        second.close()


async def test_a_session_whose_process_is_killed_gives_up_command(tmp_path: Path) -> None:
    claims = (
        "import sys, time; from membrane_ctrl.control_port.client import PortClient\n"
        "hold = PortClient.unix(sys.argv[1], print); print(hold.ask(do='claim', "
        "text='doomed')['ok'], flush=True)\n"
        "time.sleep(60)"
    )
    async with port_run(tmp_path) as run:
        words = [sys.executable, "-c", claims, str(run.path)]
        doomed = await call(subprocess.Popen, words, stdout=subprocess.PIPE, text=True)
        assert doomed.stdout is not None
        assert (await call(doomed.stdout.readline)).strip() == "True"
        second = await call(client_of, run)
        assert (
            f"process {doomed.pid}" in (await call(second.ask, do="claim", text="next"))["refused"]
        )
        doomed.send_signal(signal.SIGKILL)
        await call(doomed.wait)
        doomed.stdout.close()
        async with asyncio.timeout(5.0):
            while not (await call(second.ask, do="claim", text="next"))["ok"]:  # noqa: ASYNC110
                await asyncio.sleep(0.02)
        second.close()


async def test_a_deliberate_takeover_reaches_the_first_session_with_its_reason(
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run:
        notices: list[str] = []
        first, second = await call(client_of, run, notices), await call(client_of, run)
        await call(first.ask, do="claim", text="tune morning")
        await call(first.poll)
        assert not first.command_taken
        answer = await call(
            second.ask, do="claim", text="tune noon", take_over=True, why="wrong gas"
        )
        assert answer["ok"]
        await call(first.poll)
        assert first.command_taken == notices[0]
        assert "tune noon" in first.command_taken
        assert first.command_taken.endswith("has taken over command: wrong gas")
        assert "tune noon" in (await call(first.ask, do="setpoint", value=1.0))["refused"]
        await call(first.ask, do="release")
        assert (await call(second.status))["status"]["command_session"]["what"] == "tune noon"
        taken = run.of_kind("commander")[-1]
        assert "tune noon" in taken["who"]
        assert "tune morning" in taken["former"]
        first.close()
        second.close()


@pytest.mark.parametrize("do", ["lower", "vent", "stop", "latch"])
async def test_a_client_that_lowers_the_mirror_need_not_have_command(
    do: str, tmp_path: Path
) -> None:
    async with port_run(tmp_path) as run:
        first, second = await call(client_of, run), await call(client_of, run)
        await call(first.ask, do="claim", text="tune")
        more = {"text": "hands inside"} if do == "latch" else {}
        assert (await call(second.ask, do=do, **more))["ok"]
        assert [command.kind for command in run.asked] == [do]
        first.close()
        second.close()


async def test_a_crowd_of_clients_does_not_drop_the_session_in_command(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        session = await call(client_of, run)
        await call(session.ask, do="claim", text="tune")
        others = [await call(client_of, run) for _ in range(6)]
        await call(session.poll)
        assert (await call(session.ask, do="setpoint", value=1.0))["ok"]
        for each in (session, *others):
            each.close()


async def test_a_poll_reports_a_hold_that_has_gone(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        session = await call(client_of, run)
        await call(session.poll)
    with pytest.raises(DeviceError, match="closed the connection"):
        session.poll()
    session.close()


def test_a_session_must_have_a_name(tmp_path: Path) -> None:
    async def claim() -> str:
        async with port_run(tmp_path) as run:
            client = await call(client_of, run)
            answer = await call(client.ask, do="claim")
            client.close()
            return str(answer["refused"])

    assert "text missing" in asyncio.run(claim())


def test_a_single_command_of_another_user_keeps_sessions_out_until_it_lapses() -> None:
    commander = Commander(600.0)
    session = CommandSession("1a2b", "unix:bob", "tune", 12, "2026-01-01T00:00:00+00:00")
    assert commander.claim("unix:ann", False, 0.0, "conn") == ""
    assert "unix:ann has command" in commander.begin_session(session, False, 10.0)
    assert commander.begin_session(session, False, 601.0) == ""
    assert commander.holder(1e6) == "unix:bob"
    commander.release("unix:bob", "another")
    assert commander.holder(1e6) == "unix:bob", (
        "another connection of the same user does not end it"
    )
    assert commander.end_session("another") is None
    assert commander.end_session("1a2b") is session
    assert commander.holder(1e6) == ""
