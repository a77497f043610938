"""Replacing a geometry file: the old one is kept, and stays if the new one cannot be written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from membrane_ctrl.calibration.adopt import adopt_geometry
from membrane_ctrl.calibration.compare_geometries import compare_geometries
from membrane_ctrl.config.schema import GeometryConfig, OpticsConfig
from membrane_ctrl.geometry.file import read_geometry, stated_origin
from membrane_ctrl.model.errors import DeviceError

NEW = "a_mm = 2674.0\nb_mm = 2869.0\nalpha_deg = 81.2\n"


@pytest.fixture
def new(tmp_path: Path) -> Path:
    path = tmp_path / "new.toml"
    path.write_text(NEW)
    return path


def test_where_there_was_none(new: Path, tmp_path: Path) -> None:
    place = tmp_path / "lab" / "bench.toml"
    assert adopt_geometry(new, place) is None
    assert place.read_text() == NEW


@pytest.mark.parametrize("old", ["a_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = 80.9\n", "spoilt ="])
def test_the_old_one_is_kept_with_its_date_twice_if_need_be(
    new: Path, tmp_path: Path, old: str
) -> None:
    place = tmp_path / "bench.toml"
    kept = []
    for _ in range(2):
        place.write_text(old)
        os.utime(place, (1e9, 1e9))
        kept.append(adopt_geometry(new, place))
    assert [path.name for path in kept if path] == [
        "bench-20010909T014640Z.toml",
        "bench-20010909T014640Z-2.toml",
    ]
    assert [path.read_text() for path in kept if path] == [old, old]
    assert place.read_text() == NEW


def test_a_place_that_cannot_be_written(new: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match=r"file/bench\.toml: cannot be written"):
        adopt_geometry(new, tmp_path / "file" / "bench.toml")


def test_old_beside_new_as_a_tape_would_have_it(new: Path) -> None:
    optics = OpticsConfig(geometry=GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9))
    lines = compare_geometries(optics, stated_origin(optics), read_geometry(new))
    assert lines[0].startswith("in use: by hand, hash ")
    assert [line.split()[-2:] for line in lines[2:]] == [
        ["2672.000", "2674.000"],
        ["2871.000", "2869.000"],
        ["80.900", "81.200"],
        ["0.000", "0.000"],
    ]
