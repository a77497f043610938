from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from port_run import ROW

from firmware_iface.roles import BenchCommand
from membrane_ctrl.cli import run
from membrane_ctrl.control_port.ctl import ACTIONS, CtlOptions, Where, request_for, socket_path, status_lines
from membrane_ctrl.control_port.protocol import parse
from membrane_ctrl.control_port.status import Picture
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.states import State

ARGUMENTS = {"setpoint": "-12.5", "manual": "0.5", "mark": "door", "gains": "kp_per_s = 0.5", "shape": "on"}


def options(action: str, argument: str | None = None, **more: Any) -> CtlOptions:
    words: dict[str, Any] = {"why": "", "take_over": False, "every": "1s", "trial": ""} | more
    return CtlOptions(action, argument, **words, json=False, where=Where())


@pytest.mark.parametrize("action", ACTIONS)
def test_every_action_is_a_request_that_the_port_reads(action: str) -> None:
    request = request_for(options(action, ARGUMENTS.get(action), why="test"))
    assert parse(json.dumps(request).encode()).why == "test"


def test_a_lock_may_say_why() -> None:
    request = request_for(options("latch", "hands inside"))
    assert parse(json.dumps(request).encode()).text == "hands inside"


@pytest.mark.parametrize(
    ("action", "argument", "says"),
    [
        ("explode", None, "unknown; known are status"),
        ("tune", None, "unknown"),
        ("setpoint", None, "a number in um is needed"),
        ("setpoint", "high", "a number in um is needed"),
        ("setpoint", "nan", "a number in um is needed"),
        ("manual", "inf", "a number in um/s"),
        ("shape", "perhaps", "on or off"),
        ("mark", "", "what?"),
        ("stop", "now", "takes no argument"),
        ("gains", None, "TOML or JSON"),
        ("gains", "kp_per_s : 1", "neither"),
        ("gains", "kp_per_s = 'much'", "numbers"),
        ("gains", "nowhere.toml", "no such file"),
        ("gains", "nowhere.json", "nowhere.json"),
    ],
)
def test_what_cannot_be_meant_is_one_line(action: str, argument: str | None, says: str) -> None:
    with pytest.raises(InputError, match=says):
        request_for(options(action, argument))


def test_gains_from_files(tmp_path: Path) -> None:
    toml = tmp_path / "gains.toml"
    toml.write_text("[loop]\nkp_per_s = 0.5\nfeedforward_barometer = false\n")
    plain = tmp_path / "gains.json"
    plain.write_text('{"kp_per_s": 0.25}')
    loop = request_for(options("gains", str(toml), trial="2m"))
    assert (loop["loop"], loop["value"]) == ({"kp_per_s": 0.5, "feedforward_barometer": False}, 120.0)
    assert request_for(options("gains", str(plain)))["loop"] == {"kp_per_s": 0.25}


def test_the_socket_is_found(tmp_path: Path) -> None:
    run_dir = tmp_path / "logs" / "a-run"
    run_dir.mkdir(parents=True)
    (run_dir / "config.toml").write_text("[port]\nenabled = true\n")
    assert socket_path(Where()) == Path("logs/control.sock")
    assert socket_path(Where(run=run_dir)) == tmp_path / "logs" / "control.sock"
    (run_dir / "config.toml").write_text('[port]\nsocket = "/run/bench.sock"\n')
    assert socket_path(Where(run=run_dir)) == Path("/run/bench.sock")
    assert socket_path(Where(run=run_dir, socket=Path("other.sock"))) == Path("other.sock")


def test_status_for_a_person() -> None:
    picture = Picture()
    assert "starting" in status_lines({"run": "r", **picture.status()})[0]
    fault = {
        "kind": "fault",
        "code": 40,
        "name": "late",
        "cause": "the loop is late",
        "remedy": "close other programs",
    }
    row = replace(ROW, fault=40.0, state=State.FAULT, leak_um_per_s=float("nan"))
    picture.take(TickOutputs(BenchCommand(0.0, 0.0), row, (fault,), None))
    lines = status_lines({"run": "r", "commander": "unix:ann", **picture.status()})
    assert "FAULT 40 late: the loop is late; close other programs" in lines
    assert any(line.split() == ["error", "0.250", "um"] for line in lines)
    assert any(line.split() == ["leak", "-", "um/s"] for line in lines)
    assert any("unix:ann" in line for line in lines)


def test_what_stands_until_it_is_over_is_shown() -> None:
    picture = Picture()
    maintenance = {"kind": "maintenance", "name": "calibrate", "message": "calibrate again: too much is left"}
    picture.take(TickOutputs(BenchCommand(0.0, 0.0), ROW, (maintenance,), None))
    lines = status_lines({"run": "r", **picture.status()})
    assert any(line.split(maxsplit=1) == ["maintenance", maintenance["message"]] for line in lines)
    assert any("nothing measures with one yet" in line for line in lines)
    picture.note({"kind": "disk_low", "what": "disk", "message": "less than 500 MB free"})
    lines = status_lines({"run": "r", **picture.status()})
    assert any(line.split(maxsplit=1) == ["recording", "less than 500 MB free"] for line in lines)
    picture.note(
        {"kind": "geometry", "hash": "12ab", "file": "g.toml", "calibrated_utc": "2026-01-02", "message": ""}
    )
    picture.note({"kind": "maintenance_over", "name": "calibrate", "message": "the geometry fits again"})
    lines = status_lines({"run": "r", **picture.status()})
    assert not any("maintenance" in line for line in lines)
    assert "  geometry       g.toml, calibrated 2026-01-02 (hash 12ab)" in lines


def test_nobody_there_is_one_line_and_exit_code_4(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ctl", "status", "--socket", str(tmp_path / "control.sock")]) == 4
    assert "no hold is listening there" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments", [["--tls", "nowhere"], ["--tls", "bench:7470"], ["--jsn"]], ids=["address", "certificate", "typo"]
)
def test_bad_usage_is_exit_code_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ctl", "status", *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
