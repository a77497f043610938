"""`ctl --host`, and services that follow others: real services and strange ones."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from membrane_ctrl.bridges.bridge import TABLE, Bridge
from membrane_ctrl.cli import run as command
from membrane_ctrl.config.bridges import BridgesConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.service_client import (
    TOKEN_VARIABLE,
    ServiceAddress,
    ServiceClient,
    read_token,
)
from membrane_ctrl.model.errors import DeviceError, Exit, InputError
from membrane_ctrl.model.run_events import Mark
from membrane_ctrl.service.access import on_behalf
from membrane_ctrl.service.send_limits import SendLimits
from membrane_ctrl.service.service_feed import ServiceFeed, make_feed
from membrane_ctrl.service.tokens import add_token, revoke_token, tokens_file
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.web.fleet_panel import fleet_rows
from tests.web.test_page import served
from tests.worlds.port_run import ROW, PortRun, keep_ticking, port_run


@pytest.fixture
def token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    made = add_token(tokens_file(), "ops", "operate")
    monkeypatch.setenv(TOKEN_VARIABLE, made)
    return made


async def check_bridge(where: Where, run: PortRun) -> None:
    """Bridges through a service: its signals, commands with a time limit, safety commands."""
    feed = make_feed(where, with_signals=True)
    bridge = Bridge(feed, Config(bridges=BridgesConfig(role="operate")))
    feed.open()
    try:
        async with asyncio.timeout(60.0):
            while not bridge.live:  # noqa: ASYNC110
                await asyncio.sleep(0.1)
        values = bridge.values()
        assert values["state"] == "hold"
        assert values["error_um"] == ROW.error_um
        assert set(values) == {each.name for each in TABLE}
        late = SendLimits(time.monotonic() - 1.0)
        reply = await asyncio.to_thread(feed.ask, {"do": "hold"}, late)
        assert "answered too late" in reply.text
        before = len(run.asked)
        flood = [asyncio.create_task(bridge.ask("mqtt", "shape_on")) for _ in range(150)]
        await asyncio.sleep(0)
        locked = await bridge.ask("mqtt", "latch", "hands inside")
        refused = await asyncio.gather(*flood)
        assert "latch" in [each.kind for each in run.asked[before:]] or "still being" in locked
        assert sum("too many commands" in each for each in refused) >= 140
    finally:
        await bridge.close()
        await asyncio.to_thread(feed.close)


@pytest.mark.real_time
async def test_a_person_and_another_service_reach_a_hold_through_its_service(
    tmp_path: Path, token: str, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    async with port_run(logs) as run, served(logs) as link:
        ticks = asyncio.create_task(keep_ticking(run))
        url = link.partition("?")[0]

        async def ctl(*words: str) -> tuple[int, str, str]:
            code = await asyncio.to_thread(command, ["ctl", *words, "--host", url])
            reply = capsys.readouterr()
            return code, reply.out, reply.err

        try:
            async with asyncio.timeout(120.0):
                while (await ctl("status"))[0] != Exit.DONE:  # noqa: ASYNC110
                    await asyncio.sleep(0.2)
            code, out, _ = await ctl("status")
            assert out.startswith("the-run: hold")
            assert json.loads((await ctl("status", "--json"))[1])["run"] == "the-run"
            code, _, err = await ctl("setpoint", "-2.5", "--why", "test")
            assert (code, err.startswith("setpoint: done")) == (Exit.DONE, True)
            code, _, err = await ctl("gains", "kp_per_s = 0.5")
            assert code == Exit.BAD_INPUT
            assert "gains needs the role tune; ops has operate" in err
            code, _, err = await ctl("manual", "1e9")
            assert code == Exit.BAD_INPUT
            code, _, err = await ctl("stop", "--why", "from afar")
            assert (code, err.startswith("stop: done")) == (Exit.DONE, True)
            reply = [(each.kind, each.who, each.why) for each in run.asked]
            assert [each for each in reply if each[0] != "manual"] == [
                ("setpoint", "token:ops", "test"),
                ("stop", "token:ops", "from afar"),
            ]
            assert run.asked[0].value == -2.5
            feed = make_feed(Where(service=ServiceAddress(url, token)))
            assert isinstance(feed, ServiceFeed)
            await asyncio.to_thread(feed.follow_once)
            assert (feed.seen.name, feed.seen.role, feed.seen.state_name) == (
                "the-run",
                "operate",
                "hold",
            )
            assert feed.logs is None, "its runs are there"
            run.port.note_report(Mark("door opened", "anna"))
            async with asyncio.timeout(60.0):
                while not any("door opened" in line for line in feed.seen.events):
                    await asyncio.to_thread(feed.follow_once)
            viewer = on_behalf(WebUser("anna", "tune"), "page 1")
            asked = {"do": "pause", "on_behalf": viewer}
            outcome = await asyncio.to_thread(feed.ask, asked)
            assert outcome.text == "pause: done"
            assert run.asked[-1].who == "token:ops for anna"
            await check_bridge(Where(service=ServiceAddress(url, token)), run)
            revoke_token(tokens_file(), "ops")
            code, _, err = await ctl("status")
            assert (code, "the token is unknown there, or revoked" in err) == (2, True)
        finally:
            ticks.cancel()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("bench2.lab:7480", "write it like https"),
        ("ftp://bench2.lab/", "write it like https"),
        ("https:///", "write it like https"),
        ("https://a:99999/", "write it like https"),
        ("http://bench2.lab:7480/", "the token would cross the network; use https"),
    ],
)
def test_an_address_that_cannot_be_is_refused(url: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        ServiceClient(ServiceAddress(url, "token"))
    ServiceClient(ServiceAddress("http://127.0.0.1:7480/mirror/", "token"))


@pytest.mark.parametrize("content", ["", "\n", "a\nb", "\u00e4", "x\x00"])
def test_a_token_file_with_something_else(tmp_path: Path, content: str) -> None:
    (tmp_path / "token").write_text(content)
    with pytest.raises(InputError, match="no token; make one there"):
        read_token(tmp_path / "token")
    with pytest.raises(InputError, match="no such file"):
        read_token(tmp_path / "none")


def test_without_a_file_the_token_is_in_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, " abc\n")
    assert read_token(None) == "abc"
    monkeypatch.delenv(TOKEN_VARIABLE)
    with pytest.raises(InputError, match=TOKEN_VARIABLE):
        read_token(None)


def http(body: bytes, status: str = "200 OK") -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


def state_with(**changed: object) -> bytes:
    state: dict[str, object] = {
        "hold": "",
        "run": "r",
        "state": "hold",
        "in_contact": True,
        "reason": "",
        "alarms": [],
        "locks": [],
        "error_um": 0.1,
        "status": {},
        "ended": None,
    }
    return http(json.dumps(state | changed).encode())


ANSWERS = {
    "nothing": b"",
    "no HTTP": b"\x00\xff" * 100 + b"\r\n",
    "another protocol": b"SSH-2.0-OpenSSH_9\r\n",
    "no JSON": http(b"<html>"),
    "a list": http(b"[]"),
    "a field is missing": http(b'{"hold": ""}'),
    "a wrong type": state_with(alarms="no list"),
    "not finite": http(b'{"error_um": NaN}'),
    "deep": http(b"[" * 2000 + b"]" * 2000),
    "huge": http(b'{"run": "' + b"x" * 1_100_000 + b'"}'),
    "a text too long": state_with(run="x" * 3000),
    "a wrong status": state_with(status={"state": 5}),
    "many": state_with(alarms=["x"] * 3000),
    "an error": http(b'{"detail": "\\u001b[2J"}', "500 Oops"),
    "a redirect": http(b"", "302 Found"),
}


@asynccontextmanager
async def strange_service(answer: bytes, hold_s: float = 0.0) -> AsyncIterator[str]:
    """A server that answers each request with these bytes."""
    serving: set[asyncio.Task[None]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        serving.add(task)
        try:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(answer)
            await writer.drain()
            await asyncio.sleep(hold_s)
        except (OSError, asyncio.IncompleteReadError):
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        port = server.sockets[0].getsockname()[1]
        try:
            yield f"http://127.0.0.1:{port}/"
        finally:
            for task in serving:
                task.cancel()
            await asyncio.gather(*serving, return_exceptions=True)


@pytest.mark.parametrize("name", ANSWERS)
async def test_garbage_is_one_line_and_one_red_row(name: str) -> None:
    async with strange_service(ANSWERS[name]) as url:
        feed = make_feed(Where(service=ServiceAddress(url, "token")))
        assert isinstance(feed, ServiceFeed)
        feed._role = "operate"  # who we are there is known
        await asyncio.to_thread(feed._try_to_follow, feed.follow_once)
        (row,) = fleet_rows({"far": feed})
        assert row["state"] == "no contact"
        assert row["error"] is None
        message = str(row["description"])
        assert message.startswith(url.rstrip("/"))
        assert message.isprintable()
        assert len(message) < 500
        with pytest.raises(DeviceError):
            await asyncio.to_thread(ServiceClient(ServiceAddress(url, "t")).read_state)


async def test_who_is_silent_is_left_at_the_deadline() -> None:
    async with strange_service(b"", hold_s=30.0) as url:
        client = ServiceClient(ServiceAddress(url, "token"), answer_s=0.3)
        with pytest.raises(DeviceError, match=r"no answer within 0\.3 s"):
            await asyncio.to_thread(client.read_state)
    with pytest.raises(DeviceError, match="no service is listening"):
        await asyncio.to_thread(client.read_state)
