"""A tuning or calibration session at a peer that is not a hold ends in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.model.errors import CommandError, DeviceError
from membrane_ctrl.sessions.live_hold import live_hold
from tests.control_port import evil_holds as evil


def run_folder(folder: Path) -> None:
    """The folder of the run that the peers name."""
    (folder / "evil").mkdir()
    (folder / "evil" / "config.toml").write_text(toml_file.dump_toml(Config()))


@pytest.mark.parametrize("line", evil.ANSWERS.values(), ids=evil.ANSWERS)
def test_an_answer_that_no_hold_sends_ends_the_link(
    line: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.client.ANSWER_S", 1.0)
    run_folder(tmp_path)
    with (
        evil.peer(tmp_path / "control.sock", evil.answering(line)) as path,
        pytest.raises(CommandError) as ended,
        live_hold(Where(socket=path), False, session="tune x"),
    ):
        pass
    assert len(ended.value.lines) == 1


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"loop": {}, "pump": {"curve_fraction": "x"}},
        {"loop": {"kp_per_s": -1e9}, "pump": {}},
        {"loop": {"kp_per_s": "much"}, "pump": PumpConfig().model_dump()},
        {"loop": {"surprise": 1}, "pump": PumpConfig().model_dump()},
        {"loop": LoopConfig().model_dump(), "pump": {"flow_full_um_per_s": {}}},
    ],
)
def test_settings_that_no_hold_has_end_the_link(
    settings: dict[str, object], tmp_path: Path
) -> None:
    run_folder(tmp_path)
    answer = {"number": 1, "ok": True, "status": evil.STATUS, **settings}
    line = json.dumps(answer).encode()
    with (
        evil.peer(tmp_path / "control.sock", evil.answering(line)) as path,
        pytest.raises(DeviceError, match="not an answer of a hold"),
        live_hold(Where(socket=path), False),
    ):
        pass


def test_a_session_command_prints_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_folder(tmp_path)
    with evil.peer(tmp_path / "control.sock", evil.answering(evil.ANSWERS["status_list"])) as path:
        for words in (["tune", "run", "--yes"], ["calibrate", "--live"]):
            assert run([*words, "--socket", str(path), "--logs", str(tmp_path)]) == 4
            (lines,) = [
                line
                for line in capsys.readouterr().err.splitlines()
                if line.startswith("membrane-ctrl:")
            ]
            assert "not an answer of a hold (status" in lines
