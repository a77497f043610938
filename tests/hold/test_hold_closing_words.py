"""What `hold` reports at its end about a changed run folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from membrane_ctrl.hold.start import report


def words(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> str:
    report(run_dir, as_json=False)
    return capsys.readouterr().err


def test_a_folder_that_is_gone_is_not_offered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = words(tmp_path / "run", capsys)
    assert "removed or moved" in said
    assert "rerun" not in said
    assert "are readable" not in said


def test_a_folder_begun_anew_says_from_when(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "summary.json").write_text(json.dumps({"recorder": {"folder_anew_s": 13.44}}))
    assert "starts at 13.4 s" in words(tmp_path, capsys)
    (tmp_path / "summary.json").write_text(json.dumps({"recorder": {"folder_anew_s": None}}))
    assert "starts at" not in words(tmp_path, capsys)


def test_only_a_recording_that_is_there_is_offered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "open it" not in words(tmp_path, capsys)
    (tmp_path / "hold-000.rrd").touch()
    assert f"open it:    membrane-ctrl review {tmp_path}\n" in words(tmp_path, capsys)
    monkeypatch.chdir(tmp_path)
    run_dir = Path("logs/20261122T031200Z-hold")
    run_dir.mkdir(parents=True)
    (run_dir / "hold-000.rrd").touch()
    assert "open it:    membrane-ctrl review last\n" in words(run_dir, capsys)
