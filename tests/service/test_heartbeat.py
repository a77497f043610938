"""A heartbeat goes out while all works; its secret address is in no message."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.service import HeartbeatConfig, HeartbeatMqttConfig
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.service.heartbeat import Heartbeat, HttpHeartbeat, make_heartbeat, read_address
from tests.bridges.test_bridge_clients import broker, program
from tests.worlds.free_port import free_port


class Monitor:
    """A server that takes heartbeats."""

    def __init__(self) -> None:
        self.taken: list[tuple[str, bytes]] = []
        self.status = 200


@contextmanager
def serving(monitor: Monitor) -> Iterator[int]:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            size = int(self.headers["Content-Length"])
            monitor.taken.append((self.path, self.rfile.read(size)))
            self.send_response(monitor.status)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.server_port
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def wait_for(true: Callable[[], object]) -> None:
    give_up_s = time.monotonic() + 20.0
    while not true():
        assert time.monotonic() < give_up_s
        time.sleep(0.02)


def finish(heartbeat: Heartbeat) -> None:
    for thread in heartbeat._threads.values():
        thread.join(20.0)


def test_it_is_sent_at_its_interval(tmp_path: Path) -> None:
    monitor = Monitor()
    with serving(monitor) as port:
        file = tmp_path / "url.txt"
        file.write_text(f"http://127.0.0.1:{port}/ping/secret\n")
        heartbeat = make_heartbeat(HeartbeatConfig(url_file=str(file), every_s=60.0))
        for now_s in (0.0, 1.0, 59.0):
            heartbeat.step(now_s, "logs: a run")
            finish(heartbeat)
        assert monitor.taken == [("/ping/secret", b"logs: a run")]
        heartbeat.step(60.0, "logs: no run")
        finish(heartbeat)
    assert monitor.taken[1:] == [("/ping/secret", b"logs: no run")]


def test_a_failure_is_printed_once_without_the_address(
    capsys: pytest.CaptureFixture[str],
) -> None:
    monitor = Monitor()
    monitor.status = 404
    with serving(monitor) as port:
        sender = HttpHeartbeat(f"http://127.0.0.1:{port}/ping/secret")
        heartbeat = Heartbeat(1.0, {"url": sender.send})
        for now_s in (0.0, 1.0, 2.0):
            heartbeat.step(now_s, "x")
            finish(heartbeat)
        monitor.status = 200
        heartbeat.step(3.0, "x")
        finish(heartbeat)
    error_lines = capsys.readouterr().err.splitlines()
    assert error_lines == ["heartbeat: url: refused with status 404", "heartbeat: url: works again"]


def test_a_monitor_that_hangs_delays_no_other() -> None:
    entered, leave = threading.Event(), threading.Event()
    others: list[str] = []

    def hang(text: str) -> None:
        entered.set()
        leave.wait(20.0)

    heartbeat = Heartbeat(1.0, {"slow": hang, "quick": others.append})
    heartbeat.step(0.0, "a")
    assert entered.wait(20.0)
    heartbeat._threads["quick"].join(20.0)
    heartbeat.step(1.0, "b")
    heartbeat._threads["quick"].join(20.0)
    assert others == ["a", "b"]
    leave.set()
    finish(heartbeat)


@pytest.mark.parametrize(
    "text",
    ["", "lab.example/ping", "ftp://lab.example/", "file:///etc/passwd", "http:///secret", "x y"],
)
def test_a_file_without_an_address_is_refused_and_not_quoted(tmp_path: Path, text: str) -> None:
    file = tmp_path / "url.txt"
    file.write_text(text)
    with pytest.raises(InputError, match=r"heartbeat\.url_file: .*begins with https") as refused:
        read_address(file)
    assert not text or text not in str(refused.value)


def test_the_service_file_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monitor = Monitor()
    file = tmp_path / "service.toml"
    file.write_text("")
    assert run(["serve", "check", str(file)]) == 0
    assert "heartbeat: none" in capsys.readouterr().out
    file.write_text('[heartbeat]\nurl_file = "url.txt"\n')
    assert run(["serve", "check", str(file)]) == 2
    assert "heartbeat.url_file" in capsys.readouterr().err
    with serving(monitor) as port:
        (tmp_path / "url.txt").write_text(f"http://127.0.0.1:{port}/ping/secret")
        assert run(["serve", "check", str(file)]) == 0
        assert monitor.taken == []
        assert run(["serve", "check", str(file), "--send"]) == 0
        assert "heartbeat sent" in capsys.readouterr().out
        monitor.status = 500
        assert run(["serve", "check", str(file), "--send"]) == 4
    assert "secret" not in capsys.readouterr().err


async def test_a_broker_publishes_that_the_service_has_gone(tmp_path: Path) -> None:
    program("mosquitto")
    port = free_port()
    config = HeartbeatConfig(mqtt=HeartbeatMqttConfig(port=port, topic="lab/mirror"))
    async with broker(port):
        import aiomqtt

        heartbeat = make_heartbeat(config)
        assert await asyncio.to_thread(heartbeat.send_once, "logs: a run") == {}
        async with aiomqtt.Client("127.0.0.1", port) as client, asyncio.timeout(20.0):
            await client.subscribe("lab/mirror/#")
            found: dict[str, str] = {}
            async for message in client.messages:
                assert isinstance(message.payload, bytes)
                found[str(message.topic)] = message.payload.decode()
                if len(found) == 3:
                    break
            assert found["lab/mirror"] == "online"
            assert found["lab/mirror/holds"] == "logs: a run"
            assert found["lab/mirror/time_utc"].endswith("Z")
            sender = heartbeat._senders["mqtt"].__self__  # type: ignore[attr-defined]
            sender._client._sock_close()  # the line breaks
            async for message in client.messages:
                if message.payload == b"offline":
                    break
        sender._client.loop_stop()
        sender._client.disconnect()
