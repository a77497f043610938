"""Files that a configuration names are beside it, wherever a command is called."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.cli.options import load_configuration

TEXT = """
[optics]
geometry_file = "geometry.toml"
[bridges.opcua]
users_file = "keys/users"
certificate_file = "/etc/bench.pem"
key_file = "~/bench.key"
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
    opcua = config.bridges.opcua
    assert opcua is not None
    assert config.optics.geometry_file == tmp_path / "lab" / "geometry.toml"
    assert opcua.users_file == str(tmp_path / "lab" / "keys" / "users")
    assert opcua.certificate_file == "/etc/bench.pem"
    assert opcua.key_file == str(tmp_path / "home" / "bench.key")
    assert (config.alarms.urls_file, config.alarms.escalation_urls_file) == (
        str(tmp_path / "lab" / "urls"),
        None,
    )


def test_what_is_not_named_stays_unnamed(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text('[shape]\nmode = "auto"\n')  # as without a file
    assert load_configuration(tmp_path / "bench.toml") == load_configuration(None)
