"""No command with a time limit is obeyed late, whatever hangs; safety commands are obeyed
nevertheless.
"""

from __future__ import annotations

import asyncio
import dataclasses
import socket
import time
from pathlib import Path

import pytest

from membrane_ctrl.bridges import command_lanes
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.send_limits import SendLimits
from tests.bridges.test_bridges import bridge_with, seen_hold
from tests.worlds.port_run import port_run

PATIENCE_S = 30.0  # a machine that runs the tests may pause for seconds


def loop_time_s() -> float:
    """Time in which this process ran or waited."""
    return asyncio.get_running_loop().time()


def limits(seconds: float, refusal: str = "") -> SendLimits:
    return SendLimits(time.monotonic() + seconds, lambda: refusal)


def feed_of(run: str, socket: Path) -> HoldFeed:
    feed = HoldFeed(Where(socket=socket))
    feed.seen = dataclasses.replace(seen_hold(), name=run)
    return feed


@pytest.mark.real_time
async def test_a_hold_that_does_not_greet_gets_no_command_later(tmp_path: Path) -> None:
    """As a hold that is stopped: the kernel accepts the connection, and the hold would read it when
    it goes on.
    """
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as frozen:
        frozen.bind(str(path))
        frozen.listen(8)
        bridge = bridge_with("operate", dataclasses.replace(seen_hold(), name="the-run"), path)
        begin_s = loop_time_s()
        assert "hold refused: not obeyed within 2 s" in await bridge.ask("mqtt", "hold")
        assert loop_time_s() - begin_s < 2.5
        begin_s = loop_time_s()
        assert "latch: no answer from the hold within 0.9 s; still being sent" in await bridge.ask(
            "mqtt", "latch"
        )
        assert loop_time_s() - begin_s < 1.0
        waiting, _ = frozen.accept()  # the hold continues
        waiting.sendall(
            b'{"membrane_ctrl": 1, "run": "the-run", "you": "unix:ann", "role": "tune"}\n'
        )
        waiting.settimeout(PATIENCE_S)
        assert waiting.recv(1000) == b"", "the hold command is not sent any more"
        waiting.close()
        latching, _ = frozen.accept()
        latching.sendall(
            b'{"membrane_ctrl": 1, "run": "the-run", "you": "unix:ann", "role": "tune"}\n'
        )
        latching.settimeout(PATIENCE_S)
        assert b'"do": "latch"' in await asyncio.to_thread(latching.recv, 1000)
        latching.close()
        await bridge.close()


async def test_a_command_that_arrives_after_its_time_is_refused_by_the_hold(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        run.state = State.STANDBY
        feed = feed_of("the-run", tmp_path / "control.sock")
        greeted_s = run.now_s

        def refusal() -> str:  # the hold hangs for a minute, right after its greeting
            run.now_s = greeted_s + 60.0
            return ""

        asked = {"do": "hold", "why": "bridge: mqtt"}
        late = SendLimits(time.monotonic() + 2.0, refusal)
        answer = await asyncio.to_thread(feed.ask, asked, late)
        assert "hold refused: hold came 58" in answer.text
        assert run.asked == []


async def test_a_command_is_not_sent_after_its_deadline_or_another_decision(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        feed = feed_of("the-run", tmp_path / "control.sock")
        for given, message in (
            (limits(-0.1), "the hold answered too late"),
            (limits(2.0, "latch came meanwhile"), "hold refused: latch came meanwhile"),
        ):
            answer = await asyncio.to_thread(feed.ask, {"do": "hold"}, given)
            assert message in answer.text
            assert not answer.done
        other = feed_of("another-run", tmp_path / "control.sock")
        answer = await asyncio.to_thread(other.ask, {"do": "hold"}, limits(2.0))
        assert "another run is listening now" in answer.text
        answer = await asyncio.to_thread(other.ask, {"do": "stop"}, limits(-5.0, "no"))
        assert answer == Outcome.succeeded("stop"), "a safety command has no conditions"
        assert [command.kind for command in run.asked] == ["stop"]


@pytest.mark.real_time
async def test_no_hold_is_answered_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bridge = bridge_with("operate", None, tmp_path / "control.sock")
    for name in ("hold", "latch"):
        begin_s = loop_time_s()
        assert "no hold is listening" in await bridge.ask("mqtt", name)
        assert loop_time_s() - begin_s < command_lanes.SAFETY_ANSWER_S
