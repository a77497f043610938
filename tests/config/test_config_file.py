"""Bad configuration is refused in one line that names the file, the field and a valid value."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.model.errors import InputError


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
        (
            "[optics.geometry]\na_mm = 2.672\nb_mm = 2871.0\nalpha_deg = 80.9\n",
            ["optics.geometry.a_mm", "100"],
        ),
        (
            "[optics.geometry]\na = 2.672\nb_mm = 2871.0\nalpha_deg = 80.9\n",
            ["optics.geometry.a", "a_mm"],
        ),
        ("[optics.geometry]\na_mm = 2672.0\n", ["optics.geometry", "alpha_deg"]),
        (
            "[limits]\ndisplacement_min_um = 10\ndisplacement_max_um = 5\n",
            ["displacement_min_um", "below"],
        ),
        ("[loop\n", ["not valid TOML", "line 1"]),
        (
            "[devices.displacement]\ndriver = 'optoncdt1420'\nprot = '/dev/x'\n",
            ["devices.displacement.prot", "did you mean port?"],
        ),
        ("[devices.pump]\ndriver = 'vents'\n", ["devices.pump.driver", "did you mean ventus?"]),
        (
            "[devices.camera]\ndriver = 'aravis'\nexposre_ms = 3\n",
            ["devices.camera.exposre_ms", "exposure_ms?"],
        ),
        ("[[alarms.rules]]\nnam = 'x'\n", ["alarms.rules.0.nam", "did you mean name?"]),
    ],
)
def test_each_mistake_is_one_line_naming_file_and_field(
    tmp_path: Path, text: str, words: list[str]
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_toml(path, Config)
    line = str(caught.value)
    assert "\n" not in line
    assert str(path) in line
    for word in words:
        assert word in line


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_toml(tmp_path / "none.toml", Config)
    with pytest.raises(InputError, match="is a folder"):
        load_toml(tmp_path, Config)


OPTICS = "[optics.geometry]\na_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = 80.9\n"
GRID = "[optics.geometry.screen.height_map]\ns_x_mm = [-250, 250]\ns_y_mm = [-250, 0, 250]\n"


def test_a_screens_height_map_may_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "screen.txt").write_text("# mm\n0.1, 0.2\n0.3 0.4\n\n0.5, 0.6  # top\n")
    (tmp_path / "lab.toml").write_text(f"{OPTICS}{GRID}file = 'screen.txt'\n")
    config = load_toml(tmp_path / "lab.toml", Config)
    screen = config.optics.geometry.screen
    assert screen is not None
    assert screen.height_map is not None
    assert screen.height_map.heights_mm == ((0.1, 0.2), (0.3, 0.4), (0.5, 0.6))
    # the run's own configuration holds the numbers
    (tmp_path / "screen.txt").unlink()
    (tmp_path / "config.toml").write_text(dump_toml(config))
    assert load_toml(tmp_path / "config.toml", Config) == config


@pytest.mark.parametrize(
    ("tail", "words"),
    [
        ("file = 'none.txt'\n", ["height_map.file", "none.txt", "No such file"]),
        ("file = 'lab.toml'\n", ["height_map.file", "could not convert"]),
        ("file = 'a'\nheights_mm = [[0, 0]]\n", ["give either the file or heights_mm"]),
        ("heights_mm = [[0, 0]]\n", ["screen.height_map", "1 rows of 2"]),
        ("", ["heights_mm", "missing"]),
    ],
)
def test_a_wrong_height_map_is_one_line(tmp_path: Path, tail: str, words: list[str]) -> None:
    (tmp_path / "lab.toml").write_text(OPTICS + GRID + tail)
    with pytest.raises(InputError) as caught:
        load_toml(tmp_path / "lab.toml", Config)
    for word in [str(tmp_path / "lab.toml"), *words]:
        assert word in str(caught.value)


def test_what_is_written_reads_back_the_same() -> None:
    config = Config.model_validate(
        {"loop": {"rate_hz": 20}, "devices": {"board": "tcp://10.0.0.9:502"}}
    )
    assert Config.model_validate(tomllib.loads(dump_toml(config))) == config


def test_every_default_is_written_out() -> None:
    tables = tomllib.loads(dump_toml(Config()))
    assert tables["loop"]["ti_s"] == Config().loop.ti_s
    assert set(tables) == set(Config.model_fields) - {"devices"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[loop]\nkp_per_s = 0,61\n", ["line 2", "write 0.61"]),
        (
            b"[loop]\nkp_per_s = '0,61'\n",
            ["loop.kp_per_s", "'0,61'", "without quotes, with a decimal point"],
        ),
        (b"[loop]\nkp_per_s = '0.61'\n", ["loop.kp_per_s", "without quotes"]),
        (
            b"[optics.camera]\nprincipal_px = ['1', 2]\n",
            ["optics.camera.principal_px", "without quotes"],
        ),
        (b"[loop]\nkp_per_s = true\n", ["loop.kp_per_s", "true is neither"]),
        (b"[shape]\nenabled = 1\n", ["shape.enabled", "write true or false"]),
        (b"[shape]\nenabled = 'no'\n", ["shape.enabled", "write true or false"]),
        (b"[twin]\nseed = true\n", ["twin.seed", "true is neither"]),
        (b"[loop]\nkp_per_s = 1\nkp_per_s = 2\n", ["line 3", "kp_per_s = 2 comes twice"]),
        (b"[loop]\n[loop]\n", ["line 2", "[loop] comes twice"]),
        (b"loop = 3\n", ["loop: write a table, [loop]"]),
        (b"[[loop]]\nkp_per_s = 1\n", ["loop: write a table, [loop]"]),
        (b"[alarms.rules]\nname = 'x'\n", ["[[alarms.rules]]"]),
        (b"[resume]\nfaults = 'link_lost'\n", ["resume.faults: write a list, in square brackets"]),
        (b"kp_per_s = 1\n", ["it belongs in [loop]"]),
        (b"[optics]\na_mm = 2672\n", ["it belongs in [optics.geometry]"]),
        (b"[devices.pump]\nport = '/dev/x'\n", ["devices.pump.driver: missing", "ventus"]),
        (
            b"[devices.displacement]\ndriver = 'optoncdt1420'\n",
            ["devices.displacement.port: missing"],
        ),
        (b"[devices]\nboard = '10.0.0.3:502'\n", ["devices.board", "tcp://HOST:PORT"]),
        (b"[devices]\nboard = 'tcp://'\n", ["devices.board", "tcp://HOST:PORT"]),
        (b"[optics]\ngeometry_file = 3\n", ["optics.geometry_file", "valid path (it is 3)"]),
        (b"[limits]\ndisplacement_min_um = -1e308\n", ["limits.displacement_min_um", "-10000000"]),
        (b"[twin]\nseed = 99999999999999999999\n", ["twin.seed"]),
        (b"[loop]\nkp_per_s = 1e400\n", ["loop.kp_per_s", "finite"]),
        ("[loop]\nkp_per_s = 1\n".encode("utf-16"), ["UTF-8"]),
    ],
    ids=repr,
)
def test_the_error_line_shows_what_to_write_instead(
    tmp_path: Path, text: bytes, words: list[str]
) -> None:
    path = tmp_path / "lab.toml"
    path.write_bytes(text)
    with pytest.raises(InputError) as caught:
        load_toml(path, Config)
    line = str(caught.value)
    assert "\n" not in line
    for word in [str(path), *words]:
        assert word in line, line


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"\xef\xbb\xbf[loop]\nkp_per_s = 0.5\n",
        b"[loop]\r\n\tkp_per_s = 0.5\r\n",
        b"# only a comment",
    ],
    ids=["empty", "byte order mark", "other line ends and tabs", "comment"],
)
def test_what_editors_write_is_read(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "lab.toml").write_bytes(text)
    (tmp_path / "link.toml").symlink_to("lab.toml")
    config = load_toml(tmp_path / "link.toml", Config)
    assert config.loop.kp_per_s == (0.5 if b"kp" in text else Config().loop.kp_per_s)
