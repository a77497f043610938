"""Files that a configuration names are beside it, wherever a command is called."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.cli.options import load_configuration

TEXT = """
[optics]
geometry_file = "geometry.toml"
[port.tls]
certificate_file = "keys/bench.pem"
key_file = "/etc/bench.key"
client_ca_file = "~/lab.pem"
[alarms]
urls_file = "urls"
"""


def test_each_file_is_a_path_from_the_configurations_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "bench.toml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    config = load_configuration(Path("lab/bench.toml"))
    assert config.port.tls is not None
    assert config.optics.geometry_file == tmp_path / "lab" / "geometry.toml"
    assert config.port.tls.certificate_file == str(tmp_path / "lab" / "keys" / "bench.pem")
    assert config.port.tls.key_file == "/etc/bench.key"
    assert config.port.tls.client_ca_file == str(tmp_path / "home" / "lab.pem")
    assert (config.alarms.urls_file, config.alarms.escalation_urls_file) == (
        str(tmp_path / "lab" / "urls"),
        None,
    )


def test_what_is_not_named_stays_unnamed(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text("")
    assert load_configuration(tmp_path / "bench.toml") == load_configuration(None)
