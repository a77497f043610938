"""The feed follows a port that is real, whatever becomes of it; buttons ask for what the viewer may
ask.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.protocol import encode, parse
from membrane_ctrl.control_port.status_lines import alarm_lines
from membrane_ctrl.controller.commands import TABLE
from membrane_ctrl.model.event_base import Event
from membrane_ctrl.model.run_events import Mark
from membrane_ctrl.processes.published_rings import publish_rings
from membrane_ctrl.processes.ring import RingWriter, open_ring
from membrane_ctrl.service.access import (
    ACTIONS,
    STOP,
    UNLOCK,
    is_action_allowed,
    on_behalf,
    request,
)
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.web_user import WebUser
from tests.worlds.port_run import ROW, port_run

_LOOK_S = 0.02


async def until(true: Callable[[], object]) -> None:
    async with asyncio.timeout(20.0):
        while not true():  # noqa: ASYNC110
            await asyncio.sleep(_LOOK_S)


async def test_a_hold_is_followed_asked_and_found_again(tmp_path: Path) -> None:
    feed = HoldFeed(Where(socket=tmp_path / "control.sock"))
    assert feed.seen.silent
    feed.open()
    try:
        async with port_run(tmp_path) as run:
            await until(lambda: not feed.seen.silent)
            assert feed.seen.name == "the-run"
            assert feed.seen.status["row"]["error_um"] == ROW.error_um
            assert feed.seen.role == "tune"
            answer = await asyncio.to_thread(feed.ask, {"do": "pause", "why": "web: anna"})
            assert answer == Outcome.succeeded("pause")
            assert [(command.kind, command.why) for command in run.asked] == [
                ("pause", "web: anna")
            ]
            refused = await asyncio.to_thread(feed.ask, {"do": "setpoint", "value": 1e9})
            assert refused.text.startswith(
                "setpoint refused: setpoint 1e+09 µm is outside the limits"
            )
            run.port.note_report(Mark("door <b>opened</b>", "anna"))
            await until(lambda: any("door" in line for line in feed.seen.events))
            assert [text for _, text in feed.marks] == ["door <b>opened</b>"]
        await until(lambda: feed.seen.silent)
        assert not is_action_allowed(WebUser("anna", "tune"), feed.seen.role, STOP), (
            "no role without a port"
        )
        async with port_run(tmp_path):
            await until(lambda: not feed.seen.silent)
    finally:
        await asyncio.to_thread(feed.close)
    assert not feed._thread.is_alive()


def _line_of(at_s: int, event: Event) -> dict[str, object]:
    moment = datetime(2026, 1, 2, tzinfo=UTC) + timedelta(seconds=at_s)
    return {"time_utc": moment.isoformat(), "mono_s": float(at_s), **event.to_dict()}


async def test_a_service_that_starts_during_a_run_shows_its_events_each_once(
    tmp_path: Path,
) -> None:
    """The file is longer than what is read of it, and its end is in the ring, too."""
    folder = tmp_path / "the-run"
    folder.mkdir()
    past = [_line_of(at_s, Mark(f"mark {at_s} {'x' * 200}", "anna")) for at_s in range(2000)]
    in_file, in_ring = past[:-2], past[-6:]
    (folder / "events.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in in_file))
    feed = HoldFeed(Where(logs=tmp_path))
    with ExitStack() as stack:
        address = stack.enter_context(open_ring(64, 4096))
        publish_rings(folder, {"events": address}, stack)
        writer = RingWriter(address)
        stack.callback(writer.close)
        for line in in_ring:
            writer.put(json.dumps(line).encode())
        async with port_run(tmp_path) as run:
            feed.open()
            try:
                await until(lambda: not feed.seen.silent)
                lines = feed.seen.events
                assert [int(line.split("mark ")[1].split()[0]) for line in lines] == [
                    *range(1800, 2000)
                ]
                assert lines[-1].startswith("01-02 00:33:19 UTC  "), "of the event, not of now"
                assert not feed.marks, "marks before the contact are read from the runs"
                # a hold sends each event to the ring and to the port
                new = Mark("door opened", "anna")
                moment = {"time_utc": datetime.now(UTC).isoformat(), "mono_s": 2000.0}
                writer.put(json.dumps(moment | new.to_dict()).encode())
                run.port.note_report(new)
                await until(lambda: "door opened" in feed.seen.events[-1])
                run.port.note_report(Mark("on the port alone", "anna"))
                run.tick()
                status = feed.seen.status
                await until(lambda: feed.seen.status is not status)
                assert sum("door opened" in line for line in feed.seen.events) == 1
                assert [text for _, text in feed.marks] == ["door opened"]
            finally:
                await asyncio.to_thread(feed.close)


async def test_a_command_for_the_last_run_does_not_reach_the_next(tmp_path: Path) -> None:
    feed = HoldFeed(Where(socket=tmp_path / "control.sock"))
    feed.seen = dataclasses.replace(feed.seen, name="an-earlier-run")
    async with port_run(tmp_path) as run:
        answer = await asyncio.to_thread(feed.ask, {"do": "pause"})
        assert "another run" in answer.text
        assert run.asked == []
        answer = await asyncio.to_thread(feed.ask, {"do": "stop"})
        assert answer == Outcome.succeeded("stop"), "whatever runs there becomes safe"


async def test_without_a_hold_the_answer_states_it(tmp_path: Path) -> None:
    feed = HoldFeed(Where(socket=tmp_path / "none.sock"))
    outcome = await asyncio.to_thread(feed.ask, {"do": "hold"})
    assert "no hold is listening" in outcome.text
    assert not outcome.done


def test_every_action_is_one_that_the_port_reads() -> None:
    given = {"number": "3.5", "text": "why not", "": ""}
    for action in (*ACTIONS, UNLOCK, STOP):
        asked = request(action, "web: anna", given[action.asks])
        read = parse(encode({**asked, "number": 1}))
        assert read.do == action.do
        assert read.why == "web: anna"
    offered = {action.do for action in (*ACTIONS, UNLOCK, STOP)}
    assert set(TABLE) - offered == {"gains", "tune"}, "these take a file: they are not for a button"


def test_what_the_page_states_of_a_viewer_is_read_by_the_port_and_a_link_is_no_account() -> None:
    for has_login, account in ((True, "anna"), (False, "")):
        user = WebUser("anna", "operate", has_login=has_login)
        asked = {
            **request(UNLOCK, "web: anna", "bofak"),
            "on_behalf": on_behalf(user, "page 1f"),
            "number": 1,
        }
        read = parse(encode(asked))
        assert read.text == "bofak"
        assert read.on_behalf is not None
        assert (read.on_behalf.account, read.on_behalf.role, read.on_behalf.via) == (
            account,
            "operate",
            "page",
        )


def test_locks_come_first_among_the_alarms() -> None:
    lock = {"word": "bofak", "text": "hands inside", "author": "unix:ann", "set_utc": "2026-01-02"}
    fault = {"code": 51, "name": "locked", "cause": "a lock", "remedy": "ask"}
    notice = {
        "topic": "recorder",
        "subject": "disk",
        "severity": "warning",
        "text": "Disk almost full",
    }
    shown = alarm_lines(
        {"locks": [lock, {**lock, "word": "gumil"}], "fault": fault, "notices": [notice]}
    )
    assert shown == [
        'LOCKED "hands inside" by unix:ann, 2026-01-02, word bofak',
        'LOCKED "hands inside" by unix:ann, 2026-01-02, word gumil',
        "FAULT 51 locked: a lock; ask",
        "Disk almost full",
    ]
    assert alarm_lines({"locks": [], "fault": None, "notices": []}) == []


@pytest.mark.parametrize(
    ("user", "port", "allowed"),
    [
        ("tune", "tune", True),
        ("read", "tune", False),
        ("tune", "read", False),
        ("operate", "operate", True),
    ],
)
def test_the_lesser_of_both_roles_counts(user: str, port: str, allowed: bool) -> None:
    assert is_action_allowed(WebUser("anna", user), port, STOP) is allowed  # type: ignore[arg-type]
    keep = next(action for action in ACTIONS if action.do == "keep")
    assert is_action_allowed(WebUser("anna", "operate"), "tune", keep) is False


@pytest.mark.parametrize(
    "text", ["", "x", "nan", "inf", "1e999", "1;2", "1,000", "3,5", "1_0", "\u0663", "0x10", " 1"]
)
def test_what_is_no_number_is_not_sent(text: str) -> None:
    setpoint = next(action for action in ACTIONS if action.do == "setpoint")
    with pytest.raises(ValueError, match="Setpoint: enter a"):
        request(setpoint, "web: anna", text)
