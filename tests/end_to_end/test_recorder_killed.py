"""A hold whose recorder is killed: the hold continues, another recorder takes over, and the night
can be replayed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from patience import slow_machine

from membrane_ctrl.cli import run
from membrane_ctrl.model.errors import Exit

pytestmark = pytest.mark.real_time

PATIENCE_S = 60.0


def recorder_of(hold: subprocess.Popen[bytes], run_dir: Path) -> psutil.Process:
    """The child that has the inputs file open."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        for child in psutil.Process(hold.pid).children():
            try:
                if any(Path(file.path).name.startswith("ticks-") for file in child.open_files()):
                    return child
            except psutil.Error:  # it has just ended, or we may not inspect it
                continue
        time.sleep(0.1)
    raise AssertionError("no recorder found")


def test_a_killed_recorder_is_replaced_and_every_tick_replayed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "lab.toml"
    config.write_text(slow_machine() + "[twin]\nport = 0\n")
    command = ["hold", "--twin", "--config", str(config), "--duration", "20s", "--name", "kill"]
    with subprocess.Popen(
        [sys.executable, "-m", "membrane_ctrl", *command, "--logs", str(tmp_path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as hold:
        try:
            until_s = time.monotonic() + PATIENCE_S
            while not list(tmp_path.glob("*-kill/ticks/ticks-0000.journal")):
                assert time.monotonic() < until_s, "no recording has begun"
                time.sleep(0.05)
            (run_dir,) = tmp_path.glob("*-kill")
            os.kill(recorder_of(hold, run_dir).pid, signal.SIGKILL)
            assert hold.wait(PATIENCE_S) == Exit.DONE
        finally:
            hold.kill()
    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["exit"] == "done"
    assert summary["recorder"]["restarts"] == 1
    assert summary["recorder"]["partial"] is False
    assert summary["dropped"] == dict.fromkeys(summary["dropped"], 0)
    assert summary["ticks"] == summary["end"]["ticks"] >= 300
    kinds = [
        json.loads(line)["kind"] for line in (run_dir / "events.jsonl").read_text().splitlines()
    ]
    assert kinds.count("child_ended") == kinds.count("child_restarted") == kinds.count("end") == 1
    assert run(["replay", str(run_dir), "--json"]) == Exit.DONE
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "identical"
    assert report["compared"] == summary["ticks"]
