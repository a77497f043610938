"""Reader of SOFAST files: one line names a file and its fault."""

import os
import sys

import h5py
import numpy as np
import pytest

from membrane_ctrl.measure import sofast_file
from membrane_ctrl.model.errors import InputError
from tests.support import sofast_facet


def write(path, **items):
    with h5py.File(path, "w") as file:
        for name, value in items.items():
            file[name.replace("__", "/")] = value
    return path


def measurement(path, frames=32):
    return write(
        path,
        MeasurementSofastFringe__fringe_images=np.arange(frames, dtype=np.uint8)
        * np.ones((3, 5, 1), np.uint8),
        MeasurementSofastFringe__mask_images=np.array([1, 200], np.uint8)
        * np.ones((3, 5, 1), np.uint8),
        MeasurementSofastFringe__fringe_periods_x=[0.9, 3.9, 15.9, 63.9],
        MeasurementSofastFringe__fringe_periods_y=[0.9, 3.9, 15.9, 63.9],
        MeasurementSofastFringe__dist_optic_screen=np.array([10.5]),
    )


def test_frames_are_sorted_by_axis_frequency_and_step(tmp_path):
    read = sofast_file.read_sofast_file(measurement(tmp_path / "m.h5"))
    assert read.frames_y.shape == read.frames_x.shape == (4, 4, 3, 5)
    assert read.frames_y[1, 2, 0, 0] == 6  # y comes first in the file
    assert read.frames_x[1, 2, 0, 0] == 22
    assert (read.black[0, 0], read.white[0, 0]) == (1, 200)
    assert read.distance_mm == 10_500


def test_a_missing_frame_is_counted(tmp_path):
    with pytest.raises(ValueError, match=r"m\.h5: .*fringe_images has 31 frames"):
        sofast_file.read_sofast_file(measurement(tmp_path / "m.h5", frames=31))


def test_a_missing_item_a_missing_file_and_a_wrong_file_are_reported(tmp_path):
    with pytest.raises(ValueError, match=r"e\.h5: Camera/intrinsic_mat is missing"):
        sofast_facet.read_camera(write(tmp_path / "e.h5", other=1))
    with pytest.raises(FileNotFoundError, match="no such file"):
        sofast_facet.read_camera(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(ValueError, match=r"text\.h5: not an HDF5 file"):
        sofast_facet.read_camera(tmp_path / "text.h5")


def test_screens_of_both_models_in_mm_and_no_other(tmp_path):
    screen = write(
        tmp_path / "r.h5",
        DisplayShape__screen_model="rectangular2D",
        DisplayShape__screen_x=8.0,
        DisplayShape__screen_y=3.0,
    )
    assert sofast_facet.read_screen(screen).screen_mm(np.array([[1.0], [0.0]])).tolist() == [
        [4000],
        [-1500],
    ]
    corners = np.array([[0.0, 1, 0, 1], [0, 0, 1, 1]])
    screen = write(
        tmp_path / "d.h5",
        DisplayShape__screen_model="distorted2D",
        DisplayShape__xy_screen_fraction=corners,
        DisplayShape__xy_screen_coords=2 * corners,
    )
    np.testing.assert_allclose(
        sofast_facet.read_screen(screen).screen_mm(np.array([[0.5], [0.25]])), [[1000], [500]]
    )
    with pytest.raises(ValueError, match="distorted3D"):
        sofast_facet.read_screen(write(tmp_path / "3.h5", DisplayShape__screen_model="distorted3D"))


def test_oblong_pixels_become_square_ones_of_the_same_rays(tmp_path):
    path = write(
        tmp_path / "c.h5",
        Camera__intrinsic_mat=np.array([[700.0, 0, 100], [0, 350, 75], [0, 0, 0.125]]),
        Camera__distortion_coef=np.zeros(5),
    )
    camera = sofast_facet.read_camera(path)
    assert (camera.square_rows(np.array([85.0])) - 75) / camera.focal_px[0] == pytest.approx(
        10 / 350
    )


def test_without_h5py_the_missing_extra_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"membrane-ctrl\[sofast\]"):
        sofast_facet.read_camera(tmp_path / "c.h5")


def test_links_out_of_the_file_and_too_large_data_are_refused(tmp_path):
    other = write(tmp_path / "other.h5", Camera__intrinsic_mat=np.eye(3))
    path = tmp_path / "e.h5"
    with h5py.File(path, "w") as file:
        file["Camera/intrinsic_mat"] = h5py.ExternalLink(other.name, "Camera/intrinsic_mat")
    with pytest.raises(
        ValueError, match="intrinsic_mat is a link, and links are not followed here"
    ):
        sofast_facet.read_camera(path)
    with h5py.File(path, "w") as file:
        file["Camera"] = h5py.ExternalLink(other.name, "Camera")
    with pytest.raises(ValueError, match="is a link"):
        sofast_facet.read_camera(path)
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "Camera/intrinsic_mat", (2**38,), "f8", chunks=(2**16,)
        )  # 2 TB of nothing, in 1 kB
    with pytest.raises(ValueError, match="too many to read"):
        sofast_facet.read_camera(path)
    with h5py.File(path, "w") as file:
        file.create_group("Camera/intrinsic_mat")
    with pytest.raises(ValueError, match="not a data set"):
        sofast_facet.read_camera(path)
    with h5py.File(path, "w") as file:
        file.create_dataset("Camera/intrinsic_mat", (3, 3), "f8", external=[(str(other), 0, 72)])
    with pytest.raises(ValueError, match="not a data set of this file"):
        sofast_facet.read_camera(path)


def test_a_pipe_in_place_of_a_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "p.h5")
    with pytest.raises(ValueError, match=r"p\.h5: not an HDF5 file .*not a plain file"):
        sofast_file.read_sofast_file(tmp_path / "p.h5")
