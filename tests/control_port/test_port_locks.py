"""Locks through the port: who is an author, for whom the page may speak, and what the answer
confirms.
"""

from __future__ import annotations

import json
import os
import socket
import struct
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.control_port import server
from membrane_ctrl.control_port.ctl import fleet_line, status_lines
from membrane_ctrl.control_port.protocol import OnBehalf, parse
from membrane_ctrl.control_port.sender import Peer, sender_of
from membrane_ctrl.control_port.status import status_table
from membrane_ctrl.control_port.status_lines import lock_lines
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.events import LockRemoved, LockSet
from membrane_ctrl.model.run_events import LockNotStored, LockStored
from membrane_ctrl.model.run_status import RunStatus
from tests.worlds.port_run import LineClient, PortRun, client, port_run

HOLD = Peer("unix:membrane", "tune", 1, is_own_user=True)
ANN = Peer("unix:ann", "operate", 2)
BEHALF = {"via": "page", "account": "bob", "name": "bob", "session": "page 1f", "role": "operate"}


async def taken(run: PortRun, who: Peer, **request: Any) -> Command:
    """The command that a request becomes."""
    async with client(run, who) as asker:
        await asker.ask(**request)
    return run.asked[-1]


async def test_a_lock_has_its_author_session_word_and_time_as_inputs_of_the_tick(
    tmp_path: Path,
) -> None:
    async with port_run(tmp_path) as run:
        lock = (await taken(run, ANN, do="lock", text="hands inside", number=1)).lock
        assert lock is not None
        assert (lock.text, lock.author, lock.account, lock.session) == (
            "hands inside",
            "unix:ann",
            "unix:ann",
            "process 2",
        )
        assert len(lock.word) == 5
        assert lock.set_utc.endswith("+00:00")


async def test_the_page_acts_for_its_viewer_and_the_lower_role_counts(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        command = await taken(run, HOLD, do="latch", text="x", on_behalf=BEHALF)
        assert command.who == "page:bob"
        assert command.lock is not None
        assert (command.lock.account, command.lock.session) == ("page:bob", "page 1f")
        command = await taken(run, HOLD, do="unlock", on_behalf=BEHALF)
        assert (command.who, command.account, command.from_person) == ("page:bob", "page:bob", True)
        run.asked.clear()
        async with client(run, HOLD) as page:
            for role, do in (
                ("read", "hold"),
                ("read", "stop"),
                ("read", "unlock"),
                ("operate", "keep"),
            ):
                answer = await page.ask(do=do, on_behalf=BEHALF | {"role": role})
                assert f"page:bob has {role}" in answer["refused"]
        assert run.asked == []


@pytest.mark.parametrize("stated", [{}, {"name": "link", "account": ""}])
async def test_an_account_is_accepted_from_the_holds_own_user_only(
    tmp_path: Path, stated: dict[str, str]
) -> None:
    async with port_run(tmp_path) as run:
        who = ANN if not stated else HOLD
        command = await taken(run, who, do="unlock", text="bofak", on_behalf=BEHALF | stated)
        assert command.account == ""
        assert command.from_person
        command = await taken(run, who, do="latch", on_behalf=BEHALF | stated)
        assert command.lock is not None
        assert command.lock.account == ""


async def test_a_peer_cannot_raise_its_role(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run, client(run, Peer("unix:eve", "read")) as eve:
        answer = await eve.ask(do="stop", on_behalf=BEHALF | {"role": "tune"})
        assert "has read" in answer["refused"]
        assert run.asked == []


def test_a_bridge_is_no_author_and_no_person() -> None:
    bridge = OnBehalf.model_validate(
        {"via": "bridge", "account": "membrane", "name": "mqtt", "role": "operate"}
    )
    sender = sender_of(HOLD, bridge)
    assert (sender.account, sender.from_person) == ("", False)
    assert not sender_of(ANN, bridge).from_person
    assert sender_of(ANN, None).account == "unix:ann"


@pytest.mark.parametrize(
    "wrong",
    [
        {"via": "ctl"},
        {"role": "owner"},
        {"account": "a" * 100},
        {"account": "a\nb"},
        {"admin": True},
    ],
)
def test_what_cannot_be_stated_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="on_behalf"):
        parse(json.dumps({"do": "stop", "on_behalf": BEHALF | wrong}).encode())


async def test_the_kernel_decides_who_is_the_holds_own_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with port_run(tmp_path) as run:
        near, far = socket.socketpair(socket.AF_UNIX)
        with near, far:
            peer = run.listener.peer(near)
            assert peer.is_own_user
            assert peer.session == f"process {os.getpid()}"
            for uid in (os.getuid() + 1, 0):
                monkeypatch.setattr(server.sockets, "_CREDENTIALS", Credentials(uid))
                assert run.listener.peer(near).is_own_user == (uid == os.getuid())


class Credentials:
    """What the kernel says of another user's process."""

    size = struct.Struct("3i").size

    def __init__(self, uid: int) -> None:
        self._uid = uid

    def unpack(self, _: bytes) -> tuple[int, int, int]:
        return 7, self._uid, self._uid


async def confirmed(run: PortRun, asker: LineClient, outcome: Future[str] | None) -> dict[str, Any]:
    """The answer to a lock whose storing has this outcome."""
    run.ticking = False
    asker.put(b'{"do": "latch", "text": "hands inside", "number": 5}\n')
    await run.somebody_asked()
    command = run.asked[-1]
    if outcome is not None:
        run.outcomes[command.number] = outcome
    assert command.lock is not None
    lock = command.lock
    event = LockSet(
        lock.word, lock.text, lock.author, lock.account, lock.session, lock.set_utc, command.number
    )
    run.tick((event,), ((command.number, ""),))
    return await asker.answer()


async def test_the_answer_confirms_only_what_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_STORE_S", 0.05)
    stored: Future[str] = Future()
    stored.set_result("")
    full: Future[str] = Future()
    full.set_result("no space left on device")
    cases: list[tuple[Future[str] | None, object, str]] = [
        (stored, True, ""),
        (full, False, "no space left on device"),
        (Future(), False, "has not confirmed"),
        (None, None, ""),
    ]
    for number, (outcome, expected, problem) in enumerate(cases):
        folder = tmp_path / str(number)
        folder.mkdir()
        async with port_run(folder) as run, client(run, ANN) as ann:
            answer = await confirmed(run, ann, outcome)
            assert answer["ok"]
            assert answer["lock"]["word"] == run.asked[-1].lock.word  # type: ignore[union-attr]
            assert answer.get("stored") is expected
            assert problem in answer.get("problem", "")


async def test_a_lock_and_its_removal_need_no_command(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        await taken(run, ANN, do="setpoint", value=1.0)
        assert (await taken(run, Peer("unix:bob", "operate"), do="latch")).who == "unix:bob"
        assert (await taken(run, Peer("unix:bob", "operate"), do="unlock")).who == "unix:bob"


def test_every_display_of_the_state_shows_all_locks() -> None:
    status = RunStatus()
    for word, author in (("bofak", "unix:ann"), ("gumil", "page:bob")):
        status = status.after_event(
            LockSet(word, "hands inside", author, author, "s", "2026-01-02T03:04:05+00:00", 1)
        )
    status = status.after_event(LockNotStored("gumil", "no space left"))
    from tests.worlds.port_run import ROW

    table = {"run": "r", **status_table(status.after_row(ROW))}
    first, second = lock_lines(table)
    for part in ('"hands inside"', "unix:ann", "bofak", "2026-01-02"):
        assert part in first
    assert "NOT STORED: no space left" in second
    assert [line for line in status_lines(table) if line.startswith("LOCKED")] == [
        f"LOCKED {first}",
        f"LOCKED {second}",
    ]
    assert f"LOCKED {first}" in fleet_line(table)
    status = status.after_event(LockStored("gumil"))
    status = status.after_event(LockRemoved("bofak", "", "", "", "", "word", 0))
    (line,) = lock_lines(status_table(status.after_row(ROW)))
    assert "gumil" in line
    assert "NOT STORED" not in line
