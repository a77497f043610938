"""A hold starts a service with its page if none follows its runs, and is not reached by its end."""

from __future__ import annotations

import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import psutil
import pytest

from membrane_ctrl.config.service import DEFAULT_PORT
from membrane_ctrl.control_port.service_link import (
    ADDRESS_NAME,
    add_key,
    find_service,
    publish_address,
)
from membrane_ctrl.hold import page_service
from membrane_ctrl.hold.page_service import LOG_NAME, start_page_service
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.processes.command_process import CommandProcess

WAITS = (
    "from membrane_ctrl.processes.command_process import end_with_parent; end_with_parent(); "
    "import time; time.sleep(60)"
)
CONFIGURATION = "[twin]\nport = 0\nscenario = 'quiet'\n[shape]\nenabled = false\n"


def until(found: Callable[[], object], patience_s: float = 120.0) -> None:
    give_up_s = time.monotonic() + patience_s
    while not found():
        assert time.monotonic() < give_up_s
        time.sleep(0.2)


def test_a_service_that_is_there_is_used(tmp_path: Path) -> None:
    with publish_address(tmp_path, "http://127.0.0.1:9/", has_link=True):
        page = start_page_service(tmp_path, None, pytest.fail, ends_with_us=False)
        assert page is not None
        assert page.link == add_key("http://127.0.0.1:9/")
        assert page.find_problem() == ""
        page.forget()
        page.stop()


def test_without_the_library_of_the_page_one_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    messages: list[str] = []
    assert start_page_service(tmp_path, None, messages.append, ends_with_us=False) is None
    assert messages == ["no page: it needs nicegui: pip install 'membrane-ctrl[web]'"]


def write_interpreter(path: Path, program: str) -> str:
    """A program in place of Python's interpreter; returns its path."""
    path.write_text(f"#!{sys.executable}\nimport os, sys, time\n{program}\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize("ends_with_us", [True, False])
def test_the_service_is_a_program_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends_with_us: bool
) -> None:
    waits = write_interpreter(tmp_path / "waits", "time.sleep(60)")
    monkeypatch.setattr(sys, "executable", waits)
    monkeypatch.setattr(page_service, "_find_free_port", lambda: 7499)
    page = start_page_service(tmp_path, tmp_path / "lab.toml", pytest.fail, ends_with_us)
    assert page is not None
    assert page.link == add_key("http://127.0.0.1:7499/")
    own = os.getpriority(os.PRIO_PROCESS, 0)
    until(lambda: services_of(tmp_path))
    (child,) = services_of(tmp_path)
    assert child.nice() == min(own + 10, 19)
    words = child.cmdline()
    assert words[words.index("--configurations") + 1] == str(tmp_path)
    assert ("--with-hold" in words, "--idle-end" in words) == (ends_with_us, not ends_with_us)
    assert os.getsid(child.pid) == child.pid
    assert stat.S_IMODE((tmp_path / LOG_NAME).stat().st_mode) == 0o600
    assert page.find_problem() == ""
    if ends_with_us:
        page.stop()
    else:
        page.forget()
    with suppress(psutil.NoSuchProcess):
        assert child.is_running() is not ends_with_us
        child.kill()
        child.wait(30.0)


@pytest.mark.parametrize(
    ("last_words", "problem"),
    [
        ("membrane-ctrl: port 7480: taken", "port 7480: taken"),
        ("\x1b[2Jwhy", "[2Jwhy"),
        ("", "code 2"),
    ],
)
def test_a_service_that_ends_prints_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_words: str, problem: str
) -> None:
    ending = "sys.exit(2)"
    program = f"print('loading'); print({last_words!r}); {ending}" if last_words else ending
    monkeypatch.setattr(sys, "executable", write_interpreter(tmp_path / "ends", program))
    page = start_page_service(tmp_path / "logs", None, pytest.fail, ends_with_us=False)
    assert page is not None
    assert page.wait_until_it_serves(60.0).endswith(problem)
    assert page.find_problem().endswith(problem)
    page.forget()


def test_a_service_that_does_not_become_ready_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = write_interpreter(tmp_path / "waits", "time.sleep(60)")
    monkeypatch.setattr(sys, "executable", waits)
    page = start_page_service(tmp_path, None, pytest.fail, ends_with_us=True)
    assert page is not None
    assert "not ready within 0 s" in page.wait_until_it_serves(0.2)
    page.stop()


def test_the_link_is_stated_once_the_service_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service names its address some seconds before it listens there."""
    waits = write_interpreter(tmp_path / "waits", "time.sleep(60)")
    monkeypatch.setattr(sys, "executable", waits)
    page = start_page_service(tmp_path, None, pytest.fail, ends_with_us=True)
    assert page is not None
    lines: list[str] = []
    try:
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
            with publish_address(tmp_path, url, has_link=True):
                assert not page.is_ready()
                page.announce(lines.append)
                listener.listen()
                until(lambda: lines)
        assert lines == [f"page: {add_key(url)}"]
    finally:
        page.stop()


def test_a_service_that_ends_before_it_answers_is_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = write_interpreter(tmp_path / "ends", "print('port taken'); sys.exit(2)")
    monkeypatch.setattr(sys, "executable", ends)
    page = start_page_service(tmp_path, None, pytest.fail, ends_with_us=False)
    assert page is not None
    lines: list[str] = []
    page.announce(lines.append)
    until(lambda: lines)
    assert lines == ["no page: port taken"]
    page.forget()


def test_a_program_ends_when_its_parent_dies() -> None:
    with subprocess.Popen([sys.executable, "-c", WAITS], stdin=subprocess.PIPE) as page:
        assert page.stdin is not None
        page.stdin.close()
        assert page.wait(30.0) == -signal.SIGTERM


def test_a_program_that_cannot_start_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    page = CommandProcess("page", ["serve", "--with-hold"], tmp_path / "gone" / "service.log", 10)
    page.start()
    assert (page.alive, page.exit_code) == (False, None)
    page.kill()
    page.stop(0.0)


def services_of(logs: Path) -> list[psutil.Process]:
    """The services of a folder of runs."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            words = process.cmdline()
            if "serve" in words and str(logs) in words and "nice" not in words[0]:
                found.append(process)
    return found


def wait_for_one_service(logs: Path) -> psutil.Process:
    """The only service of a folder; a child that it has just forked has its words until it runs a
    program of its own.
    """
    until(lambda: len(services_of(logs)) == 1)
    (service,) = services_of(logs)
    return service


@contextmanager
def holding(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A hold of the twin that may start a service."""
    (folder / "lab.toml").write_text(CONFIGURATION)
    drop = {"PYTEST_CURRENT_TEST", "MEMBRANE_CTRL_SERVICE", "CI"}  # NiceGUI looks for the first
    env = {name: value for name, value in os.environ.items() if name not in drop}
    words = ["hold", "--twin", "--config", str(folder / "lab.toml"), "--logs", str(folder / "logs")]
    with subprocess.Popen(
        [sys.executable, "-m", "membrane_ctrl", *words],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=env,
        text=True,
    ) as hold:
        try:
            yield hold
        finally:
            hold.kill()


@pytest.mark.real_time
def test_a_page_is_there_during_and_after_a_killed_hold_and_a_hold_outlives_it(
    tmp_path: Path,
) -> None:
    logs = tmp_path / "logs"
    services: list[psutil.Process] = []
    try:
        with holding(tmp_path) as hold:
            until(lambda: find_service(logs))
            link = str(find_service(logs))
            service = wait_for_one_service(logs)
            services.append(service)
            assert os.getsid(service.pid) == service.pid
            with httpx.Client(follow_redirects=True, timeout=60.0) as browser:
                until(lambda: "membrane_ctrl" in _text_of(browser, link))
                service.kill()
                service.wait(30.0)
                assert find_service(logs) is None
                assert hold.poll() is None, "the hold continues"
        with holding(tmp_path) as hold:
            until(lambda: find_service(logs))
            usual = f":{DEFAULT_PORT}/"  # another program of this machine may have that port
            if usual in link:
                assert find_service(logs) == link, "a bookmark stays valid"
            link = str(find_service(logs))
            services.append(wait_for_one_service(logs))
            hold.send_signal(signal.SIGINT)
            _, output = hold.communicate(timeout=120.0)
            assert hold.returncode in (Exit.DONE, Exit.INTERRUPTED)
            assert f"page:       {link}" in output
            assert services[-1].is_running()
    finally:
        for each in services:
            with suppress(psutil.NoSuchProcess):
                each.kill()
                each.wait(30.0)


def _text_of(browser: httpx.Client, url: str) -> str:
    with suppress(httpx.HTTPError):
        answer = browser.get(url)
        if answer.status_code == 200:
            return answer.text
    return ""


@pytest.mark.real_time
def test_a_hold_names_why_its_page_is_gone(tmp_path: Path) -> None:
    """The service cannot name its address beside the runs."""
    logs = tmp_path / "logs"
    (logs / ADDRESS_NAME).mkdir(parents=True)
    with holding(tmp_path) as hold:
        until(lambda: "is a directory" in _read(logs / LOG_NAME))
        until(lambda: not services_of(logs))
        hold.send_signal(signal.SIGINT)
        _, output = hold.communicate(timeout=120.0)
    lines = [each for each in output.splitlines() if each.startswith("no page:")]
    assert "is a directory" in lines[0], "at once"
    line = lines[-1]
    assert line.startswith("no page:    its service has ended: ")
    assert line.endswith("cannot be written (is a directory)")
    assert "page:       http" not in output, "no link that nobody answers"


def _read(path: Path) -> str:
    with suppress(OSError):
        return path.read_text()
    return ""
