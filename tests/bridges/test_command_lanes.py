"""Two lanes to the hold: safety commands at once, all others bounded in number and time; every
sender is answered.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from membrane_ctrl.bridges import command_lanes
from membrane_ctrl.bridges.command_lanes import ORDINARY_MOST, SAFETY_MOST_EACH, CommandLanes
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.safety_commands import SAFETY
from membrane_ctrl.service.send_limits import SendLimits

pytestmark = pytest.mark.usefixtures("slow_answers_allowed")

SAFETY_KINDS = sorted(SAFETY)
PATIENCE_S = 60.0


class FakeHold:
    """Obeys commands, each of which takes some time; `open` lets them through."""

    def __init__(self, takes_s: float = 0.0) -> None:
        self.takes_s = takes_s
        self.open = threading.Event()
        self.open.set()
        self.sent: list[tuple[str, str]] = []
        self.at_once: dict[str, int] = {}
        self.most_at_once = 0
        self._lock = threading.Lock()

    def send(self, request: dict[str, Any], limits: SendLimits) -> Outcome:
        kind = str(request["do"])
        with self._lock:
            self.at_once[kind] = self.at_once.get(kind, 0) + 1
            self.most_at_once = max(self.most_at_once, sum(self.at_once.values()))
        self.open.wait()
        time.sleep(self.takes_s)
        reason = limits.refusal() or ("too late" if time.monotonic() > limits.deadline_s else "")
        with self._lock:
            self.at_once[kind] -= 1
            if not reason:
                self.sent.append((kind, str(request.get("text", ""))))
        return Outcome.refused(kind, reason) if reason else Outcome.succeeded(kind)


def lanes_to(hold: FakeHold, late: list[Outcome] | None = None) -> CommandLanes:
    return CommandLanes(hold.send, [].append if late is None else late.append)


async def texts_of(outcomes: Iterable[asyncio.Future[Outcome]]) -> list[str]:
    return [outcome.text for outcome in await asyncio.gather(*outcomes)]


async def wait_for(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110  the condition changes on another thread
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("kind", SAFETY_KINDS)
async def test_a_safety_command_overtakes_a_crowd_and_the_crowd_is_answered(kind: str) -> None:
    hold = FakeHold()
    hold.open.clear()  # no command ends before the safety command is at the hold
    lanes = lanes_to(hold)
    crowd = [lanes.submit({"do": "mark", "text": "x"}) for _ in range(150)]
    safe = lanes.submit({"do": kind})
    await wait_for(lambda: hold.at_once.get(kind) == 1)
    hold.open.set()
    assert (await safe).text == f"{kind}: done"
    answers = await texts_of(crowd)
    refused = [answer for answer in answers if "too many commands at once" in answer]
    assert len(refused) == 150 - ORDINARY_MOST
    assert hold.most_at_once <= 2, (
        "one connection a lane: the port drops connections of a user that has too many"
    )


async def test_ordinary_commands_keep_their_order_one_at_a_time() -> None:
    hold = FakeHold()
    lanes = lanes_to(hold)
    await asyncio.gather(
        *(lanes.submit({"do": "mark", "text": str(number)}) for number in range(ORDINARY_MOST))
    )
    assert hold.sent == [("mark", str(number)) for number in range(ORDINARY_MOST)]
    assert hold.most_at_once == 1


@pytest.mark.parametrize("kind", SAFETY_KINDS)
async def test_a_waiting_hold_is_refused_by_a_later_safety_command(kind: str) -> None:
    hold = FakeHold(takes_s=0.02)
    lanes = lanes_to(hold)
    under_way = lanes.submit({"do": "hold"})
    waiting = [lanes.submit({"do": do}) for do in ("resume", "setpoint", "hold")]
    mark = lanes.submit({"do": "mark", "text": "kept"})
    await asyncio.sleep(0.005)
    safe = lanes.submit({"do": kind})
    answers = await texts_of((under_way, *waiting))
    assert all("takes precedence; send again" in answer for answer in answers), answers
    assert await texts_of((mark, safe)) == ["mark: done", f"{kind}: done"]
    assert set(hold.sent) == {(kind, ""), ("mark", "kept")}


async def test_a_command_that_waits_too_long_is_refused_and_never_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command_lanes, "TIME_LIMIT_S", 0.1)
    hold = FakeHold()
    hold.open.clear()
    lanes = lanes_to(hold)
    answers = [lanes.submit({"do": "hold"}) for _ in range(3)]
    assert all("not obeyed within 0.1 s" in answer for answer in await texts_of(answers))
    hold.open.set()
    assert (await lanes.submit({"do": "mark", "text": "now"})).done
    assert hold.sent == [("mark", "now")]


async def test_a_hold_that_hangs_delays_no_answer_and_gets_the_latch_as_soon_as_it_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command_lanes, "SAFETY_ANSWER_S", 0.1)
    hold, late = FakeHold(), list[Outcome]()
    hold.open.clear()
    lanes = lanes_to(hold, late)
    for kind in ("latch", "stop"):
        outcome = await lanes.submit({"do": kind})
        assert "no answer from the hold within 0.1 s" in outcome.text
    hold.open.set()
    await wait_for(lambda: len(late) == 2)
    assert [(outcome.command, outcome.done) for outcome in late] == [
        ("latch", True),
        ("stop", True),
    ]


async def test_a_flood_of_latches_does_not_delay_a_stop() -> None:
    hold = FakeHold(takes_s=0.05)
    lanes = lanes_to(hold)
    flood = [lanes.submit({"do": "latch", "text": str(number)}) for number in range(200)]
    assert (await lanes.submit({"do": "stop"})).text == "stop: done"
    assert hold.sent.index(("stop", "")) <= SAFETY_MOST_EACH
    answers = await texts_of(flood)
    assert sum(answer == "latch: done" for answer in answers) >= SAFETY_MOST_EACH
    assert all(
        answer == "latch: done" or "wait already; send again" in answer for answer in answers
    )


async def test_the_same_latch_of_many_is_sent_a_few_times_only() -> None:
    hold = FakeHold(takes_s=0.02)
    lanes = lanes_to(hold)
    answers = await texts_of(lanes.submit({"do": "latch", "text": "hands"}) for _ in range(1000))
    assert all(answer == "latch: done" or "is being sent" in answer for answer in answers)
    assert len(hold.sent) <= 2


async def test_an_error_of_the_sender_is_an_answer_and_the_lanes_go_on() -> None:
    calls = 0

    def send(request: dict[str, Any], limits: SendLimits) -> Outcome:
        nonlocal calls
        calls += 1
        if calls <= 2:
            raise RuntimeError("bug")
        return Outcome.succeeded(str(request["do"]))

    lanes = CommandLanes(send, [].append)
    for kind in ("mark", "stop"):
        assert await lanes.submit({"do": kind}) == Outcome(
            kind, f"{kind}: not sent: RuntimeError: bug"
        )
    for kind in ("mark", "stop"):
        assert await lanes.submit({"do": kind}) == Outcome.succeeded(kind)
