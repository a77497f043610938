from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.cli.ctl import add_actions, ctl_app
from membrane_ctrl.control_port import ctl as port_ctl
from membrane_ctrl.control_port import protocol
from membrane_ctrl.control_port.ctl import Where, socket_path, status_lines
from membrane_ctrl.control_port.status import status_table
from membrane_ctrl.controller.commands import SAME_AS, TABLE
from membrane_ctrl.model.acquisition_events import GeometryInUse
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import HeldScalarState, MaintenanceOver
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import State
from tests.worlds.port_run import ROW

ARGUMENTS = {
    "setpoint": "-12.5",
    "manual": "0.5",
    "mark": "door",
    "gains": "kp_per_s = 0.5",
    "shape": "on",
}
add_actions()
ACTIONS = [
    command.name or "" for command in ctl_app.registered_commands if command.name != "fleet"
]  # asks several
Asked = list[dict[str, Any]]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """The requests that a command line makes."""
    requests: Asked = []
    monkeypatch.setattr(port_ctl, "ctl", lambda request, *_: requests.append(request))
    return requests


def test_there_is_an_action_for_every_command_but_those_of_sessions() -> None:
    shape = {"shape_on", "shape_off"}
    assert {*ACTIONS, *shape} == {*TABLE, *SAME_AS, *get_args(protocol.Errand), "shape"} - {
        "tune",
        "claim",
    }


@pytest.mark.parametrize("action", ACTIONS)
def test_every_action_is_a_request_that_the_port_reads(action: str, asked: Asked) -> None:
    given = [ARGUMENTS[action]] if action in ARGUMENTS else []
    assert run(["ctl", action, *given, "--why", "test"]) == 0
    assert protocol.parse(json.dumps(asked[0]).encode()).why == "test"


@pytest.mark.parametrize("name", ["lock", "latch"])
def test_a_lock_has_two_names_and_may_have_a_reason(name: str, asked: Asked) -> None:
    assert run(["ctl", name, "hands inside"]) == 0
    request = protocol.parse(json.dumps(asked[0]).encode())
    assert (request.do, request.text) == ("latch", "hands inside")


def test_an_unlock_takes_the_word(asked: Asked) -> None:
    assert run(["ctl", "unlock", "bofak"]) == 0
    request = protocol.parse(json.dumps(asked[0]).encode())
    assert (request.do, request.text) == ("unlock", "bofak")


@pytest.mark.parametrize(
    "words",
    [
        ["--socket", "stop", "setpoint", "-1", "--why", "x"],
        ["--json", "setpoint", "-1", "--why", "x"],
        ["--why=x", "setpoint", "-1"],
        ["setpoint", "--why", "x", "-1"],
    ],
)
def test_options_stand_anywhere(words: list[str], asked: Asked) -> None:
    assert run(["ctl", *words]) == 0
    assert [(r["do"], r["value"], r["why"]) for r in asked] == [("setpoint", -1.0, "x")]


@pytest.mark.parametrize(
    ("action", "argument", "message"),
    [
        ("explode", None, "No such command 'explode'"),
        ("tune", None, "No such command 'tune'"),
        ("setpoint", None, "Missing argument 'UM'"),
        ("setpoint", "high", "not a plain decimal number"),
        ("setpoint", "nan", "not a plain decimal number"),
        ("setpoint", "1_0", "not a plain decimal number"),
        ("setpoint", "1,000", "has a comma"),
        ("manual", "1e400", "too large"),
        ("manual", "inf", "not a plain decimal number"),
        ("shape", "perhaps", "on|off"),
        ("mark", None, "Missing argument 'TEXT'"),
        ("stop", "now", "unexpected extra argument"),
        ("gains", None, "Missing argument 'FILE'"),
        ("gains", "kp_per_s : 1", "loop keys"),
        ("gains", "kp_per_s = 'much'", "numbers"),
        ("gains", "nowhere.toml", "no such file"),
        ("gains", "nowhere.json", "nowhere.json"),
    ],
)
def test_what_cannot_be_meant_is_one_line(
    action: str,
    argument: str | None,
    message: str,
    asked: Asked,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["ctl", action, *([] if argument is None else [argument])]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1
    assert asked == []


def test_gains_from_files(tmp_path: Path, asked: Asked) -> None:
    toml = tmp_path / "gains.toml"
    toml.write_text("[loop]\nkp_per_s = 0.5\nfeedforward_barometer = false\n")
    plain = tmp_path / "gains.json"
    plain.write_text('{"kp_per_s": 0.25}')
    assert (
        run(["ctl", "gains", str(toml), "--trial", "2m"]) == run(["ctl", "gains", str(plain)]) == 0
    )
    first, second = asked
    assert (first["loop"], first["value"]) == (
        {"kp_per_s": 0.5, "feedforward_barometer": False},
        120.0,
    )
    assert (second["loop"], "value" in second) == ({"kp_per_s": 0.25}, False)


def test_what_a_run_holds_is_no_gain(
    tmp_path: Path, asked: Asked, capsys: pytest.CaptureFixture[str]
) -> None:
    toml = tmp_path / "loop.toml"
    toml.write_text('[loop]\nkp_per_s = 0.5\nholds = "focus"\n')
    assert run(["ctl", "gains", str(toml)]) == 2
    assert "holds: stays for a run" in capsys.readouterr().err
    assert asked == []


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
    status = RunStatus()
    assert "starting" in status_lines({"run": "r", **status_table(status)})[0]
    fault = {
        "kind": "fault",
        "code": 40,
        "name": "late",
        "cause": "the loop is late",
        "remedy": "close other programs",
    }
    row = replace(ROW, fault=40.0, state=State.FAULT, leak_um_per_s=float("nan"))
    status = status.after_row(row).after_event(from_dict(fault))
    lines = status_lines({"run": "r", "commander": "unix:ann", **status_table(status)})
    assert "FAULT 40 late: the loop is late; close other programs" in lines
    assert any(line.split() == ["error", "0.25", "µm"] for line in lines)
    assert any(line.split() == ["leak", "–", "µm/s"] for line in lines)
    assert any("unix:ann" in line for line in lines)


def test_what_is_held_besides_the_centre_is_shown() -> None:
    status = RunStatus().after_row(ROW)
    assert not any(line.startswith("  held") for line in status_lines(status_table(status)))
    status = status.after_row(replace(ROW, held_offset_um=12.34, held_offset_sigma_um=0.0251))
    status = status.after_event(HeldScalarState("best_fit", "tracking", 12.34, "", "", 0.025))
    lines = status_lines(status_table(status))
    assert (
        "  held              best fit is held; the centre stands +12.34 ± 0.025 µm from the "
        "setpoint for it"
    ) in lines
    for name in ("kept", "vertex"):  # the second is of older holds
        lost = HeldScalarState("focus", name, 12.34, "no usable figure for 30 s")
        lines = status_lines(status_table(status.after_event(lost)))
        assert any(
            "focus is not followed: the centre rests at the last offset (no usable figure" in line
            for line in lines
        )


def test_what_stands_until_it_is_over_is_shown() -> None:
    status = RunStatus()
    maintenance = {
        "kind": "maintenance",
        "name": "calibrate",
        "message": "calibrate again: too much is left",
    }
    status = status.after_row(ROW).after_event(from_dict(maintenance))
    lines = status_lines({"run": "r", **status_table(status)})
    assert "Maintenance calibrate: calibrate again: too much is left" in lines
    assert any("not in use yet" in line for line in lines)
    status = status.after_event(
        from_dict({"kind": "disk_low", "what": "disk", "message": "less than 500 MB free"})
    )
    lines = status_lines({"run": "r", **status_table(status)})
    assert "Disk almost full: less than 500 MB free" in lines
    status = status.after_event(GeometryInUse("12ab", "g.toml", "2026-01-02", ""))
    status = status.after_event(MaintenanceOver("calibrate", "the geometry fits again"))
    lines = status_lines({"run": "r", **status_table(status)})
    assert not any("Maintenance" in line for line in lines)
    assert "  geometry          g.toml, calibrated 2026-01-02 (hash 12ab)" in lines


def test_a_port_without_a_hold_is_one_line_and_exit_code_4(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["ctl", "status", "--socket", str(tmp_path / "control.sock")]) == 4
    assert "no hold is listening" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [["--host", "nowhere"], ["--host", "http://bench:7480/"], ["--jsn"]],
    ids=["address", "plain text", "typo"],
)
def test_bad_usage_is_exit_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MEMBRANE_CTRL_TOKEN", "token")
    assert run(["ctl", "status", *arguments]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
