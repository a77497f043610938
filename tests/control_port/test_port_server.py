"""The port over its socket file: who may do what, and what a bad client can do (nothing)."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.protocol import MESSAGE_BYTES
from membrane_ctrl.control_port.sender import Peer
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.telemetry import State
from tests.worlds.port_run import ROW, PortRun, client, port_run

ANN, BOB, EVE = Peer("unix:ann", "operate"), Peer("unix:bob", "operate"), Peer("unix:eve", "read")
TOM = Peer("unix:tom", "tune")


async def test_status_is_the_newest_tick(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, EVE) as eve:
        run.tick(events=(from_dict({"kind": "why", "why": "inside the band"}),))
        answer = await eve.ask(do="status", number=5)
        assert (answer["number"], answer["ok"]) == (5, True)
        status = answer["status"]
        assert (status["state"], status["why"], status["run"]) == (
            "hold",
            "inside the band",
            "the-run",
        )
        assert status["row"]["error_um"] == ROW.error_um
        assert status["fault"] is None
        assert status["commander"] is None
        assert run.asked == []


async def test_a_command_is_answered_by_the_tick_that_obeyed(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        run.ticking = False
        ann.put(b'{"do": "setpoint", "value": 3.5, "why": "test", "number": 9}\n')
        await run.somebody_asked()
        (command,) = run.asked
        assert command == Command("setpoint", "unix:ann", "test", 3.5, number=command.number)
        run.tick(answers=((command.number + 1, "another's"),))
        run.tick(answers=((command.number, ""),))
        assert await ann.answer() == {"number": 9, "ok": True, "state": "hold"}


async def test_a_command_that_the_controller_refuses_has_its_reason(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        run.state = State.INFLATE
        answer = await ann.ask(do="pause")
        assert answer["refused"] == "pause is not allowed in state inflate; allowed in hold"
        answer = await ann.ask(do="setpoint", value=1e9)
        assert "outside the limits" in answer["refused"]
        assert run.of_kind("refused") == [], "the controller records these"


async def test_a_loop_that_does_not_tick_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.server._ANSWER_S", 0.05)
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        run.ticking = False
        assert "no tick took it" in (await ann.ask(do="stop"))["refused"]


async def test_a_role_that_is_too_low_is_refused_and_recorded(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        async with client(run, EVE) as eve:
            assert "needs the role operate" in (await eve.ask(do="stop", why="curious"))["refused"]
        async with client(run, ANN) as ann:
            assert (
                "needs the role tune"
                in (await ann.ask(do="gains", loop={"kp_per_s": 0.5}))["refused"]
            )
        assert [(e["who"], e["command"], e["why"]) for e in run.of_kind("refused")] == [
            ("unix:eve", "stop", "curious"),
            ("unix:ann", "gains", ""),
        ]
        assert run.asked == []


async def test_one_commander_at_a_time(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann, client(run, BOB) as bob:
        assert (await ann.ask(do="setpoint", value=1.0))["ok"]
        refused = await bob.ask(do="setpoint", value=2.0)
        assert refused["refused"].startswith("unix:ann has command")
        assert (await bob.ask(do="mark", text="bob was here"))["ok"], "a mark moves nothing"
        assert (await bob.ask(do="setpoint", value=2.0, take_over=True, why="shift"))["ok"]
        notice = await ann.get()
        assert notice == {
            "notice": "unix:bob has taken over command: shift",
            "code": "command_taken",
        }
        assert "unix:bob has command" in (await ann.ask(do="setpoint", value=1.0))["refused"]
        assert [(e["who"], e["former"]) for e in run.of_kind("commander")] == [
            ("unix:ann", None),
            ("unix:bob", "unix:ann"),
        ]
        assert (await bob.ask(do="release"))["ok"]
        assert (await ann.ask(do="setpoint", value=1.0))["ok"]


async def test_a_stop_is_always_taken(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann, client(run, BOB) as bob:
        assert (await ann.ask(do="setpoint", value=1.0))["ok"]
        for state in State:
            run.state = state
            assert (await bob.ask(do="stop", why=f"in {state.name}"))["ok"]
        assert (await ann.ask(do="status"))["status"]["commander"] == "unix:ann"


async def test_gains_change_what_they_name(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, TOM) as tom:
        run.loop = run.loop.model_copy(update={"ti_s": 9.0})
        assert (await tom.ask(do="gains", loop={"kp_per_s": 0.5}, value=60))["ok"]
        (command,) = run.asked
        assert command.loop == run.loop.model_copy(update={"kp_per_s": 0.5})
        assert command.value == 60.0


@pytest.mark.parametrize(
    ("loop", "message"),
    [
        ({"kp": 1.0}, "kp: unknown key; known: rate_hz"),
        ({"kp_per_s": -1.0}, "kp_per_s: input should be greater"),
        ({"setpoint_um": 3.0}, "use the command setpoint"),
        ({"rate_hz": 100.0}, "tick rate cannot be changed"),
        (
            {"kp_per_s": 15.0},
            "kp_per_s = 15: with Ti 6.5 s, Td 0 s, a filter of 0.2 s the loop is unstable",
        ),
        ({"kp_per_s": 0.0}, "nothing would hold the mirror"),
        ({}, "takes"),
    ],
)
async def test_gains_that_are_none_are_one_line(
    tmp_path: Path, loop: dict[str, float], message: str
) -> None:
    async with port_run(tmp_path) as run, client(run, TOM) as tom:
        answer = await tom.ask(do="gains", loop=loop)
        if loop:
            assert message in answer["refused"]
        else:
            assert answer["ok"], "no change is no harm"


async def test_an_experiment_is_validated_and_handed_on(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, TOM) as tom:
        assert (
            "holding_flow_um_per_s: missing"
            in (await tom.ask(do="tune", experiment={"kind": "relay"}))["refused"]
        )
        spec = {"kind": "relay", "holding_flow_um_per_s": 1.2, "laser_um": 1.0}
        assert (await tom.ask(do="tune", experiment=spec))["ok"]
        assert run.asked[0].experiment is not None
        assert run.asked[0].experiment.laser_um == 1.0


async def test_watch_streams_status_and_events(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, EVE) as eve, client(run, ANN) as ann:
        assert (await eve.ask(do="watch", period_s=0.1))["status"]["state"] == "hold"
        run.tick(
            events=(
                from_dict({"kind": "fault", "code": 10, "name": "n", "cause": "c", "remedy": "r"}),
            )
        )
        assert (await eve.get() or {})["event"]["name"] == "n"
        run.state = State.MANUAL
        run.tick()
        assert (await eve.get() or {})["status"]["state"] == "manual"
        assert "event" not in await ann.ask(do="status"), (
            "only a client that watches receives events"
        )


async def test_alarms_are_acknowledged_on_record(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        assert (await ann.ask(do="quiet", why="on my way"))["ok"]
        assert run.of_kind("alarms_acknowledged") == [
            {"kind": "alarms_acknowledged", "who": "unix:ann", "why": "on my way"}
        ]


async def test_nonsense_is_refused_and_in_the_end_not_listened_to(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        for _ in range(5):
            assert "invalid JSON" in (await ann.ask_bytes(b"hello\n"))["refused"]
        assert (await ann.ask(do="status"))["ok"], "it may come to its senses"
        ann.put(b"nonsense\n" * 50)
        assert await ann.gone()
        assert run.asked == []
        assert len(run.of_kind("refused")) == 10, "a burst, not all of them"


async def test_a_huge_message_ends_the_connection(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann, client(run, BOB) as bob:
        ann.put(b"x" * (4 * MESSAGE_BYTES))
        assert f"{MESSAGE_BYTES} bytes" in (await ann.answer())["refused"]
        assert await ann.gone()
        assert (await bob.ask(do="status"))["ok"]


async def test_a_message_that_does_not_end_ends_the_connection(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.line_connection._LINE_S", 0.05)
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        ann.put(b'{"do": "st')
        assert "complete within" in (await ann.answer())["refused"]
        assert await ann.gone()


async def test_who_does_not_read_is_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.line_connection._UNREAD_BYTES", 10_000)
    async with port_run(tmp_path) as run, client(run, EVE) as eve, client(run, ANN) as ann:
        assert (await eve.ask(do="watch", period_s=3600))["ok"]
        eve.writer.transport.pause_reading()  # type: ignore[attr-defined]
        events = (from_dict({"kind": "why", "why": "x" * 1000}),) * 10
        for _ in range(500):
            run.tick(events=events)
        await asyncio.sleep(0)
        assert (await ann.ask(do="status"))["ok"]
        eve.writer.transport.resume_reading()  # type: ignore[attr-defined]
        assert await eve.gone()


async def test_too_many_of_one_peer_cost_that_peer(tmp_path: Path) -> None:
    async with (
        port_run(tmp_path) as run,
        client(run, ANN) as ann,
        client(run, EVE) as first,
        client(run, EVE),
        client(run, EVE),
        client(run, EVE),
        client(run, EVE) as last,
    ):
        assert await first.gone(), "the one that was silent longest"
        (refused,) = run.of_kind("refused")
        assert refused["reason"].startswith("too many connections")
        assert (await last.ask(do="status"))["ok"]
        assert (await ann.ask(do="stop"))["ok"]


async def test_too_many_peers_cost_the_one_silent_longest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.server._SESSIONS_MOST", 2)
    async with port_run(tmp_path) as run, client(run, EVE) as eve, client(run, BOB) as bob:
        assert (await eve.ask(do="status"))["ok"]
        async with client(run, ANN) as ann:
            assert await bob.gone()
            assert (await ann.ask(do="stop"))["ok"]
            assert (await eve.ask(do="status"))["ok"]


async def test_an_endpoint_that_fails_opens_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.endpoint._AGAIN_S", 0.01)
    run = PortRun(tmp_path)
    loop = asyncio.get_running_loop()
    accept, failures = loop.sock_accept, [OSError(24, "too many open files"), RuntimeError("bug")]

    async def failing(listener: socket.socket) -> tuple[socket.socket, object]:
        if failures:
            raise failures.pop(0)
        return await accept(listener)

    monkeypatch.setattr(loop, "sock_accept", failing)
    async with run.port.open(), client(run, ANN) as ann:
        assert (await ann.ask(do="status"))["ok"]
    run.close()
    assert [(e["message"], e["again_s"]) for e in run.of_kind("port_failed")] == [
        ("[Errno 24] too many open files", 0.01),
        ("bug", 0.02),
    ]
    assert run.of_kind("port_open") == [{"kind": "port_open", "port": "unix"}]


async def test_the_end_of_the_run_answers_who_waits(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        run.listener.next_peer = ANN
        reader, writer = await asyncio.open_unix_connection(str(run.path))
        await reader.readline()
        run.ticking = False
        writer.write(b'{"do": "stop"}\n')
        await run.somebody_asked()
    assert b"the run is over" in await reader.readline()
    assert await reader.read() == b""
    writer.close()
    await writer.wait_closed()


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.lists(st.binary(max_size=300), min_size=1, max_size=6))
def test_no_bytes_disturb_another_client(tmp_path: Path, chunks: list[bytes]) -> None:
    async def attack() -> None:
        async with port_run(tmp_path) as run, client(run, TOM) as tom, client(run, BOB) as bob:
            for chunk in chunks:
                tom.put(chunk)
                await asyncio.sleep(0)
            assert (await bob.ask(do="stop", number=1))["ok"]
            assert not run.of_kind("port_failed")
            assert [command.kind for command in run.asked] == ["stop"], (
                "no random bytes are a command"
            )

    asyncio.run(attack())


async def test_the_blocking_client(tmp_path: Path) -> None:
    notices: list[str] = []

    def talk() -> tuple[dict[str, object], dict[str, object]]:
        with PortClient.unix(run.path, notices.append) as port_client:
            return port_client.greeting, port_client.ask(do="setpoint", value=2.0, why="client")

    async with port_run(tmp_path) as run:
        greeting, answer = await asyncio.to_thread(talk)
        assert greeting["role"] == "tune"
        assert greeting["run"] == "the-run"
        assert answer["ok"]
        assert run.asked[0].why == "client"
    with pytest.raises(DeviceError, match="no hold is listening"):
        PortClient.unix(run.path, notices.append)


def test_a_client_of_something_else(tmp_path: Path) -> None:
    path = tmp_path / "other.sock"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with socket.socket(socket.AF_UNIX) as caller:
            caller.connect(str(path))
            accepted, _ = other.accept()
            accepted.sendall(b'{"hello": 1}\n')
            with pytest.raises(DeviceError, match="not a control port of membrane-ctrl"):
                PortClient(caller, "there", print)
            accepted.close()


def test_a_client_waits_its_turn_at_a_crowded_port(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as endpoint, socket.socket(socket.AF_UNIX) as first:
        endpoint.bind(str(path))
        endpoint.listen(0)
        first.connect(str(path))  # nobody else fits
        with ThreadPoolExecutor(1) as elsewhere:
            second = elsewhere.submit(PortClient.unix, path, print)
            with endpoint.accept()[0], endpoint.accept()[0] as accepted:
                accepted.sendall(
                    b'{"membrane_ctrl": 1, "run": "r", "you": "unix:ann", "role": "tune"}\n'
                )
                with second.result() as client:
                    assert client.greeting["run"] == "r"


def test_an_endpoint_that_is_flooded_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "membrane_ctrl.control_port.client._kernel_time", lambda _: struct.pack("ll", 0, 50_000)
    )
    with socket.socket(socket.AF_UNIX) as endpoint, socket.socket(socket.AF_UNIX) as first:
        endpoint.bind(str(tmp_path / "control.sock"))
        endpoint.listen(0)
        first.connect(str(tmp_path / "control.sock"))
        with pytest.raises(DeviceError, match="too many connections"):
            PortClient.unix(tmp_path / "control.sock", print)
        before = signal.signal(signal.SIGWINCH, lambda *_: None)
        resize = threading.Timer(
            0.02, os.kill, (os.getpid(), signal.SIGWINCH)
        )  # of the terminal, while one waits
        resize.start()
        with pytest.raises(DeviceError, match="too many connections"):
            PortClient.unix(tmp_path / "control.sock", print)
        resize.join()
        signal.signal(signal.SIGWINCH, before)
