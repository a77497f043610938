"""`config init`, `config explain` and the others, as their user calls them."""

from __future__ import annotations

import asyncio
import io
import json
from pathlib import Path

import pytest
from patience import patient_check
from test_examples import StillPlant

from membrane_ctrl.cli import run
from membrane_ctrl.commissioning import devices, first_config
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.sim.lab import Lab

FOUND = [devices.FoundDevice("port", "/dev/ttyUSB0: FTDI", 'port = "usb:0403:6001"')]

NO_CLIMATE = ["", "", ""]  # film and ring thermometer, hygrometer


@pytest.fixture(autouse=True)
def connected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_config, "_find_connected", lambda: FOUND)


def answered(monkeypatch: pytest.MonkeyPatch, path: Path, *answers: str) -> int:
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join([*answers, ""])))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    return run(["config", "init", str(path)])


@pytest.mark.parametrize("options", [["--twin"], []], ids=["twin", "nobody to ask"])
async def test_the_first_configuration_passes_check_against_the_twin(
    options: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    path = tmp_path / "lab.toml"
    assert run(["config", "init", str(path), *options]) == 0
    text = path.read_text()
    assert ("FTDI" in text) == (not options)
    config = load_toml(path, Config)
    stated = {
        "devices": {"board": "tcp://127.0.0.1:5020"},
        "shape": {"mode": "auto"},
        "estimator": {"process_value": "auto"},
    }
    assert config == Config.model_validate(stated)
    assert config.devices is not None
    lab = Lab(StillPlant(), config.devices)
    try:
        board = (await lab.start()).board
        path.write_text(
            text.replace("tcp://127.0.0.1:5020", str(board))
        )  # another test may have that port
        with patient_check():
            assert await asyncio.to_thread(run, ["check", str(path), "--json"]) == 0
    finally:
        await lab.stop()


@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_nothing_is_overwritten(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    if kind == "file":
        path.write_text("mine")
    elif kind == "link":
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.mkdir()
    assert run(["config", "init", str(path), "--twin"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert not (tmp_path / "elsewhere").exists()
    assert kind != "file" or path.read_text() == "mine"


def test_a_folder_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["config", "init", str(tmp_path / "no" / "lab.toml"), "--twin"]) == 2
    assert "cannot be written (no such file or directory)" in capsys.readouterr().err


def test_a_board_is_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert answered(monkeypatch, path, "", "tcp://10.0.0.9:502", "", "") == 0
    config = load_toml(path, Config)
    assert config.devices is not None
    assert config.devices.board == "tcp://10.0.0.9:502"
    assert not config.shape.enabled  # no camera was named
    assert config.loop == Config().loop


def test_single_instruments_are_asked_for_and_what_they_lack_is_switched_off(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    laser = ["optoncdt", "optoncdt1420", "1"]  # a typing error first; then the connected port
    # no URL first: the other answers are kept
    pump = ["bronkhorst_modbus", "/dev/x", "3", "", "rtu:///dev/ttyUSB1", ""]
    gauge = ["bronkhorst_modbus", "rtu:///dev/ttyUSB1", "5"]
    screen = ["pygame", "1920", "1080", "0.4961"]
    vent = ["modbus_map", "none", "tcp://10.0.0.1:502", "0", "0, 20000", "[0.0, 1.0]"]
    answers = ["2", *laser, *pump, *gauge, *vent, "", "", *NO_CLIMATE, "uvc", *screen, ""]
    assert answered(monkeypatch, path, *answers) == 0, capsys.readouterr().err
    config = load_toml(path, Config)
    assert config.devices is not None
    assert {*config.devices.roles()} == {"displacement", "pump", "gauge_pressure", "vent"}
    assert config.devices.vent is not None
    assert config.devices.vent.raw == (0.0, 20000.0)
    assert config.devices.screen is not None
    assert config.devices.screen.pixel_mm == 0.4961
    assert config.shape.enabled
    assert not config.loop.feedforward_barometer
    assert not config.loop.feedforward_temperature
    assert config.pump.start_fraction == 0.0
    output = capsys.readouterr().err
    assert "choose a number from 1 to" in output
    assert "usb:0403:6001" in output
    assert "two numbers separated by a comma, such as 4000, 20000" in output
    assert "pump: link" in output
    assert "# Modbus address of the device." in path.read_text()


def test_a_slip_is_taken_back_and_an_end_loses_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    kept = path.with_name("lab.toml.answers")
    first = ["2", "optoncdt1420", "2", "/dev/wrong", "back", "/dev/laser", "ventus"]
    assert answered(monkeypatch, path, *first) == 130  # the end of the input, as by Ctrl-C
    assert not path.exists()
    assert "nothing is lost" in capsys.readouterr().err
    rest = ["2", "/dev/pump", "mks_937b", "2", "/dev/gauge", "", "", "", *NO_CLIMATE, "", ""]
    assert answered(monkeypatch, path, *rest) == 0
    shown = capsys.readouterr().err
    assert "continuing after 5 answers" in shown
    assert "what drives the pump?" not in shown
    config = load_toml(path, Config)
    assert config.devices is not None
    assert config.devices.displacement is not None
    assert config.devices.displacement.model_dump()["port"] == "/dev/laser"
    assert not kept.exists()


def test_a_preset_replaces_the_keys_that_it_has(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    laser, gauge = ["optoncdt1420", "1"], ["mks_937b", "2", "/dev/gauge"]
    pump = ["modbus_map", "waveshare_ao8", "rtu:///dev/ttyUSB1", "", "0", "0, 1"]
    answers = ["2", *laser, *pump, *gauge, "", "", "", *NO_CLIMATE, "", ""]
    assert answered(monkeypatch, path, *answers) == 0, capsys.readouterr().err
    shown = capsys.readouterr().err
    assert "raw (" not in shown
    assert "an answer is needed" in shown
    config = load_toml(path, Config)
    assert config.devices is not None
    assert config.devices.pump is not None
    assert config.devices.pump.model_dump()["preset"] == "waveshare_ao8"


def test_interlocks_are_asked_for_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    stop = ["board_input", "stop", "the emergency stop is pressed", "0"]
    door = ["modbus_input", "Door", "x", "tcp://10.0.0.7", "3"]  # a capital letter first
    door += ["", "door", "the door is open", "", ""]
    assert answered(monkeypatch, path, "1", "tcp://10.0.0.9:502", "", *stop, *door, "") == 0
    config = load_toml(path, Config)
    assert config.devices is not None
    assert [(each.driver, each.name, each.text) for each in config.devices.interlocks] == [
        ("board_input", "stop", "the emergency stop is pressed"),
        ("modbus_input", "door", "the door is open"),
    ]
    printed = capsys.readouterr().err
    assert "interlock 1 (emergency stop, door, oxygen monitor, supply pressure): which" in printed
    assert "the answers are kept" in printed
    assert path.read_text().count("[[devices.interlocks]]") == 2


def test_an_input_of_the_board_is_no_interlock_of_single_instruments(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    laser, pump = ["optoncdt1420", "2", "/dev/x"], ["ventus", "2", "/dev/y"]
    gauge = ["mks_937b", "2", "/dev/z"]
    line = ["board_input", "gpio_line", "stop", "the emergency stop is pressed", "17"]
    answers = ["2", *laser, *pump, *gauge, "", "", "", *NO_CLIMATE, "", *line, ""]
    assert answered(monkeypatch, path, *answers) == 0
    assert "board_input " not in capsys.readouterr().err
    config = load_toml(path, Config)
    assert config.devices is not None
    assert [each.driver for each in config.devices.interlocks] == ["gpio_line"]


def test_answers_that_contradict_each_other_write_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    answers = [
        "2",
        "optoncdt1420",
        "2",
        "/dev/x",
        "ventus",
        "2",
        "/dev/x",
        "bronkhorst_propar",
        "2",
        "/dev/y",
        "",
        "",
        "",
        *NO_CLIMATE,
        "",
        "",
    ]
    assert answered(monkeypatch, path, *answers) == 2
    assert "displacement and pump name the same port" in capsys.readouterr().err
    assert not path.exists()


def test_a_pump_and_a_gauge_on_one_register_write_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    laser = ["optoncdt1420", "2", "/dev/x"]
    pump = ["modbus_map", "none", "tcp://10.0.0.1", "7", "[0, 20000]", "[0.0, 1.0]"]
    gauge = ["modbus_map", "none", "tcp://10.0.0.1:502", "7", "[0, 20000]", "[0.0, 1000.0]"]
    assert (
        answered(monkeypatch, path, "2", *laser, *pump, *gauge, "", "", "", *NO_CLIMATE, "", "")
        == 2
    )
    output = capsys.readouterr().err
    assert (
        "devices.pump.address and devices.gauge_pressure.address name the same holding register 7"
        in output
    )
    assert not path.exists()


def test_two_names_of_one_serial_port_write_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    port, other = tmp_path / "ttyUSB0", tmp_path / "by-id"
    port.touch()
    other.symlink_to(port)
    answers = [
        "2",
        "optoncdt1420",
        "2",
        str(port),
        "ventus",
        "2",
        str(other),
        "mks_937b",
        "2",
        "/dev/y",
        "",
        "",
        "",
        *NO_CLIMATE,
        "",
        "",
    ]
    assert answered(monkeypatch, path, *answers) == 2
    assert "devices.displacement and devices.pump name the same port" in capsys.readouterr().err
    assert not path.exists()


def test_an_end_of_the_answers_writes_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "lab.toml"
    assert answered(monkeypatch, path) == 130
    assert not path.exists()


def test_explain_prints_the_key(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "explain", "flow_max_um_per_s"]) == 0
    printed = capsys.readouterr().out
    assert "[loop]" in printed
    assert "flow_max_um_per_s: above 0 .. 100 µm/s; default 5.3\n" in printed
    assert "Lower it" in printed
    assert run(["config", "explain", "loop.flow_max_um_per_s", "--json"]) == 0
    ((key,),) = (table["keys"] for table in json.loads(capsys.readouterr().out)["tables"])
    assert (key["unit"], key["default"]) == ("µm/s", "5.3")


def test_the_schema_is_json_and_the_reference_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "schema"]) == 0
    assert json.loads(capsys.readouterr().out)["additionalProperties"] is False
    assert run(["config", "reference"]) == 0
    assert capsys.readouterr().out.startswith("# Configuration\n")
