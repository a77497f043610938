"""A geometry in a file: read, applied, refused; and the geometry of a run."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomli_w

from membrane_ctrl.config.schema import (
    CameraConfig,
    Config,
    GeometryConfig,
    OpticsConfig,
    PatternConfig,
)
from membrane_ctrl.geometry.file import read_geometry, stated_origin
from membrane_ctrl.geometry.run_geometry import (
    GEOMETRY_COPY,
    read_configured_geometry,
    read_run_geometry,
)
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.geometry_hash import SCHEMA, hash_content

CAMERA = CameraConfig(width_px=306, height_px=256, pixel_um=27.6)
LENS = {
    "width_px": 306,
    "height_px": 256,
    "pixel_um": 27.6,
    "focal_mm": 16.1,
    "principal_px": [150.0, 127.0],
}


def calibrated(path: Path, **more: object) -> Path:
    """As `calibrate` writes it."""
    tables: dict[str, object] = {
        "schema": SCHEMA,
        "geometry": {"a_mm": 2674.0, "b_mm": 2869.0, "alpha_deg": 81.2},
        **more,
    }
    tables["calibration"] = {
        "date_utc": "2026-01-02T03:04:05+00:00",
        "sets": ["a"],
        "slope_residual_urad": 2.0,
        "slope_noise_urad": 1.5,
        "ring_um": [0.0] * 14,
        "hash": hash_content(tables),
    }
    path.write_text(tomli_w.dumps(tables))
    return path


def test_lens_and_pitch_of_a_calibrated_file_count(tmp_path: Path) -> None:
    file = read_geometry(calibrated(tmp_path / "g.toml", camera=LENS, pattern={"period_mm": 49.9}))
    optics = file.apply_to_optics(OpticsConfig(camera=CAMERA, pattern=PatternConfig(steps=5)))
    assert optics.geometry.a_mm == 2674.0
    assert optics.camera.focal_mm == 16.1
    assert optics.camera.principal == (150.0, 127.0)
    assert optics.camera.noise_adu == CAMERA.noise_adu
    assert (optics.pattern.period_mm, optics.pattern.steps) == (49.9, 5)
    assert file.calibration is not None
    assert file.origin.make_table() == {
        "hash": file.calibration.hash,
        "file": str(file.path),
        "calibrated_utc": "2026-01-02T03:04:05+00:00",
    }


def test_the_camera_of_a_set_counts_for_nothing_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "capture.toml"
    tables = {
        "schema": "membrane-capture/1",
        "geometry": {"a_mm": 2600.0, "b_mm": 2800.0, "alpha_deg": 80.0},
    }
    path.write_text(tomli_w.dumps({**tables, "camera": {"focal_mm": 25.0}}))
    file = read_geometry(path)
    assert file.calibration is None
    assert file.apply_to_optics(OpticsConfig(camera=CAMERA)).camera == CAMERA


def test_a_lens_of_another_camera_is_refused(tmp_path: Path) -> None:
    file = read_geometry(calibrated(tmp_path / "g.toml", camera=LENS))
    with pytest.raises(
        InputError, match=r"g\.toml: camera\.width_px = 306, the frames' camera has 2448"
    ):
        file.apply_to_optics(OpticsConfig())


def test_numbers_that_were_changed_after_the_calibration_are_refused(tmp_path: Path) -> None:
    path = calibrated(tmp_path / "g.toml")
    path.write_text(path.read_text().replace("2674.0", "2675.0"))
    with pytest.raises(
        InputError, match=r"g\.toml: calibration\.hash = .*edited after the calibration"
    ):
        read_geometry(path)


def test_a_stated_geometry_has_a_name_of_its_own() -> None:
    optics = OpticsConfig()
    moved = OpticsConfig(geometry=GeometryConfig(a_mm=2673.0, b_mm=2871.0, alpha_deg=80.9))
    referred = optics.geometry.model_copy(update={"reference_displacement_um": 5.0})
    assert stated_origin(optics).hash != stated_origin(moved).hash
    # where the film stood is not where camera and screen stand
    assert stated_origin(optics) == stated_origin(OpticsConfig(geometry=referred))


def test_a_run_measures_with_the_file_as_it_was_at_its_start(tmp_path: Path) -> None:
    path = calibrated(tmp_path / "g.toml")
    config = Config(optics=OpticsConfig(geometry_file=path))
    begun = read_configured_geometry(config)
    begun.copy_to_run(tmp_path)
    assert begun.optics.geometry.a_mm == 2674.0
    path.unlink()
    kept = read_run_geometry(tmp_path, config)
    assert kept.optics == begun.optics
    assert kept.origin.hash == begun.origin.hash
    assert kept.calibration == begun.calibration
    assert kept.note == ""


def test_a_height_map_beside_the_file_is_kept_with_the_run(tmp_path: Path) -> None:
    lab, run_dir = tmp_path / "lab", tmp_path / "run"
    lab.mkdir()
    run_dir.mkdir()
    (lab / "screen.txt").write_text("0.1 0.0 0.1\n0.2 0.1 0.2\n")
    height_map = {"s_x_mm": [-300, 0, 300], "s_y_mm": [-300, 300], "file": "screen.txt"}
    tables = {
        "geometry": {
            "a_mm": 2672.0,
            "b_mm": 2871.0,
            "alpha_deg": 80.9,
            "screen": {"height_map": height_map},
        }
    }
    covariance = {"names": ["a_mm"], "matrix": [[4.0]]}
    (lab / "g.toml").write_text(tomli_w.dumps({**tables, "covariance": covariance}))
    config = Config(optics=OpticsConfig(geometry_file=lab / "g.toml"))
    begun = read_configured_geometry(config)
    begun.copy_to_run(run_dir)
    kept = read_run_geometry(run_dir, config)
    assert kept.optics == begun.optics
    assert kept.origin.hash == begun.origin.hash
    assert "covariance" in kept.text
    (lab / "screen.txt").write_text("0.1 0.0 0.1\n0.2 0.1 0.3\n")
    assert read_configured_geometry(config).origin.hash != begun.origin.hash


def test_without_a_file_the_measured_geometry_counts_and_this_is_stated(tmp_path: Path) -> None:
    config = Config(optics=OpticsConfig(geometry_file=tmp_path / "g.toml"))
    there = read_configured_geometry(config)
    assert there.optics == config.optics
    assert "g.toml does not exist yet: [optics.geometry] is used" in there.note
    there.copy_to_run(tmp_path)
    assert not (tmp_path / GEOMETRY_COPY).exists()
    assert read_run_geometry(tmp_path, config).note == there.note
    assert read_configured_geometry(Config()).note == ""


def test_a_file_with_which_the_mirror_cannot_be_measured_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "g.toml"
    path.write_text("a_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = 30.0\n")
    with pytest.raises(
        InputError, match=r"g\.toml: geometry\.alpha_deg: the pattern .* in 28% of the mirror"
    ):
        read_configured_geometry(Config(optics=OpticsConfig(geometry_file=path)))


def test_a_file_that_cannot_be_used_is_no_missing_one(tmp_path: Path) -> None:
    (tmp_path / "g.toml").write_text("[geometry]\na_mm = 3\n")
    with pytest.raises(InputError, match=r"g\.toml: a_mm"):
        read_configured_geometry(Config(optics=OpticsConfig(geometry_file=tmp_path / "g.toml")))
