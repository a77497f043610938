"""Safety commands overtake all others of a connection; whatever is not executed is answered with a
reason.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.control_port.fair_queue import FairQueue
from membrane_ctrl.control_port.safety_commands import SAFETY, may_hold_safety_command
from membrane_ctrl.control_port.sender import Peer
from membrane_ctrl.model.telemetry import State
from tests.worlds.port_run import LineClient, PortRun, client, port_run

ANN, BOB = Peer("unix:ann", "operate"), Peer("unix:bob", "operate")
ANSWER_S = 1.0
SAFEST_FIRST = sorted(SAFETY)


@pytest.fixture(autouse=True)
def real_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.request_intake._PAUSE_S", 0.1)


def loop_time_s() -> float:
    """Time in which this process ran or waited: a machine that pauses delays no answer."""
    return asyncio.get_running_loop().time()


def line(**request: object) -> bytes:
    return json.dumps(request).encode() + b"\n"


async def answers_of(ann: LineClient, numbers: set[int]) -> dict[int, dict[str, Any]]:
    """The answers to these requests, in the order in which they come."""
    found: dict[int, dict[str, Any]] = {}
    while not numbers <= set(found):
        answer = await ann.answer()
        found[answer["number"]] = answer
    return found


def kinds(run: PortRun) -> list[str]:
    return [command.kind for command in run.asked]


@pytest.mark.real_time
@pytest.mark.parametrize("kind", SAFEST_FIRST)
@pytest.mark.parametrize("flood", ["quiet", "status", "shape_on"])
async def test_a_safety_command_behind_a_flood_is_answered_within_a_second(
    tmp_path: Path, kind: str, flood: str
) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        begin_s = loop_time_s()
        for number in range(1, 151):
            ann.put(line(do=flood, number=number))
        ann.put(line(do=kind, number=1000))
        answer = (await answers_of(ann, {1000}))[1000]
        assert loop_time_s() - begin_s < ANSWER_S
        assert answer["ok"], answer
        assert kind in kinds(run)


async def test_every_request_of_a_flood_is_answered(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        for number in range(1, 151):
            ann.put(line(do="mark", text=f"mark {number}", number=number))
        found = await answers_of(ann, set(range(1, 151)))
        refused = {number for number, answer in found.items() if not answer["ok"]}
        assert all(
            "requests of this connection wait" in found[number]["refused"] for number in refused
        )
        done = sorted(set(found) - refused)
        assert [command.text for command in run.asked] == [f"mark {number}" for number in done]
        assert len(done) >= 16


@pytest.mark.real_time
async def test_a_flood_without_a_reader_loses_no_stop(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        ann.writer.transport.pause_reading()  # type: ignore[attr-defined]
        begin_s = loop_time_s()
        for number in range(20_000):
            ann.put(line(do="quiet", number=number))
            if number % 500 == 0:
                await ann.writer.drain()
        ann.put(line(do="stop", number=30_000))
        async with asyncio.timeout(10.0):
            while "stop" not in kinds(run):  # noqa: ASYNC110  the tick sets no event
                await asyncio.sleep(0.01)
        assert loop_time_s() - begin_s < 5.0, "the whole flood of 0.7 MB, and the stop behind it"
        ann.writer.transport.resume_reading()  # type: ignore[attr-defined]
        assert (await answers_of(ann, {30_000}))[30_000]["ok"]


@pytest.mark.real_time
async def test_a_flood_of_one_safety_command_does_not_delay_another(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        for number in range(1, 151):
            ann.put(line(do="latch", text=f"hands {number}", number=number))
        ann.put(line(do="stop", number=1000))
        begin_s = loop_time_s()
        found = await answers_of(ann, {150, 1000})
        assert loop_time_s() - begin_s < ANSWER_S
        assert found[1000]["ok"]
        assert "of its kind wait already" in found[150]["refused"]
        assert kinds(run)[0] == "latch"


async def test_the_same_safety_command_twice_is_executed_once_and_answered_twice(
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        ann.put(b"".join(line(do="vent", number=number) for number in (1, 2, 3)))
        found = await answers_of(ann, {1, 2, 3})
        assert all(answer["ok"] for answer in found.values())
        assert len(run.asked) <= 2, (
            "one that was being executed, and one for those that came meanwhile"
        )


@pytest.mark.parametrize("kind", SAFEST_FIRST)
async def test_a_hold_that_waits_is_refused_by_a_later_safety_command(
    tmp_path: Path, kind: str
) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann, client(run, BOB) as bob:
        run.state = State.STANDBY
        ann.put(
            line(do="quiet", number=1)
            + line(do="hold", number=2)
            + line(do="mark", text="kept", number=3)
        )
        await answers_of(ann, {1})
        assert (await bob.ask(do=kind, number=4))["ok"]
        found = await answers_of(ann, {2, 3})
        assert found[2]["refused"] == f"{kind} came meanwhile and takes precedence; send again"
        assert found[3]["ok"]
        assert "hold" not in kinds(run)


async def test_a_stop_before_nonsense_is_executed(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        ann.put(line(do="stop", number=1) + b"x" * 20_000)
        assert (await answers_of(ann, {1}))[1]["ok"]
        assert await ann.gone()


async def test_a_stop_of_a_client_that_leaves_at_once_is_executed(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        async with client(run, ANN) as ann:
            ann.put(line(do="quiet") * 50 + line(do="stop"))
            await ann.writer.drain()
        async with asyncio.timeout(5.0):
            while "stop" not in kinds(run):  # noqa: ASYNC110  the tick sets no event
                await asyncio.sleep(0.01)


@pytest.mark.real_time
async def test_a_stop_with_an_escaped_name_behind_a_flood_is_executed(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        ann.put(line(do="quiet") * 100 + b'{"do": "st\\u006fp", "number": 7}\n')
        begin_s = loop_time_s()
        assert (await answers_of(ann, {7}))[7]["ok"]
        assert loop_time_s() - begin_s < ANSWER_S
        assert "stop" in kinds(run)


@pytest.mark.parametrize("kind", SAFEST_FIRST)
async def test_a_safety_command_needs_no_command_of_the_mirror(tmp_path: Path, kind: str) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann, client(run, BOB) as bob:
        assert (await ann.ask(do="setpoint", value=1.0))["ok"]
        assert (await bob.ask(do=kind))["ok"]
        assert (await ann.ask(do="status"))["status"]["commander"] == "unix:ann"


async def test_an_expired_request_is_refused_unless_it_makes_the_mirror_safe(
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run, client(run, ANN) as ann:
        run.state = State.STANDBY
        now_s = run.now_s
        assert (await ann.ask(do="hold", expires_s=now_s + 1.0))["ok"]
        refused = (await ann.ask(do="hold", expires_s=now_s - 60.0))["refused"]
        assert refused == "hold came 60.0 s after its time limit; send again"
        assert (await ann.ask(do="stop", expires_s=now_s - 60.0))["ok"]
        assert kinds(run) == ["hold", "stop"]


def test_kinds_are_served_in_turn() -> None:
    queue: FairQueue[int] = FairQueue(3)
    assert [queue.put("latch", item) for item in range(4)] == [True, True, True, False]
    assert queue.put("stop", 10)
    assert [queue.take() for _ in range(5)] == [0, 10, 1, 2, None]
    assert len(queue) == 0


@pytest.mark.parametrize("kind", SAFEST_FIRST)
def test_no_line_with_a_safety_command_is_taken_for_another(kind: str) -> None:
    assert may_hold_safety_command(json.dumps({"number": 3, "do": kind}).encode())
    assert may_hold_safety_command(
        b'{"do":"' + "".join(f"\\u{ord(c):04x}" for c in kind).encode() + b'"}'
    )
    assert not may_hold_safety_command(b'{"do": "quiet", "number": 3}')
