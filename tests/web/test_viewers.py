"""Many viewers cost little more than one, and one who does not read is hung up on."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.service import event_lines
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import WorkPool
from membrane_ctrl.sessions.folder import create_session
from membrane_ctrl.sessions.live_log import ANSWER, LiveLog, PageAnswer
from membrane_ctrl.web import hang_up, tuning_panel
from membrane_ctrl.web.made_once import MadeOnce


async def test_what_all_see_is_made_once_and_again_when_it_is_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[tuple[str, int]] = []
    ready = threading.Event()

    def make(name: str, number: int) -> str:
        ready.wait(20.0)
        made.append((name, number))
        return f"{name}{number}"

    shared = MadeOnce(make, WorkPool("test", workers=4, waiting_max=100), life_s=1.0)
    asked = [asyncio.create_task(shared.get("a", 1)) for _ in range(50)]
    leaving = asyncio.create_task(shared.get("a", 1))
    other = asyncio.create_task(shared.get("b", 2))
    await asyncio.sleep(0)
    leaving.cancel()
    monkeypatch.setattr(
        "time.monotonic", lambda: 1e9
    )  # it takes longer than it lives: still made once
    late = asyncio.create_task(shared.get("a", 1))
    await asyncio.sleep(0)
    ready.set()
    assert await asyncio.gather(*asked, late) == ["a1"] * 51
    assert await other == "b2"
    assert sorted(made) == [("a", 1), ("b", 2)]
    monkeypatch.setattr("time.monotonic", lambda: 2e9)
    assert await shared.get("a", 1) == "a1"
    assert sorted(made) == [("a", 1), ("a", 1), ("b", 2)]
    assert len(shared._made) == 1, "what nobody asks for any more is forgotten"


async def test_what_cannot_be_made_is_tried_again() -> None:
    answers = iter([OSError("gone"), "found"])

    def make() -> str:
        answer = next(answers)
        if isinstance(answer, OSError):
            raise answer
        return answer

    shared = MadeOnce(make, WorkPool("test", workers=4, waiting_max=100), life_s=0.0)
    with pytest.raises(OSError, match="gone"):
        await shared.get()
    assert await shared.get() == "found"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ((), ("a", "b"), ("a", "b")),
        (("a",), ("a", "b"), ("b",)),
        (("a", "b"), ("a", "b"), ()),
        (("a", "b", "c"), ("b", "c", "d"), ("d",)),  # the oldest was dropped
        (("a", "a"), ("a", "a", "a"), ("a",)),
        (("a", "b"), ("x", "y"), ("x", "y")),  # another run
        (("a", "b"), (), ()),
    ],
)
def test_only_new_lines_are_shown(
    old: tuple[str, ...], new: tuple[str, ...], expected: tuple[str, ...]
) -> None:
    assert event_lines.find_new_lines(old, new) == expected


@pytest.mark.parametrize("leaves", [True, False])
async def test_a_viewer_who_does_not_read_is_hung_up_on(
    leaves: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(hang_up, "_STUCK_S", 0.01)

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if leaves:
            assert (await receive())["type"] == "websocket.disconnect"
            return
        with pytest.raises(OSError):
            await send({"type": "websocket.send", "text": "an update"})

    async def receive() -> dict[str, Any]:
        return {"type": "websocket.disconnect"}

    async def send(message: Any) -> None:
        await asyncio.Event().wait()  # the transport's buffer is full

    scope = {"type": "websocket", "membrane_user": WebUser("anna", "read")}
    await hang_up.HangUp(app)(scope, receive, send)  # type: ignore[arg-type]
    assert capsys.readouterr().err == (
        "" if leaves else "membrane-ctrl serve: viewer anna does not read: hung up\n"
    )


def test_the_newest_session_is_followed(tmp_path: Path) -> None:
    watch = tuning_panel.SessionWatch(tmp_path)
    assert watch.look() is None
    path = create_session(tmp_path, "first", "eve", "twin", Config(), LoopConfig()).path
    log = LiveLog(path, 50.0, print)
    log.log_entry("step", "observe", planned_s=60.0, after_s=0.0)
    for number in range(300):
        log.log_entry("result", f"line {number}")
    seen = watch.look()
    assert seen is not None
    head = f"{path.name}: Now: observe, 0:00 of about 1:00; 1:00 of holding left in the session"
    assert (seen.head, seen.done) == (head, frozenset())
    log.log_entry("result", "line 300")
    log.log_entry("asks", "apply which?", among=("calm", "lively"))
    (path / "candidates.md").write_text(
        "| candidate | Ms |\n|---|---:|\n| calm | 1.3 |\n| torn\n| lively | 1.6 |\n"
    )
    (path / "identified.json").write_text("{}")
    later = watch.look()
    assert later is not None
    found = event_lines.find_new_lines(seen.progress.results, later.progress.results)
    assert found == ("line 300",)
    assert later.head == f"{path.name}: Waiting for an answer: apply which?"
    assert later.done == {"identify"}
    assert later.candidates == (("candidate", "Ms"), ("calm", "1.3"), ("lively", "1.6"))
    log.log_entry("ended", "stopped")
    second = create_session(tmp_path, "second", "eve", "twin", Config(), LoopConfig()).path
    newest = watch.look()
    assert newest is not None
    doing = "Nothing recorded yet; resume" if second > path else "Ended after observe (stopped)"
    assert newest.head.startswith(f"{max(path, second).name}: {doing}")


def test_an_answer_that_no_session_takes_is_withdrawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(tuning_panel.time, "sleep", slept.append)
    given = PageAnswer("calm", "anna")
    not_taken = tuning_panel.answered(tmp_path, "which?", given)
    assert not_taken.text == "calm: not taken: the session no longer asks; see its terminal"
    assert not not_taken.done
    assert not (tmp_path / ANSWER).exists()
    log = LiveLog(tmp_path, 50.0, print)
    taken: list[PageAnswer | None] = []
    monkeypatch.setattr(
        tuning_panel.time, "sleep", lambda _: taken.append(log.pop_answer("which?", ("calm",)))
    )
    assert tuning_panel.answered(tmp_path, "which?", given).done
    assert taken == [given]
    assert tuning_panel.answered(tmp_path / "none", "which?", given).text.startswith(
        "calm: not given: "
    )
