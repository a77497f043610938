"""Simulated sets: what is in the files, the truth beside them, motion and faults."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from membrane_ctrl.config.schema import (
    CameraConfig,
    GeometryConfig,
    MirrorConfig,
    OpticsConfig,
    PatternConfig,
)
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.simulate import simulate_run, simulate_set
from membrane_ctrl.sim.optics.simulation_spec import FrameFault, Motion, SimulationSpec


def _toml(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "capture.toml").read_text())


def _picture(folder: Path, name: str) -> np.ndarray:
    return np.asarray(cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED))


@pytest.fixture
def spec(clean_optics: OpticsConfig, film: FilmShape) -> SimulationSpec:
    return SimulationSpec(clean_optics, film)


def test_a_full_set_is_18_frames_and_what_the_interfaces_ask(
    tmp_path: Path, spec: SimulationSpec
) -> None:
    simulate_set(tmp_path / "set", replace(spec, motion=Motion(12.0), start_s=3.0))
    table = _toml(tmp_path / "set")
    assert (table["schema"], table["kind"]) == ("membrane-capture/1", "full")
    assert PatternConfig(**table["pattern"]) == spec.optics.pattern
    assert MirrorConfig(**table["mirror"]) == spec.optics.mirror
    assert CameraConfig(**table["camera"]).principal == spec.optics.camera.principal
    assert GeometryConfig(**table["geometry"]).reference_displacement_um == 12.0
    assert len(table["frames"]) == 18
    assert table["frames"][5] == {
        "file": "x_gray_2.png",
        "axis": "x",
        "role": "gray",
        "index": 2,
        "time_s": 3.5,
        "displacement_um": 12.0,
    }
    assert table["frames"][16] == {
        "file": "white.png",
        "role": "white",
        "time_s": 4.6,
        "displacement_um": 12.0,
    }
    for frame in table["frames"]:
        picture = cv2.imread(str(tmp_path / "set" / frame["file"]), cv2.IMREAD_UNCHANGED)
        assert picture.shape == (256, 306)
        assert picture.dtype == np.uint16


def test_eight_bit_is_the_rule_and_needs_no_saying(
    tmp_path: Path, small_optics: OpticsConfig, film: FilmShape
) -> None:
    simulate_set(tmp_path, SimulationSpec(small_optics, film))
    assert "bits" not in _toml(tmp_path)["camera"]
    assert _picture(tmp_path, "white").dtype == np.uint8


def test_each_frame_is_taken_at_its_own_displacement(tmp_path: Path, spec: SimulationSpec) -> None:
    moving = replace(spec, motion=Motion(5.0, 1.0, 30.0, 0.3, 0.2), laser_noise_um=1.0, exact=True)
    simulate_set(tmp_path, moving)
    renderer = OpticsRenderer(spec.optics, spec.film, reference_um=moving.reference_um, exact=True)
    with np.load(tmp_path / "truth.npz") as truth:
        displacement_um = truth["displacement_um"]
    time_s = 0.1 * np.arange(18)
    np.testing.assert_allclose(
        displacement_um, 5 + time_s + 30 * np.sin(2 * np.pi * 0.3 * time_s + 0.2), rtol=1e-12
    )
    readings = np.array([frame["displacement_um"] for frame in _toml(tmp_path)["frames"]])
    assert 0.3 < (readings - displacement_um).std() < 2.0
    for frame in (0, 3, 9, 16):
        pattern = moving.patterns[frame]
        expected = renderer.render_picture(pattern, displacement_um[frame])
        np.testing.assert_array_equal(_picture(tmp_path, pattern.name), expected)


def test_the_truth_is_the_surface_above_its_vertex(tmp_path: Path, spec: SimulationSpec) -> None:
    simulate_set(tmp_path, replace(spec, displacements_um=tuple(float(k) for k in range(18))))
    sinusoids = np.array([0, 1, 2, 3, 8, 9, 10, 11], dtype=float)
    with np.load(tmp_path / "truth.npz") as truth:
        x_mm, h_mm, h_per_sag = truth["x_mm"], truth["h_mm"], truth["h_per_sag"]
        assert "coeffs_um" not in truth
    assert h_mm[100, 100] == 0.0
    assert h_mm[100, 150] == pytest.approx(
        spec.film.height_mm(np.array([x_mm[150]]), np.zeros(1), sinusoids.mean())[0], abs=1e-12
    )
    assert h_per_sag[100, 200] == pytest.approx(1.0)
    assert np.isnan(h_mm[0, 0])
    summary = json.loads((tmp_path / "truth.json").read_text())
    assert summary["displacement_um"] == sinusoids.mean()
    assert summary["sag_mm"] == pytest.approx(37.1 + sinusoids.mean() / 1000)
    assert summary["film"]["zernike_um"] == list(spec.film.zernike_um)


def test_a_shape_of_36_terms_comes_with_its_coefficients(
    tmp_path: Path, clean_optics: OpticsConfig
) -> None:
    film = FilmShape(37.0, bowl="paraboloid", zernike_um=(0, 0, 0, 0, 100.0))
    simulate_set(tmp_path, SimulationSpec(clean_optics, film))
    with np.load(tmp_path / "truth.npz") as truth:
        coeffs_um = truth["coeffs_um"]
    assert coeffs_um[3] == pytest.approx(37000 / (2 * np.sqrt(3)))
    assert coeffs_um[0] == pytest.approx(18500)
    assert coeffs_um[4] == 100.0


def test_unequal_shifts_are_written_and_shown(tmp_path: Path, clean_optics: OpticsConfig) -> None:
    optics = clean_optics.model_copy(update={"pattern": PatternConfig(steps=3)})
    shifts = (0.1, 1.9, 4.4)
    simulate_set(tmp_path, SimulationSpec(optics, FilmShape(37.1), "fringes", "../0000", shifts))
    frames = _toml(tmp_path)["frames"]
    assert [frame["shift_rad"] for frame in frames] == [*shifts, *shifts]
    assert _toml(tmp_path)["reference"] == "../0000"
    # the chief ray ends at O', where the phase is 8 pi - pi, so I = A - B cos(shift): two frames
    # give A and B
    levels = [float(_picture(tmp_path, f"x_sin_{k}")[127:129, 152:154].mean()) for k in range(3)]
    b = (levels[1] - levels[0]) / (np.cos(0.1) - np.cos(1.9))
    assert levels[2] == pytest.approx(levels[0] + b * (np.cos(0.1) - np.cos(4.4)), rel=0.01)


def test_a_wrong_geometry_can_be_stated(tmp_path: Path, spec: SimulationSpec) -> None:
    wrong = GeometryConfig(a_mm=2675.0, b_mm=2871.0, alpha_deg=81.2)
    simulate_set(tmp_path, replace(spec, stated_geometry=wrong, laser=False))
    assert _toml(tmp_path)["geometry"] == {"a_mm": 2675.0, "b_mm": 2871.0, "alpha_deg": 81.2}
    assert "displacement_um" not in _toml(tmp_path)["frames"][0]
    assert json.loads((tmp_path / "truth.json").read_text())["geometry"]["alpha_deg"] == 80.9


def _with_fault(folder: Path, spec: SimulationSpec, *faults: str) -> dict[str, np.ndarray | None]:
    """Pictures of the set with the faults, None where the file is missing."""
    simulate_set(folder, replace(spec, faults=tuple(FrameFault.parse(text) for text in faults)))
    names = [pattern.name for pattern in spec.patterns]
    return {
        name: _picture(folder, name) if (folder / f"{name}.png").exists() else None
        for name in names
    }


def test_faults_hit_the_named_frames_and_no_other(tmp_path: Path, spec: SimulationSpec) -> None:
    spec = replace(spec, motion=Motion(0.0, 5.0))
    good = _with_fault(tmp_path / "good", spec)
    bad = _with_fault(
        tmp_path / "bad",
        spec,
        "stale:x_sin_2",
        "swapped:y_sin_1",
        "missing:black",
        "saturated:white",
        "dark:x_gray_1",
        "flicker:x_sin_0:0.7",
        "moved:y_gray_3",
        "wrong_size:y_gray_1",
        "wrong_depth:y_gray_4",
    )
    touched = {
        name for name in good if bad[name] is None or not np.array_equal(bad[name], good[name])
    }
    assert touched == {
        "x_sin_2",
        "y_sin_1",
        "y_sin_2",
        "black",
        "white",
        "x_gray_1",
        "x_sin_0",
        "y_gray_3",
        "y_gray_1",
        "y_gray_4",
    }
    np.testing.assert_array_equal(bad["x_sin_2"], bad["x_sin_1"])
    np.testing.assert_array_equal(bad["y_sin_1"], good["y_sin_2"])
    np.testing.assert_array_equal(bad["y_sin_2"], good["y_sin_1"])
    assert bad["black"] is None
    white, dark, flicker = bad["white"], bad["x_gray_1"], bad["x_sin_0"]
    assert white is not None
    assert dark is not None
    assert flicker is not None
    assert (white == 65535).mean() > 0.3
    assert dark.max() < 0.1 * 65535
    assert flicker.max() == pytest.approx(
        0.02 * 65535 + 0.7 * (good["x_sin_0"].max() - 0.02 * 65535), rel=1e-3
    )
    assert bad["y_gray_1"].shape == (255, 306)
    assert bad["y_gray_4"].dtype == np.uint8
    assert len(_toml(tmp_path / "bad")["frames"]) == 18


def test_a_run_is_one_full_set_and_fringes_that_lean_on_it(
    tmp_path: Path, spec: SimulationSpec
) -> None:
    warnings: list[int] = []
    simulate_run(tmp_path, replace(spec, motion=Motion(10.0, 2.0)), 3, 4.0, warnings.append)
    assert warnings == [1, 2, 3]
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["0000", "0001", "0002"]
    tables = [_toml(tmp_path / f"{number:04d}") for number in range(3)]
    assert [table["kind"] for table in tables] == ["full", "fringes", "fringes"]
    assert [table.get("reference") for table in tables] == [None, "../0000", "../0000"]
    assert all(table["geometry"]["reference_displacement_um"] == 10.0 for table in tables)
    assert [table["frames"][0]["time_s"] for table in tables] == [0.0, 4.0, 8.0]
    assert [table["frames"][0]["displacement_um"] for table in tables] == [10.0, 18.0, 26.0]
    assert len(tables[1]["frames"]) == 8


def test_the_same_seed_writes_the_same_set(
    tmp_path: Path, small_optics: OpticsConfig, film: FilmShape
) -> None:
    for name, seed in (("one", 5), ("again", 5), ("other", 6)):
        simulate_set(
            tmp_path / name, SimulationSpec(small_optics, film, seed=seed, laser_noise_um=1.0)
        )
    one, again, other = (
        (tmp_path / n / "x_sin_0.png").read_bytes() for n in ("one", "again", "other")
    )
    assert one == again
    assert one != other
    assert _toml(tmp_path / "one") == _toml(tmp_path / "again")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "fringes"}, "reference: a fringes set needs"),
        ({"reference": "../0000"}, "reference: only a fringes set"),
        ({"shifts_rad": (0.0, 1.0)}, "shifts_rad: 2 shifts for steps = 4"),
        ({"displacements_um": (0.0,)}, "displacements_um: 1 values for 18 frames"),
        ({"displacements_um": (float("nan"),) * 18}, "displacements_um: every value"),
        ({"motion": Motion(float("inf"))}, "motion, displacements_um: every value"),
        (
            {"displacements_um": (0.0,) * 18, "motion": Motion(1.0)},
            "displacements_um: give these or motion",
        ),
        ({"frame_interval_s": -1.0}, "frame_interval_s = -1.0 must be 0 or more"),
        ({"laser_noise_um": float("inf")}, "laser_noise_um = inf"),
        ({"seed": -1}, "seed = -1"),
        ({"kind": "half"}, "kind = 'half' must be full, fringes or frequencies"),
        ({"faults": (FrameFault("dark", "z_sin_0"),)}, "faults: no frame 'z_sin_0'"),
        ({"faults": (FrameFault("stale", "x_sin_0"),)}, "faults: x_sin_0 has no neighbour"),
        ({"faults": (FrameFault("swapped", "black"),)}, "faults: black has no neighbour"),
    ],
)
def test_what_cannot_be_is_refused_by_its_field(
    spec: SimulationSpec, change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(spec, **change)


@pytest.mark.parametrize(
    "text", ["stale", "melted:x_sin_0", "flicker:x_sin_0:much", "stale:x_sin_1:2"]
)
def test_faults_that_make_no_sense_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="faults:"):
        FrameFault.parse(text)


def test_runs_that_cannot_be_are_refused(tmp_path: Path, spec: SimulationSpec) -> None:
    with pytest.raises(ValueError, match="kind"):
        simulate_run(tmp_path, replace(spec, kind="fringes", reference="../0000"), 2)
    with pytest.raises(ValueError, match="sets = 0"):
        simulate_run(tmp_path, spec, 0)
    with pytest.raises(ValueError, match="interval_s = 1 is shorter"):
        simulate_run(tmp_path, spec, 2, 1.0)
    assert list(tmp_path.iterdir()) == []
