"""`hold --autotune`: a tuning session beside the hold, as if a person had started it."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.hold import autotune
from membrane_ctrl.model.errors import Exit


def test_it_starts_a_session_and_ends_it_with_the_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the program waits for a hold that never comes."""
    words: list[str] = []
    popen = subprocess.Popen

    def started(program: list[str], **given: object) -> subprocess.Popen[bytes]:
        words.extend(program)
        return popen([sys.executable, "-c", "import time; time.sleep(600)"], **given)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "Popen", started)
    end = autotune.start_autotune(tmp_path / "control.sock", tmp_path)
    end()
    assert words[2:5] == ["membrane_ctrl", "tune", "run"]
    assert {"--short", "--wait", "--yes", "same-load", str(tmp_path / "control.sock")} <= set(words)
    assert (tmp_path / "autotune.log").read_bytes() == b""


def test_a_session_that_waits_gives_up_when_there_is_no_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("membrane_ctrl.sessions.live_hold._STARTS_S", 0.0)
    words = [
        "--short",
        "--wait",
        "--yes",
        "--socket",
        str(tmp_path / "none.sock"),
        "--logs",
        str(tmp_path),
    ]
    assert run(["tune", "run", *words]) == Exit.DEVICE_FAILED
    assert "none.sock" in capsys.readouterr().err


@pytest.mark.campaign
@pytest.mark.real_time
def test_a_hold_tunes_itself(tmp_path: Path) -> None:
    """A quarter of an hour with real processes: gains on trial, verified,
    and kept or taken back.
    """
    (tmp_path / "lab.toml").write_text(
        "[twin]\nport = 0\nscenario = 'quiet'\n[shape]\nenabled = false\n"
    )
    words = [
        "--twin",
        "--autotune",
        "--config",
        str(tmp_path / "lab.toml"),
        "--logs",
        str(tmp_path),
    ]
    hold = subprocess.Popen(
        [sys.executable, "-m", "membrane_ctrl", "hold", *words], stderr=subprocess.DEVNULL
    )
    try:
        give_up_s = time.monotonic() + 1200.0
        while not (found := list((tmp_path / "tuning").glob("*-autotune/verified.json"))):
            assert time.monotonic() < give_up_s, next(tmp_path.glob("*/autotune.log")).read_text()
            time.sleep(1.0)
        verified = json.loads(found[0].read_text())
        assert verified["kept"] or verified["reason"]
        assert hold.poll() is None
        _killed_and_resumed(tmp_path)
        assert hold.poll() is None
    finally:
        hold.terminate()
        hold.wait(60.0)


def _killed_and_resumed(logs: Path) -> None:
    """Another session on the same hold, killed once it has identified, continues from there."""
    words = [
        sys.executable,
        "-m",
        "membrane_ctrl",
        "tune",
        "run",
        "--short",
        "--yes",
        "--logs",
        str(logs),
    ]
    where = ["--socket", str(logs / "control.sock"), "--run", str(next(logs.glob("*-hold")))]
    session = subprocess.Popen([*words, *where, "--name", "killed"], stderr=subprocess.DEVNULL)
    give_up_s = time.monotonic() + 900.0
    while not (found := list((logs / "tuning").glob("*-killed/identified.json"))):
        assert time.monotonic() < give_up_s
        time.sleep(0.2)
    session.kill()
    session.wait()
    kept = {path.name: path.stat().st_mtime_ns for path in found[0].parent.glob("*.npz")}
    subprocess.run(
        [*words, *where, "--resume", str(found[0].parent)],
        check=False,
        timeout=900,
        capture_output=True,
    )
    assert (found[0].parent / "verified.json").exists()
    assert (found[0].parent / "experiments.npz").stat().st_mtime_ns == kept["experiments.npz"]
