"""`hold --autotune`: a tuning session beside the hold, as if a person had started it."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.hold import start
from membrane_ctrl.model.errors import Exit


def test_it_starts_a_session_and_ends_it_with_the_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the program waits for a hold that never comes."""
    words: list[str] = []
    popen = subprocess.Popen

    def started(program: list[str], **given: object) -> subprocess.Popen[bytes]:
        words.extend(program)
        return popen([sys.executable, "-c", "import time; time.sleep(600)"], **given)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "Popen", started)
    end = start._autotune(tmp_path / "control.sock", tmp_path)
    end()
    assert words[2:5] == ["membrane_ctrl", "tune", "run"]
    assert {"--short", "--wait", "same-load", str(tmp_path / "control.sock")} <= set(words)
    assert (tmp_path / "autotune.log").read_bytes() == b""


def test_a_session_that_waits_gives_up_when_there_is_no_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("membrane_ctrl.sessions.live_hold._STARTS_S", 0.0)
    words = ["--short", "--wait", "--yes", "--socket", str(tmp_path / "none.sock"), "--logs", str(tmp_path)]
    assert run(["tune", "run", *words]) == Exit.DEVICE_FAILED
    assert "none.sock" in capsys.readouterr().err


@pytest.mark.campaign
@pytest.mark.real_time
def test_a_hold_tunes_itself(tmp_path: Path) -> None:
    """A quarter of an hour with real processes: gains on trial, verified, and kept or taken back."""
    (tmp_path / "lab.toml").write_text("[twin]\nport = 0\nscenario = 'quiet'\n[shape]\nenabled = false\n")
    words = ["--twin", "--autotune", "--config", str(tmp_path / "lab.toml"), "--logs", str(tmp_path)]
    hold = subprocess.Popen([sys.executable, "-m", "membrane_ctrl", "hold", *words], stderr=subprocess.DEVNULL)
    try:
        give_up_s = time.monotonic() + 1200.0
        while not (found := list((tmp_path / "tuning").glob("*-autotune/verified.json"))):
            assert time.monotonic() < give_up_s, next(tmp_path.glob("*/autotune.log")).read_text()
            time.sleep(1.0)
        verified = json.loads(found[0].read_text())
        assert verified["kept"] or verified["reason"]
        assert hold.poll() is None
    finally:
        hold.terminate()
        hold.wait(60.0)
