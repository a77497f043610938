"""Units, polkit rule and settings are written with this program's path, and removed again."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.service import cli
from membrane_ctrl.service.hold_starter import options_file
from membrane_ctrl.service.session_links import SESSION_SOCKET
from membrane_ctrl.service.units import (
    HOLD_UNIT,
    SERVICE_UNIT,
    SESSION_LISTENER,
    SESSION_UNIT,
    USER,
    install_units,
    remove_units,
)

UNITS = "etc/systemd/system"
RULES = "etc/polkit-1/rules.d/50-membrane-ctrl.rules"
DEVICE_RULES = "etc/udev/rules.d/70-membrane-ctrl.rules"
LIMITS = "etc/security/limits.d/50-membrane-ctrl-limits.conf"
SYSCTL = "etc/sysctl.d/50-membrane-ctrl-sysctl.conf"
SETTINGS = "etc/membrane-ctrl/service.toml"
PROGRAM = Path("/srv/mirror/bin/membrane-ctrl")


def unit_of(path: Path, section: str = "Service") -> configparser.SectionProxy:
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(path)
    return parser[section]


def test_what_is_written_fits_together(tmp_path: Path) -> None:
    install_units(tmp_path, PROGRAM)
    settings = load_toml(tmp_path / SETTINGS, ServiceConfig)
    hold, service = (unit_of(tmp_path / UNITS / name) for name in (HOLD_UNIT, SERVICE_UNIT))
    assert settings.units
    assert service["ExecStart"] == f"{PROGRAM} serve --config /{SETTINGS}"
    start = f"{PROGRAM} hold --config {settings.configurations}/%i.toml --name %i --logs"
    assert hold["ExecStart"] == f"{start} {settings.logs} --no-service $HOLD_OPTIONS"
    assert f"safe --no-latch --logs {settings.logs}" in hold["ExecStopPost"]
    assert hold["EnvironmentFile"] == f"-{options_file(Path(settings.logs), '%i')}"
    assert hold["User"] == service["User"] == USER, "the rings check the user"
    assert settings.logs.startswith(service["WorkingDirectory"])
    rule = (tmp_path / RULES).read_text()
    assert f'subject.user == "{USER}"' in rule
    pattern = re.search(r"/(\^membrane-hold.*\$)/", rule)
    assert pattern is not None
    for unit, allowed in (
        ("membrane-hold@lab.service", True),
        ("membrane-hold@a.b-c.service", True),
        ("membrane-service.service", False),
        ("ssh.service", False),
        ("xmembrane-hold@lab.service", False),
        ("membrane-hold@../x.service", False),
    ):
        assert (re.search(pattern[1], unit) is not None) is allowed, unit


def test_sessions_of_the_page_find_their_unit(tmp_path: Path) -> None:
    install_units(tmp_path, PROGRAM)
    settings = load_toml(tmp_path / SETTINGS, ServiceConfig)
    listener = unit_of(tmp_path / UNITS / SESSION_LISTENER, "Socket")
    assert listener["ListenStream"] == str(SESSION_SOCKET)
    assert (listener["SocketUser"], listener["SocketMode"]) == (USER, "0600")
    session = unit_of(tmp_path / UNITS / SESSION_UNIT)
    start = f"{PROGRAM} commission {settings.commissioning} --named-by-input"
    assert session["ExecStart"] == start
    assert session["User"] == USER


@pytest.mark.parametrize("name", [HOLD_UNIT, SESSION_UNIT])
def test_units_at_the_bench_keep_its_devices(tmp_path: Path, name: str) -> None:
    """Each of these makes a list of devices, which all others are not on."""
    install_units(tmp_path, PROGRAM)
    unit = unit_of(tmp_path / UNITS / name)
    assert not {"PrivateDevices", "DeviceAllow", "DevicePolicy", "ProtectClock"} & set(unit)
    assert unit["CapabilityBoundingSet"] == ""


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd")
def test_systemd_knows_every_key(tmp_path: Path) -> None:
    install_units(tmp_path, Path("/bin/true"))
    names = (SERVICE_UNIT, HOLD_UNIT, SESSION_UNIT, SESSION_LISTENER)
    paths = [str(tmp_path / UNITS / name) for name in names]
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--generators=no", *paths],
        env={"SYSTEMD_UNIT_PATH": f"{tmp_path / UNITS}:", "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    own = [line for line in done.stderr.splitlines() if "membrane" in line]
    assert own == []


def test_devices_are_open_to_the_groups_of_the_unit(tmp_path: Path) -> None:
    install_units(tmp_path, PROGRAM)
    rules = (tmp_path / DEVICE_RULES).read_text()
    groups = set(re.findall(r'GROUP="(\w+)"', rules))
    unit = unit_of(tmp_path / UNITS / HOLD_UNIT)
    assert groups == set(unit["SupplementaryGroups"].split())
    for line in rules.splitlines():
        assert line.startswith("#") or ("==" in line and re.search(r'[A-Z}]="', line)), line
    limits = (tmp_path / LIMITS).read_text()
    assert f"@{USER} - rtprio {unit['LimitRTPRIO']}" in limits
    assert f"@{USER} - memlock unlimited" in limits
    assert "net.core.rmem_max" in (tmp_path / SYSCTL).read_text()


def test_a_removal_leaves_only_the_settings(tmp_path: Path) -> None:
    install_units(tmp_path, PROGRAM)
    remove_units(tmp_path)
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert left == [tmp_path / SETTINGS]


def test_an_update_keeps_the_settings_and_removal_keeps_them_too(tmp_path: Path) -> None:
    run = CliRunner().invoke
    words = ["--root", str(tmp_path)]
    assert run(cli.app, ["install", *words, "--program", str(PROGRAM)]).exit_code == 0
    (tmp_path / SETTINGS).write_text('host = "0.0.0.0"\n')
    other = "/other/bin/membrane-ctrl"
    assert run(cli.app, ["install", *words, "--program", other]).exit_code == 0
    assert other in (tmp_path / UNITS / HOLD_UNIT).read_text()
    assert (tmp_path / SETTINGS).read_text() == 'host = "0.0.0.0"\n'
    removed = run(cli.app, ["uninstall", *words])
    assert removed.exit_code == 0
    assert not any((tmp_path / UNITS).iterdir())
    assert not (tmp_path / RULES).exists()
    assert (tmp_path / SETTINGS).exists()
    assert run(cli.app, ["uninstall", *words]).exit_code == 0, "twice is no error"


@pytest.mark.parametrize("path", ["bin/membrane-ctrl", "/a b/membrane-ctrl", "/a%i/membrane-ctrl"])
def test_a_path_that_a_unit_cannot_name_is_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(InputError, match="absolute path without spaces"):
        install_units(tmp_path, Path(path))
    assert list(tmp_path.iterdir()) == []
