"""Keys: what they ask for, what is a question first, and the terminal that they leave behind."""

from __future__ import annotations

import json
import os
import pty
import socket
import termios
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing
from pathlib import Path

import pytest

from membrane_ctrl.console.key_reader import Keyboard, KeyReader
from membrane_ctrl.console.keys import Desk
from membrane_ctrl.console.requests import Request, send_request
from membrane_ctrl.model import job_control


class Port:
    """Takes what a desk asks for, and answers at once."""

    def __init__(self, answer: str = "done") -> None:
        self.asked: list[Request] = []
        self._answer = answer

    def __call__(self, request: Request) -> Future[str]:
        self.asked.append(request)
        future: Future[str] = Future()
        future.set_result(f"{request['do']}: {self._answer}")
        return future


def typed(*texts: str, paused: bool = False) -> tuple[Desk, list[Request]]:
    port = Port()
    desk = Desk(port)
    for text in texts:
        desk.process_keys(text, paused)
    return desk, port.asked


@pytest.mark.parametrize(
    ("texts", "paused", "asked"),
    [
        (["h"], False, [{"do": "hold"}]),
        (["H"], False, [{"do": "hold"}]),
        (["p"], False, [{"do": "pause"}]),
        (["p"], True, [{"do": "resume"}]),
        (["s", "y"], False, [{"do": "stop"}]),
        (["s", "n"], False, []),
        (["s", "\r"], False, []),
        (["sy"], False, []),  # a paste
        (["hs", "y"], False, [{"do": "hold"}]),
        (["s", "ny"], False, []),
        (["s", "s", "y"], False, []),  # the second key has answered the question
        (["m", "door\r"], False, [{"do": "mark", "text": "door"}]),
        (["m", "do", "xx\x7f\x7for", "\r"], False, [{"do": "mark", "text": "door"}]),
        (["m", "hello\x1b", "h"], False, [{"do": "hold"}]),
        (["m", "  \r"], False, []),
        (
            ["m", "one\nsy", "y"],
            False,
            [{"do": "mark", "text": "one"}],
        ),  # the rest of a paste is no command
        (["m", "a\x07b\tc\r"], False, [{"do": "mark", "text": "abc"}]),
        (["m", "x" * 300, "\r"], False, [{"do": "mark", "text": "x" * 200}]),
        (["x", " ", "\x1a", "?", ""], False, []),
    ],
)
def test_each_key_sends_its_request(texts: list[str], paused: bool, asked: list[Request]) -> None:
    assert typed(*texts, paused=paused)[1] == asked


def test_the_last_line_shows_question_text_and_answer() -> None:
    desk = Desk(Port("refused: not now"))
    assert "h hold" in desk.bottom_line
    assert not desk.is_asking
    desk.process_keys("s", False)
    assert desk.is_asking
    assert "stop the run?" in desk.bottom_line
    desk.process_keys("x", False)
    assert "not stopped" in desk.bottom_line
    desk.process_keys("m", False)
    desk.process_keys("door", False)
    assert "mark: door" in desk.bottom_line
    desk.process_keys("\r", False)
    assert desk.bottom_line.startswith("mark: refused: not now")
    desk.process_keys("\x1a", False)
    assert "Ctrl-Z" in desk.bottom_line
    assert not desk.help
    desk.process_keys("?", False)
    assert desk.help


def test_until_the_answer_comes_it_waits() -> None:
    answer: Future[str] = Future()
    desk = Desk(lambda request: answer)
    desk.process_keys("h", False)
    assert desk.bottom_line.startswith("hold: waiting")
    answer.set_result("hold: done")
    assert desk.bottom_line.startswith("hold: done")


@pytest.fixture
def terminal_ends() -> Iterator[tuple[int, int]]:
    ours, theirs = pty.openpty()
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


def keyboard(theirs: int) -> Keyboard:
    return Keyboard(os.ttyname(theirs), termios.tcgetattr(theirs))


def echoes(handle: int) -> bool:
    return bool(termios.tcgetattr(handle)[3] & termios.ECHO)


def test_keys_come_one_by_one_and_the_modes_come_back(terminal_ends: tuple[int, int]) -> None:
    ours, theirs = terminal_ends
    with closing(KeyReader(keyboard(theirs))) as reader:
        assert reader.read() == ""
        assert not echoes(theirs)
        os.write(ours, "hö\x1b[A\x1bOPs\x1a".encode())
        assert reader.read() == "hös\x1a"  # without arrows and function keys
    modes = termios.tcgetattr(theirs)
    assert echoes(theirs)
    assert modes[6][termios.VSUSP] == b"\x1a"


def test_a_letter_split_between_two_looks_arrives(terminal_ends: tuple[int, int]) -> None:
    ours, theirs = terminal_ends
    with closing(KeyReader(keyboard(theirs))) as reader:
        reader.read()
        os.write(ours, b"\xc3")
        assert reader.read() == ""
        os.write(ours, b"\xb6")
        assert reader.read() == "ö"


def test_in_the_background_the_terminal_is_left_alone(
    terminal_ends: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = terminal_ends
    with closing(KeyReader(keyboard(theirs))) as reader:
        monkeypatch.setattr(job_control, "in_foreground", lambda handle: False)
        os.write(ours, b"h\n")
        assert reader.read() == ""
        assert echoes(theirs)
        monkeypatch.setattr(job_control, "in_foreground", lambda handle: True)
        reader.read()
        assert not echoes(theirs)


def test_modes_that_a_shell_has_set_meanwhile_stay(terminal_ends: tuple[int, int]) -> None:
    _, theirs = terminal_ends
    with closing(KeyReader(keyboard(theirs))) as reader:
        reader.read()
        of_shell = termios.tcgetattr(theirs)
        of_shell[6][termios.VSUSP] = b"\x1a"  # a line editor: no echo, but Ctrl-Z
        termios.tcsetattr(theirs, termios.TCSANOW, of_shell)
    assert not echoes(theirs)


def test_without_a_terminal_on_stdin_there_is_no_keyboard(
    terminal_ends: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def name(handle: int) -> str:
        if handle == 0:
            raise OSError(25, "not a terminal")
        return "/dev/pts/7"

    monkeypatch.setattr(os, "ttyname", name)
    assert Keyboard.of_stdin() is None
    monkeypatch.setattr(os, "ttyname", lambda handle: f"/dev/pts/{handle}")
    assert Keyboard.of_stdin() is None  # stdin is another terminal than the one that is drawn on


def serve_once(
    path: Path, run: str, answer: dict[str, object]
) -> tuple[threading.Thread, list[dict[str, object]]]:
    """A control port for one request."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    taken: list[dict[str, object]] = []

    def serve() -> None:
        with listener, listener.accept()[0] as client, client.makefile("rwb") as lines:
            lines.write(
                json.dumps(
                    {"membrane_ctrl": 1, "run": run, "you": "unix:ann", "role": "tune"}
                ).encode()
                + b"\n"
            )
            lines.flush()
            if line := lines.readline():
                taken.append(json.loads(line))
                lines.write(json.dumps({"number": 1, **answer}).encode() + b"\n")
                lines.flush()

    thread = threading.Thread(target=serve)
    thread.start()
    return thread, taken


@pytest.mark.parametrize(
    ("run", "answer", "message", "requests"),
    [
        ("demo", {"ok": True, "state": "standby"}, "hold: done", 1),
        ("demo", {"ok": False, "refused": "ann has command"}, "hold refused: ann has command", 1),
        ("other", {"ok": True}, "another run listens there", 0),
    ],
)
def test_a_request_goes_to_the_port_of_the_own_run_only(
    tmp_path: Path, run: str, answer: dict[str, object], message: str, requests: int
) -> None:
    thread, taken = serve_once(tmp_path / "sock", run, answer)
    assert message in send_request(tmp_path / "sock", "demo", {"do": "hold"})
    thread.join()
    assert taken == [{"do": "hold", "why": "key", "number": 1}] * requests


def test_no_hold_there_is_a_line_and_no_error(tmp_path: Path) -> None:
    assert send_request(tmp_path / "sock", "demo", {"do": "stop"}).startswith("stop: ")
