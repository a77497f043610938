"""Bad configuration is refused in one line that names the file, the field and what would be right."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from membrane_ctrl.config import Config
from membrane_ctrl.config_file import dump, load
from membrane_ctrl.errors import InputError


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[loop]\nrate_khz = 1\n", ["loop.rate_khz", "unknown key", "rate_hz"]),
        ("[looop]\n", ["looop", "did you mean loop"]),
        ("[loop]\nrate_hz = 0\n", ["loop.rate_hz", "1"]),
        ("[loop]\nrate_hz = 'fast'\n", ["loop.rate_hz", "number"]),
        ("[loop]\nsetpoint_um = 9000.0\n", ["setpoint_um", "limits"]),
        ("[loop]\nkp_per_s = nan\n", ["loop.kp_per_s", "finite"]),
        ("[twin]\nlaser_noise_um = -1\n", ["twin.laser_noise_um", "0"]),
        ("[twin]\nscenario = 'stormy'\n", ["twin.scenario", "gusty"]),
        ("[optics.geometry]\na_mm = 2.672\nb_mm = 2871.0\nalpha_deg = 80.9\n", ["optics.geometry.a_mm", "100"]),
        ("[optics.geometry]\na = 2.672\nb_mm = 2871.0\nalpha_deg = 80.9\n", ["optics.geometry.a", "a_mm"]),
        ("[optics.geometry]\na_mm = 2672.0\n", ["optics.geometry", "alpha_deg"]),
        ("[limits]\ndisplacement_min_um = 10\ndisplacement_max_um = 5\n", ["displacement_min_um", "below"]),
        ("[loop\n", ["not valid TOML", "line 1"]),
    ],
)
def test_each_mistake_is_one_line_naming_file_and_field(tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load(path, Config)
    line = str(caught.value)
    assert "\n" not in line
    assert str(path) in line
    for word in words:
        assert word in line


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load(tmp_path / "none.toml", Config)
    with pytest.raises(InputError, match="is a folder"):
        load(tmp_path, Config)


def test_what_is_written_reads_back_the_same() -> None:
    config = Config.model_validate({"loop": {"rate_hz": 20}, "devices": {"board": "tcp://10.0.0.9:502"}})
    assert Config.model_validate(tomllib.loads(dump(config))) == config


def test_every_default_is_written_out() -> None:
    tables = tomllib.loads(dump(Config()))
    assert tables["loop"]["ti_s"] == Config().loop.ti_s
    assert set(tables) == set(Config.model_fields) - {"devices"}
