"""A lens has 0, 4, 5 or 8 coefficients, wherever they are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import CameraConfig, Config
from membrane_ctrl.geometry.file import LensTable
from membrane_ctrl.geometry.prior_file import PriorFile
from membrane_ctrl.measure.capture_set import CaptureFile
from membrane_ctrl.metrology.rays.lens_distortion import distort_points
from membrane_ctrl.model.errors import InputError

LENGTHS = (0, 4, 5, 8)
SECTIONS = (CameraConfig, LensTable)
TABLE = {
    "width_px": 100,
    "height_px": 100,
    "pixel_um": 3.45,
    "focal_mm": 16.0,
    "principal_px": [49.5, 49.5],
}


def numbers(length: int) -> list[float]:
    return [0.0] * length


@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize("length", range(15))
def test_other_lengths_are_refused_with_the_possible_ones(
    section: type[CameraConfig | LensTable], length: int
) -> None:
    table = {**TABLE, "distortion": numbers(length)}
    if length in LENGTHS:
        assert len(toml_file.parse_tables(table, section, "a.toml").distortion) == length
        return
    with pytest.raises(InputError, match=rf"distortion.*: {length} coefficients") as refused:
        toml_file.parse_tables(table, section, "a.toml")
    for possible in LENGTHS[1:]:
        assert str(possible) in str(refused.value)


@pytest.mark.parametrize("length", LENGTHS[1:])
def test_each_possible_length_is_computed(length: int) -> None:
    found = distort_points(np.array([0.1]), np.array([0.2]), tuple(numbers(length)))
    assert found.ravel().tolist() == [0.1, 0.2]


def test_all_files_share_the_check(tmp_path: Path) -> None:
    """Configuration, capture set, calibrated geometry and prior."""
    assert CaptureFile.model_fields["camera"].annotation is CameraConfig
    assert LensTable in PriorFile.model_fields["camera"].annotation.__args__  # type: ignore[union-attr]
    path = tmp_path / "lab.toml"
    path.write_text("[optics.camera]\ndistortion = [-0.01, 0.0]\n")
    with pytest.raises(InputError, match=r"optics\.camera\.distortion.*2 coefficients"):
        toml_file.load_toml(path, Config)
