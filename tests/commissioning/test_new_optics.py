"""`devices new` for a camera and for a screen: what is written passes the conformance checks, and
is listed.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from firmware_iface import camera_conformance, display_conformance
from membrane_ctrl.cli import run
from membrane_ctrl.commissioning import devices
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from tests.support.studio_package import install_studio

CONFORMANCE = {"camera": camera_conformance, "screen": display_conformance}


def written(folder: Path, role: str) -> Path:
    """The folder of a driver `acme_<role>`."""
    assert run(["devices", "new", f"acme_{role}", "--role", role, "--to", str(folder)]) == 0
    return folder / f"acme-{role}-driver"


@pytest.fixture
def loaded(tmp_path: Path) -> Iterator[Path]:
    """The modules that a test loads from its folder are forgotten again."""
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.parametrize("role", CONFORMANCE)
def test_what_is_written_conforms(role: str, loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(written(loaded, role))
    bench: Any = importlib.import_module(f"test_acme_{role}").Bench
    checks: list[Any] = CONFORMANCE[role].list_checks(bench)  # type: ignore[attr-defined]
    for check in checks:
        check(bench())
    every = [value for name, value in vars(CONFORMANCE[role]).items() if name.startswith("check_")]
    assert checks == every  # its emulator brings about every fault


@pytest.mark.parametrize("role", CONFORMANCE)
def test_its_configuration_is_complete(role: str, tmp_path: Path) -> None:
    config = load_toml(written(tmp_path, role) / "lab.toml", Config)
    assert config.devices is not None
    assert config.shape.enabled
    tables = {"camera": config.devices.camera, "screen": config.devices.screen}
    external = {
        name for name, table in tables.items() if table is not None and table.driver == "external"
    }
    assert external == {role}
    assert tables[role] is not None
    assert tables[role].name == f"acme_{role}"


def test_devices_and_config_list_an_installed_camera_and_screen(
    loaded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(install_studio(loaded / "site"))
    monkeypatch.setattr(devices, "find_cameras", lambda: ([], []))
    assert run(["devices", "--json"]) == 0
    listed = {device["kind"]: device for device in json.loads(capsys.readouterr().out)["devices"]}
    assert listed["camera driver"]["name"] == "studio_cam, of studio-optics 2.1"
    assert listed["screen driver"]["paste"] == 'driver = "external"\nname = "studio_wall"'
    assert "studio_optics" not in sys.modules  # listed from its metadata
    assert run(["config", "explain", "studio_cam"]) == 0
    output = capsys.readouterr().out
    assert '[devices.camera] driver = "external"' in output
    assert "exposure_ms: above 0 .. 1000 ms; default 10.0" in output
    assert run(["config", "explain", "studio_wall"]) == 0
    output = capsys.readouterr().out
    assert '[devices.screen] driver = "external"' in output
    assert "Pitch of its pixels." in output  # a key of every screen
    assert "Full light." in output
