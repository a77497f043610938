"""`ctl` with a running `hold --twin`, as an operator uses it."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from patience import slow_machine

from membrane_ctrl.cli import run

pytestmark = pytest.mark.real_time

COMMAND = [sys.executable, "-m", "membrane_ctrl"]
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Asked:
    """Output of `ctl`; run in the test's own process, as Python's start takes longer than the
    command.
    """

    code: int
    out: str
    err: str


def ctl(folder: Path, *arguments: str) -> Asked:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(["ctl", *arguments, "--socket", str(folder / "logs" / "control.sock")])
    return Asked(code, out.getvalue(), err.getvalue())


def hold_command(folder: Path) -> list[str]:
    config = folder / "lab.toml"
    config.write_text(f"{slow_machine()}[twin]\nport = 0\n[shape]\nenabled = false\n")
    return [
        *COMMAND,
        "hold",
        "--twin",
        "--config",
        str(config),
        "--logs",
        str(folder / "logs"),
        "--name",
        "ctl",
    ]


def until_ticking(folder: Path) -> dict[str, object]:
    give_up_s = time.monotonic() + PATIENCE_S
    while True:
        asked = ctl(folder, "status", "--json")
        if asked.code == 0:
            status: dict[str, object] = json.loads(asked.out)["status"]
            if status["state"] != "starting":
                return status
        assert time.monotonic() < give_up_s, asked.err
        time.sleep(0.1)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        hold_command(tmp_path), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    yield process
    if process.poll() is None:
        process.kill()
    process.communicate()


def test_a_session_of_an_operator(tmp_path: Path, running: subprocess.Popen[str]) -> None:
    status = until_ticking(tmp_path)
    run_dir = tmp_path / "logs" / str(status["run"])
    assert ctl(tmp_path, "setpoint", "-12.5", "--why", "lower for the night").code == 0
    refused = ctl(tmp_path, "setpoint", "1e6")
    assert (refused.code, "outside the limits" in refused.err) == (2, True)
    assert len(refused.err.splitlines()) == 1
    assert ctl(tmp_path, "mark", "door opened").code == 0
    assert ctl(tmp_path, "gains", "kp_per_s = 0.5").code == 0

    second = subprocess.run(
        hold_command(tmp_path), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert (second.returncode, "another hold is listening" in second.stderr) == (4, True)
    assert [path.name for path in (tmp_path / "logs").iterdir() if path.is_dir()] == [run_dir.name]

    seen = until_ticking(tmp_path)
    assert seen["row"]["target_um"] == -12.5  # type: ignore[index]
    assert ctl(tmp_path, "stop", "--why", "enough").code == 0
    _, stderr = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 130, stderr
    assert not (tmp_path / "logs" / "control.sock").exists()

    events = [json.loads(line) for line in (run_dir / "events.jsonl").read_text().splitlines()]
    commands = [e for e in events if e["kind"] == "command" and e["who"].startswith("unix:")]
    assert [e["command"] for e in commands] == ["setpoint", "setpoint", "mark", "gains", "stop"]
    assert commands[0]["why"] == "lower for the night"
    assert "outside the limits" in commands[1]["refused"]
    assert commands[2]["text"] == "door opened"
    assert commands[3]["loop"]["kp_per_s"] == 0.5
    assert events[-1]["kind"] == "end"


def test_a_killed_holds_socket_does_not_stop_the_next(
    tmp_path: Path, running: subprocess.Popen[str]
) -> None:
    until_ticking(tmp_path)
    running.kill()
    running.wait()
    assert (tmp_path / "logs" / "control.sock").exists()
    assert ctl(tmp_path, "status").code == 4
    following = subprocess.Popen(
        hold_command(tmp_path), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        until_ticking(tmp_path)
        assert ctl(tmp_path, "stop").code == 0
        following.communicate(timeout=PATIENCE_S)
        assert following.returncode == 130
    finally:
        if following.poll() is None:
            following.kill()
            following.communicate()
