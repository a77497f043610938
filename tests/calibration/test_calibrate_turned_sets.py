"""Sets of a turned mirror, from `simulate` and `ctl capture` to the report of `calibrate`."""

from __future__ import annotations

import json
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.sim.optics.film_shape import Ripple, typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec
from membrane_ctrl.sim.optics.turned_film import MirrorSeat, turn_film

SHRINK = 16
NOISE = 256 * float(np.hypot(0.4, np.sqrt(1 / 12))) / SHRINK
CAMERA = CameraConfig(
    width_px=2448 // SHRINK,
    height_px=2048 // SHRINK,
    pixel_um=3.45 * SHRINK,
    bits=16,
    noise_adu=NOISE,
)
STATED = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9, reference_displacement_um=0.0)
TRUE = GeometryConfig(a_mm=2674.0, b_mm=2869.0, alpha_deg=81.2, reference_displacement_um=0.0)
FILM = typical_film(37.1, 500.0, seed=1)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three sets of the film, and one of the mirror turned by a hand by 120 degrees."""
    root = tmp_path_factory.mktemp("turned")
    seat = MirrorSeat.drawn(120.0, 4)
    usual = [(FILM, None, moved_um) for moved_um in (-3000.0, 0.0, 3000.0)]
    for k, (film, seated, moved_um) in enumerate([*usual, (turn_film(FILM, seat, 0.0), seat, 0.0)]):
        spec = SimulationSpec(
            OpticsConfig(geometry=TRUE, camera=CAMERA),
            film,
            motion=Motion(start_um=moved_um),
            laser_noise_um=1.0,
            stated_geometry=STATED,
            seed=k + 1,
            mirror_turned={} if seated is None else {"angle_deg": 120.0},
            seat=seated,
        )
        simulate_set(root / f"set{k}", spec)
    return [root / f"set{k}" for k in range(4)]


def calibrate(folders: list[Path], out: Path) -> list[str]:
    named = [str(folder) for folder in folders]
    return ["calibrate", *named, "--out", str(out), "--json", "--no-pictures"]


def test_the_command_states_the_turn_in_the_set_and_its_seat_in_the_truth(tmp_path: Path) -> None:
    pixels = CAMERA.model_dump(exclude_none=True)
    optics = {"geometry": TRUE.model_dump(exclude_none=True), "camera": pixels}
    (tmp_path / "truth.toml").write_text(tomli_w.dumps({"optics": optics}))
    seats = []
    for angle_deg in ("120", "240"):
        out = tmp_path / angle_deg
        words = ["--config", str(tmp_path / "truth.toml"), "--turned-deg", angle_deg]
        assert run(["simulate", str(out), *words]) == 0
        stated = tomllib.loads((out / "capture.toml").read_text())["mirror_turned"]
        assert stated == {"angle_deg": float(angle_deg)}
        seats.append(json.loads((out / "truth.json").read_text())["seat"])
        assert 0.0 < abs(seats[-1]["angle_deg"] - float(angle_deg)) < 1.0
    assert seats[0]["shift_mm"] != seats[1]["shift_mm"]


def test_the_turned_film_is_the_film_in_its_own_axes() -> None:
    seat = MirrorSeat(90.0, (0.4, -0.3), 0.2, (1e-4, 0.0))
    turned = turn_film(FILM, seat, 500.0)
    x_mm, y_mm = np.array([100.0, -250.0, 0.0, 330.0]), np.array([50.0, 200.0, 0.0, -310.0])
    deeper = typical_film(37.3, 500.0, seed=1)
    own = deeper.height_mm(y_mm + 0.3, -(x_mm - 0.4), 500.0) + 1e-4 * x_mm
    seen = turned.height_mm(x_mm, y_mm, 500.0)
    assert seen - seen[2] == pytest.approx(own - own[2], abs=2e-6)
    with pytest.raises(ValueError, match="ripples"):
        turn_film(replace(FILM, ripples=(Ripple(0.1, 30.0),)), seat, 0.0)


def test_the_report_states_the_turn_that_was_found(
    sets: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(calibrate(sets, tmp_path / "g.toml")) == 0
    report = json.loads(capsys.readouterr().out)
    assert not [finding for finding in report["findings"] if finding["fatal"]]
    assert [row["turned"] for row in report["sets"][:3]] == [None] * 3
    turn = report["sets"][3]["turned"]
    seat = json.loads((sets[3] / "truth.json").read_text())["seat"]
    assert turn["angle_deg"] == 120.0
    assert abs(turn["found_deg"] - seat["angle_deg"]) < 4 * turn["sigma_deg"]
    assert turn["sigma_deg"] < 0.1
    place = np.array([turn["x_mm"], turn["y_mm"]]) - seat["shift_mm"]
    assert np.abs(place).max() < 4 * turn["seat_sigma_mm"]
    found = {row["name"]: row for row in report["parameters"]}
    for name, true in (("a_mm", 2.0), ("b_mm", -2.0), ("alpha_deg", 0.3)):
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"], name


@pytest.mark.parametrize(
    ("becomes", "exit_code", "message"),
    [
        ("angle_deg = 1200.0", 2, "mirror_turned.angle_deg"),
        ("angle_deg = 120.0\nangle_sigma_deg = 0.0", 2, "mirror_turned.angle_sigma_deg"),
        ("angle_deg = 240.0", 3, "degrees, mirror_turned states 240"),
    ],
)
def test_a_turn_that_cannot_be_is_refused(
    sets: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    becomes: str,
    exit_code: int,
    message: str,
) -> None:
    wrong = tmp_path / "turned"
    wrong.mkdir()
    for picture in sets[3].glob("*.png"):
        shutil.copy(picture, wrong)
    text = (sets[3] / "capture.toml").read_text()
    assert "angle_deg = 120.0" in text
    (wrong / "capture.toml").write_text(text.replace("angle_deg = 120.0", becomes))
    assert run(calibrate([*sets[:3], wrong], tmp_path / "g.toml")) == exit_code
    printed = capsys.readouterr()
    assert message in printed.err + printed.out
    assert not (tmp_path / "g.toml").exists()


def test_turned_sets_alone_are_refused(
    sets: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(calibrate(sets[3:], tmp_path / "g.toml")) == 2
    assert "mirror_turned: all sets of the film have it" in capsys.readouterr().err


def test_a_turned_set_is_one_set_of_the_film(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["--sets", "2"], ["--artefact", "sphere:3400:200"]):
        assert run(["simulate", str(tmp_path / "x"), "--turned-deg", "120", *words]) == 2
        assert "--turned-deg" in capsys.readouterr().err
