"""A hold with `[web]`: the page is a separate program whose failures do not reach the hold."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.cli.options import load_configuration
from membrane_ctrl.hold.child_processes import _page_words
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.processes.command_process import CommandProcess
from tests.web.test_page import free_port

WAITS = (
    "from membrane_ctrl.processes.command_process import end_with_parent; end_with_parent(); "
    "import time; time.sleep(60)"
)


def test_the_page_gets_its_settings(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(
        "[web]\nhost = '0.0.0.0'\nport = 7481\nnames = ['bench.lab']\n"
        "users_file = 'users'\ncertificate_file = 'bench.pem'\nkey_file = 'bench.key'\n"
    )
    config = load_configuration(tmp_path / "lab.toml")
    assert config.web is not None
    words = _page_words(config.web, tmp_path / "logs" / "run", tmp_path / "a.sock")
    pairs = dict(zip(words[2::2], words[3::2], strict=True))
    assert words[:2] == ["web", "--with-hold"]
    assert pairs == {
        "--logs": str(tmp_path / "logs"),
        "--socket": str(tmp_path / "a.sock"),
        "--host": "0.0.0.0",
        "--port": "7481",
        "--users": str(tmp_path / "users"),
        "--certificate": str(tmp_path / "bench.pem"),
        "--key": str(tmp_path / "bench.key"),
        "--name": "bench.lab",
    }


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[web]\nhost = '0.0.0.0'\n", "other machines need TLS and a login"),
        ("[web]\n[port]\nenabled = false\n", "set port.enabled = true"),
    ],
)
def test_impossible_page_settings_are_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "lab.toml").write_text(text)
    with pytest.raises(InputError, match=says):
        load_configuration(tmp_path / "lab.toml")


def test_without_the_library_of_the_page_no_hold_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    (tmp_path / "lab.toml").write_text("[web]\n")
    words = [
        "hold",
        "--twin",
        "--config",
        str(tmp_path / "lab.toml"),
        "--logs",
        str(tmp_path / "logs"),
    ]
    assert run(words) == Exit.BAD_INPUT
    assert "[web] needs NiceGUI: pip install 'membrane-ctrl[web]'" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_the_page_ends_when_its_parent_dies() -> None:
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
    page = CommandProcess("page", ["web", "--with-hold"], tmp_path / "gone" / "web.log", 10)
    page.start()
    assert (page.alive, page.exit_code) == (False, None)
    page.kill()
    page.stop(0.0)


def until(found: Callable[[], object]) -> None:
    give_up_s = time.monotonic() + 90.0
    while not found():
        assert time.monotonic() < give_up_s
        time.sleep(0.2)


@pytest.mark.campaign
@pytest.mark.real_time
def test_a_hold_outlives_its_page(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(
        "[twin]\nport = 0\nscenario = 'quiet'\n[shape]\nenabled = false\n[web]\nport = "
        f"{free_port()}\n"
    )
    words = [
        "--twin",
        "--config",
        str(tmp_path / "lab.toml"),
        "--logs",
        str(tmp_path),
        "--duration",
        "45s",
    ]
    env = {
        name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"
    }  # NiceGUI looks for it
    program = [sys.executable, "-m", "membrane_ctrl", "hold", *words]
    hold = subprocess.Popen(program, stderr=subprocess.DEVNULL, env=env)

    def log() -> Path | None:
        return next(tmp_path.glob("*/web.log"), None)

    def links() -> list[str]:
        file = log()
        return (
            []
            if file is None
            else [line for line in file.read_text().splitlines() if "open http" in line]
        )

    try:
        until(lambda: len(links()) == 1)
        file = log()
        assert file is not None
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        page = _page_of(hold.pid)
        os.kill(page, signal.SIGKILL)
        until(lambda: len(links()) == 2)
        assert hold.wait(120.0) == 0
    finally:
        hold.kill()
        hold.wait()
    lines = (file.parent / "events.jsonl").read_text().splitlines()
    told = [event["kind"] for line in lines if (event := json.loads(line)).get("child") == "page"]
    assert told == ["child_ended", "child_restarted"]
    assert json.loads((file.parent / "summary.json").read_text())["exit"] == "done"
    with pytest.raises(StopIteration):
        _page_of(hold.pid)


def _page_of(parent: int) -> int:
    """The page's process, by its parent."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            words, status = (folder / "cmdline").read_bytes(), (folder / "status").read_text()
        except OSError:
            continue
        if b"--with-hold" in words and f"PPid:\t{parent}\n" in status:
            return int(folder.name)
    raise StopIteration
