"""The guided session behind the page: one question, one answer, whatever a browser sends."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.service.guided_session import GuidedSession, SeenSession
from tests.worlds import small_session

PATIENCE_S = 60.0  # for a program that starts on a busy machine
PROGRAM = [sys.executable, str(small_session.__file__)]


@pytest.fixture
def guided(tmp_path: Path) -> Iterator[GuidedSession]:
    session = GuidedSession(tmp_path, command=PROGRAM)
    yield session
    session.close()


def wait_for(session: GuidedSession, is_right: Callable[[SeenSession], bool]) -> SeenSession:
    until_s = time.monotonic() + PATIENCE_S
    while not is_right(session.seen):
        assert time.monotonic() < until_s, session.seen
        time.sleep(0.01)
    return session.seen


def is_asked(key: str) -> Callable[[SeenSession], bool]:
    return lambda seen: seen.question is not None and seen.question.question.key == key


def told_in(folder: Path) -> list[str]:
    return (folder / "told.txt").read_text().splitlines()


def test_a_confirmation_acts_once(guided: GuidedSession, tmp_path: Path) -> None:
    guided.start("lab-1", simulated=True, who="ann")
    seen = wait_for(guided, is_asked("fill"))
    assert seen.question is not None
    number = seen.question.number
    guided.answer(number, "y", "ann")
    with pytest.raises(InputError, match="answered already"):
        guided.answer(number, "y", "ann")  # a second click, or a form sent again
    wait_for(guided, is_asked("more"))
    with pytest.raises(InputError, match="answered already"):
        guided.answer(number, "y", "ann")  # a page from before a reload
    assert told_in(tmp_path / "lab-1") == ["fill y"]
    assert [message.kind for message in guided.seen.messages] == ["stage", "check", "line"]


def test_a_stop_reaches_a_stage_that_runs(guided: GuidedSession, tmp_path: Path) -> None:
    guided.start("lab-1", simulated=True, who="ann")
    for key in ("fill", "more"):
        seen = wait_for(guided, is_asked(key))
        assert seen.question is not None
        guided.answer(seen.question.number, "y", "ann")
    guided.stop("bob")
    seen = wait_for(guided, lambda seen: not seen.is_running)
    assert seen.ended.startswith("lab-1: stopped")
    assert told_in(tmp_path / "lab-1")[-1] == "stopped safely"


def test_a_service_from_the_background_of_a_shell_can_stop_a_session(tmp_path: Path) -> None:
    """Such a shell lets its programs ignore SIGINT, and all that they start."""
    ignoring = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); "
    starting = "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    session = GuidedSession(
        tmp_path, command=[sys.executable, "-c", ignoring + starting, *PROGRAM[1:]]
    )
    session.start("lab-1", simulated=True, who="ann")
    wait_for(session, is_asked("fill"))
    session.stop("bob")
    wait_for(session, lambda seen: not seen.is_running)
    assert told_in(tmp_path / "lab-1") == ["stopped safely"]
    session.close()


def test_the_end_of_the_service_stops_the_session(guided: GuidedSession, tmp_path: Path) -> None:
    guided.start("lab-1", simulated=True, who="ann")
    wait_for(guided, is_asked("fill"))
    guided.close()
    assert told_in(tmp_path / "lab-1") == ["stopped safely"]


def test_one_session_at_a_time(guided: GuidedSession) -> None:
    guided.start("lab-1", simulated=True, who="ann")
    wait_for(guided, is_asked("fill"))
    with pytest.raises(InputError, match="lab-1 runs"):
        guided.start("lab-2", simulated=True, who="bob")


@pytest.mark.parametrize("name", ["", "..", "../lab", "a/b", "a b"])
def test_only_plain_names_are_taken(guided: GuidedSession, name: str) -> None:
    with pytest.raises(InputError, match="not the name of a session"):
        guided.start(name, simulated=True, who="ann")


def test_a_link_is_not_followed(guided: GuidedSession, tmp_path: Path) -> None:
    (tmp_path / "lab-1").symlink_to("/etc")
    with pytest.raises(InputError, match="not the name of a session"):
        guided.start("lab-1", simulated=True, who="ann")


def test_a_service_without_access_to_devices_names_the_terminal(tmp_path: Path) -> None:
    session = GuidedSession(tmp_path, units=True, command=PROGRAM)
    with pytest.raises(InputError, match="in a terminal"):
        session.start("lab-1", simulated=False, who="ann")
    session.close()


def test_a_program_that_fails_is_explained(tmp_path: Path) -> None:
    failing = [sys.executable, "-c", "import sys; sys.exit('no such device')"]
    session = GuidedSession(tmp_path, command=failing)
    session.start("lab-1", simulated=False, who="ann")
    seen = wait_for(session, lambda seen: not seen.is_running)
    assert seen.ended == "lab-1: ended with code 1: no such device"
    session.close()
