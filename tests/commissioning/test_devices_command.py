"""`devices`: what is plugged in, with the text to paste."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from firmware_iface.links import aravis
from firmware_iface.links.port_names import PortInfo
from membrane_ctrl.cli import run
from membrane_ctrl.commissioning import devices
from membrane_ctrl.config.toml_file import read_toml


def test_a_usb_port_is_named_by_what_survives_a_replug(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ports = [
        PortInfo("/dev/ttyS0", "", "n/a"),
        PortInfo("/dev/ttyUSB0", "usb:0403:6001:A5", "FT232R"),
    ]
    monkeypatch.setattr(devices, "list_serial_ports", lambda: ports)
    first, second = devices.find_ports()
    path = tmp_path / "paste.toml"
    path.write_text(second.paste)
    assert read_toml(path) == {"port": "usb:0403:6001:A5"}
    assert first.paste == 'port = "/dev/ttyS0"'
    assert "FT232R" in second.name


def test_connected_displays_are_listed_with_their_size(tmp_path: Path) -> None:
    for name, status, modes in (
        ("card0-HDMI-A-1", "connected", "1920x1080\n1280x720\n"),
        ("card0-DP-1", "dis", ""),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "status").write_text(status + "\n")
        (tmp_path / name / "modes").write_text(modes)
    assert [display.name for display in devices.find_displays(tmp_path)] == ["HDMI-A-1, 1920x1080"]
    assert devices.find_displays(tmp_path / "nothing") == []


def test_cameras_are_listed_by_aravis_when_it_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    there = [aravis.FoundCamera("Hikrobot-00J1", "Hikrobot", "MV-CS050-10UC", "USB3")]
    monkeypatch.setattr(aravis, "find_cameras", lambda: iter(there))
    (camera,), notes = devices.find_cameras()
    assert (camera.name, camera.paste, notes) == (
        "Hikrobot MV-CS050-10UC",
        'camera = "Hikrobot-00J1"',
        [],
    )


def test_without_aravis_the_rest_is_listed_and_the_remedy_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(aravis, "_LIBRARY", "libaravis-not-there.so")
    aravis.load_aravis.cache_clear()
    monkeypatch.setattr(devices, "list_serial_ports", lambda: [PortInfo("/dev/ttyS0", "", "n/a")])
    assert run(["devices", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["devices"][0]["paste"] == 'port = "/dev/ttyS0"'
    assert "apt install libaravis-0.8-0" in found["notes"][0]
    assert run(["devices"]) == 0
    assert "/dev/ttyS0" in capsys.readouterr().out
    aravis.load_aravis.cache_clear()
