"""`check` names the control port and the alarms' targets, and refuses what a hold would refuse."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from membrane_ctrl.commissioning.check import check_config
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.config.bridges import BridgesConfig, MqttConfig, OpcuaConfig
from membrane_ctrl.config.port import PortConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.errors import Exit, InputError


def would(config: Config, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    check_config(config, "lab.toml", as_json=True)
    found: dict[str, str] = json.loads(capsys.readouterr().out)["would"]
    return found


def test_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    printed = would(Config(), capsys)
    assert printed["control port"] == "control.sock beside the run folders"
    assert printed["alarms"] == "not sent: no alarms.urls_file"
    assert printed["shape loop"] == "a cycle every 2 s"


def test_check_names_a_hold_that_tracks(capsys: pytest.CaptureFixture[str]) -> None:
    config = Config()
    config = config.model_copy(update={"shape": config.shape.model_copy(update={"mode": "track"})})
    assert would(config, capsys)["shape loop"] == "20 figures/s, tracked"


def test_what_is_configured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: name
    )  # as if Apprise were installed
    urls = tmp_path / "urls.txt"
    urls.write_text("json://localhost\n")
    port = PortConfig(socket="/run/m.sock")
    printed = would(Config(port=port, alarms=AlarmsConfig(urls_file=str(urls))), capsys)
    assert printed["control port"] == "/run/m.sock"
    assert printed["alarms"] == f"2 rules besides faults, to those in {urls}"
    assert would(Config(port=PortConfig(enabled=False)), capsys)["control port"] == "off"


def missing(*libraries: str) -> Callable[[str], object]:
    """`find_spec` without some libraries."""
    found = importlib.util.find_spec
    return lambda name: None if name in libraries else found(name)


def test_where_the_page_would_be(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert would(Config(), capsys)["page"].startswith("of the service")
    off = Config(port=PortConfig(enabled=False))
    assert would(off, capsys)["page"] == "none: port.enabled = false"
    monkeypatch.setattr("importlib.util.find_spec", missing("nicegui"))
    line = "none: it needs nicegui: pip install 'membrane-ctrl[web]'"
    assert would(Config(), capsys)["page"] == line


def test_a_bridge_without_its_library_is_named_and_the_hold_is_possible(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", missing("aiomqtt", "asyncua"))
    config = Config(bridges=BridgesConfig(mqtt=MqttConfig(host="broker"), opcua=OpcuaConfig()))
    assert check_config(config, "lab.toml", as_json=False) == Exit.DONE
    output = " ".join(capsys.readouterr().out.split())
    assert "lab.toml: [bridges.mqtt] needs aiomqtt: pip install 'membrane-ctrl[mqtt]'" in output
    assert "lab.toml: [bridges.opcua] needs asyncua: pip install 'membrane-ctrl[opcua]'" in output


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    missing = str(tmp_path / "missing")
    config = Config(alarms=AlarmsConfig(urls_file=missing))
    with pytest.raises(InputError, match="missing: no such file"):
        check_config(config, "lab.toml", as_json=False)
