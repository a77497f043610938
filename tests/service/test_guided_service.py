"""The guided session behind the page: one question, one answer, whatever a browser sends."""

from __future__ import annotations

import io
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from membrane_ctrl.commissioning.guide.command import commission_named
from membrane_ctrl.commissioning.guide.session_state import read_state
from membrane_ctrl.model.errors import DeviceError, InputError
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


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Path]:
    """What systemd does for `membrane-commission.socket`: one program a connection."""
    path = tmp_path / "listener"
    sessions = tmp_path / "sessions"
    sessions.mkdir()
    program = [sys.executable, "-m", "membrane_ctrl"]
    words = [*program, "commission", str(sessions), "--named-by-input"]
    processes = []
    with socket.socket(socket.AF_UNIX) as waiting:
        waiting.bind(str(path))
        waiting.listen()

        def serve() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = waiting.accept()
                    with connection:
                        processes.append(
                            subprocess.Popen(
                                words, stdin=connection.fileno(), stdout=connection.fileno()
                            )
                        )

        threading.Thread(target=serve, daemon=True).start()
        yield path
        waiting.shutdown(socket.SHUT_RDWR)
    for process in processes:
        assert process.wait(PATIENCE_S) == 130


def test_under_systemd_a_session_at_the_bench_is_a_unit(tmp_path: Path, listener: Path) -> None:
    sessions = tmp_path / "sessions"
    session = GuidedSession(sessions, units=True, unit_socket=listener)
    session.start("lab-1", simulated=False, who="ann")
    seen = wait_for(session, is_asked("mirror.preset"))
    assert seen.question is not None
    session.answer(seen.question.number, "paper", "ann")
    wait_for(session, is_asked("mirror.change"))
    session.close()
    assert session.seen.ended.startswith("lab-1: stopped; start it again")
    state = read_state(sessions / "lab-1")
    assert state is not None
    assert not state.simulated


def test_a_unit_that_is_not_installed_is_explained(tmp_path: Path) -> None:
    session = GuidedSession(tmp_path, units=True, unit_socket=tmp_path / "nothing")
    with pytest.raises(DeviceError, match="service install"):
        session.start("lab-1", simulated=False, who="ann")
    assert not session.seen.is_running
    session.close()


@pytest.mark.parametrize("line", ["", "x", '{"session": "../etc"}', '{"session": "a/b"}'])
def test_only_a_plain_name_begins_a_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"{line}\n"))
    with pytest.raises(InputError, match="names no session"):
        commission_named(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_fails_is_explained(tmp_path: Path) -> None:
    failing = [sys.executable, "-c", "import sys; sys.exit('no such device')"]
    session = GuidedSession(tmp_path, command=failing)
    session.start("lab-1", simulated=False, who="ann")
    seen = wait_for(session, lambda seen: not seen.is_running)
    assert seen.ended == "lab-1: ended with code 1: no such device"
    session.close()
