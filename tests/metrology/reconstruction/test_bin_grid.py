"""The bins' rays and areas, and the effect of averaging over a bin."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.bin_grid import BinGrid
from tests.support.metrology_truth import RADIUS_MM

# 16 pixels of the paper's camera in one: bins of 4 pixels are 9 mm on the mirror, and the bias is
# large
CAMERA = CameraConfig(width_px=612, height_px=512, pixel_um=3.45 * 4)
GEOMETRY = Geometry.from_config(OpticsConfig(camera=CAMERA))
TRACER = Tracer(GEOMETRY, RADIUS_MM)
PARAMETERS = Surface.hencky_bowl(37.1, RADIUS_MM).parameters.copy()
PARAMETERS[[5, 7, 20]] += (1.0, -0.8, 0.2)
FILM = Surface.from_parameters(PARAMETERS, RADIUS_MM)


def _traced(rays: np.ndarray) -> tuple[Points, np.ndarray]:
    points = Points.from_rays(rays, np.zeros((2, rays.shape[1])))
    TRACER.place_on_shape(points, FILM.height)
    TRACER.intersect(points, FILM, 3)
    return points, TRACER.predict_screen(points, FILM)


@pytest.mark.parametrize("bin_px", [1, 2, 4])
def test_bias_is_that_of_the_mean_over_the_pixels(bin_px: int) -> None:
    grid = BinGrid(GEOMETRY, CAMERA, bin_px)
    index = np.flatnonzero(grid.near_mirror(440.0))[:: 40 // bin_px]
    points, centre = _traced(grid.rays[:, index])
    bias = grid.averaging_bias_mm(TRACER, points, FILM, index)
    offsets = np.arange(bin_px) - (bin_px - 1) / 2
    pixels = [
        _traced(GEOMETRY.rays(grid.column_px[index] + right, grid.row_px[index] + down))[1]
        for right in offsets
        for down in offsets
    ]
    seen = np.mean(pixels, axis=0) - centre
    assert bias == pytest.approx(seen, abs=5e-6)  # what is left is of fourth order
    if bin_px == 4:
        assert np.abs(seen).max() > 0.03  # what would be left without it


def test_solid_angles_of_the_mirror_add_up_to_its_area() -> None:
    grid = BinGrid(GEOMETRY, CAMERA, 2)
    index = np.flatnonzero(grid.near_mirror(450.0))
    t = -GEOMETRY.pinhole_mm[2] / grid.rays[2, index]
    area = np.sum(grid.solid_angle(index) * t**2 / np.abs(grid.rays[2, index]))
    assert area == pytest.approx(np.pi * 450**2, rel=2e-3)
