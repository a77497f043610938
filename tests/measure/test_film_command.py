"""`film`: sets of a stretched film become its material, on screen, as JSON and as a picture."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec

OPTICS = OpticsConfig(camera=CameraConfig(width_px=244, height_px=204, pixel_um=3.45 * 10))
FILM = FilmShape(36.0, prestrain=8e-4, poisson=0.38, zernike_um=(0, 0, 0, 0, 120, -80, 30))


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Three sets of one film."""
    folder = tmp_path_factory.mktemp("film")
    for number, start_um in enumerate((-3000.0, 0.0, 3000.0)):
        spec = SimulationSpec(
            OPTICS,
            FILM,
            motion=Motion(start_um),
            seed=number,
            stiffness_n_per_m=1.7e5,
            stated_geometry=OPTICS.geometry.model_copy(update={"reference_displacement_um": 0.0}),
        )
        simulate_set(folder / f"set{number}", spec)
    return [str(folder / f"set{number}") for number in range(3)]


def test_the_material_is_found_and_shown(
    sets: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["film", *sets, "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    for name, true, most in (
        ("prestrain", 8e-4, 2e-5),
        ("poisson", 0.38, 0.01),
        ("stiffness_n_per_m", 1.7e5, 1500.0),
    ):
        found = table[name]
        assert found["value"] == pytest.approx(true, abs=3 * found["sigma"]), name
        assert 0 < found["sigma"] < most, name
    departure = table["departure"]
    assert departure["rms_um"] > 500
    assert departure["left_um"] < 15
    assert departure["left_um"] < 3 * departure["left_sigma_um"]
    out = Path(sets[0]).parent / "film"
    assert json.loads((out / "film.json").read_text()) == table
    assert (out / "film.png").stat().st_size > 10_000


def test_without_pressures_the_stiffness_is_missing(
    sets: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in sets[:2]:
        path = Path(folder) / "capture.toml"
        lines = path.read_text().splitlines(keepends=True)
        path.write_text(
            "".join(line for k, line in enumerate(lines) if k > 4 or "pressure_pa" not in line)
        )
    assert run(["film", *sets[:2], "--no-pictures"]) == 0
    shown = capsys.readouterr().out
    assert "E t is not determined: no set states pressure_pa" in shown
    assert "E t  " not in shown


def test_one_set_is_refused_in_one_line(
    sets: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["film", sets[0]]) == 3
    assert "two or more pressures are needed" in capsys.readouterr().err
