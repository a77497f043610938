"""Fields that are computed at some bins only, and the points that a full cycle selects."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.phase import screen_scale
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.bin_grid import BinGrid
from membrane_ctrl.metrology.reconstruction.film_motion import sensitivity_mm_per_um
from membrane_ctrl.metrology.reconstruction.smooth_fields import interpolate_fields
from membrane_ctrl.metrology.reconstruction.tracked_points import TrackedPoints, select_points
from tests.support.metrology_truth import RADIUS_MM

Array = NDArray[np.float64]
CAMERA = CameraConfig(
    width_px=612, height_px=512, pixel_um=3.45 * 4, distortion=(-0.05, 0.0, 0.0, 0.0, 0.0)
)
OPTICS = OpticsConfig(camera=CAMERA)
GEOMETRY = Geometry.from_config(OPTICS)
TRACER = Tracer(GEOMETRY, RADIUS_MM)
PARAMETERS = Surface.hencky_bowl(37.1, RADIUS_MM).parameters.copy()
PARAMETERS[[4, 7, 20, 34]] += (0.8, -0.5, 0.05, 0.02)
FILM = Surface.from_parameters(PARAMETERS, RADIUS_MM)
ANALYSIS_MM = 450.0


@pytest.fixture(scope="module")
def grid() -> BinGrid:
    return BinGrid(GEOMETRY, CAMERA, 2)


def placed(rays: Array) -> Points:
    points = Points.from_rays(rays, np.zeros((2, rays.shape[1])))
    TRACER.place_on_shape(points, FILM.height)
    TRACER.intersect(points, FILM, 3)
    return points


def test_interpolated_fields_are_those_of_all_bins(grid: BinGrid) -> None:
    index = np.flatnonzero(grid.near_mirror(ANALYSIS_MM))
    points = placed(grid.rays[:, index])

    def compute(some: NDArray[np.int64]) -> Array:
        there = points.subset(some)
        bias_mm = grid.averaging_bias_mm(TRACER, there, FILM, index[some])
        return np.vstack([bias_mm, sensitivity_mm_per_um(TRACER, there, FILM)])

    counted = []

    def counting(some: NDArray[np.int64]) -> Array:
        counted.append(some.size)
        return compute(some)

    found = interpolate_fields(counting, index, grid.columns)
    exact = compute(np.arange(index.size))
    largest = np.abs(exact).max(axis=1, keepdims=True)
    assert np.abs((found - exact) / largest).max() < 1e-3
    assert np.sqrt(np.mean(((found - exact) / largest) ** 2)) < 1e-4
    assert sum(counted) < index.size / 5


def test_few_points_are_computed_one_by_one() -> None:
    index = np.array([3, 5, 900])
    found = interpolate_fields(lambda some: np.sin(1.0 * index[some])[None], index, 100)
    assert found == pytest.approx(np.sin(1.0 * index)[None])


def selected(grid: BinGrid, dust_rad: float) -> tuple[TrackedPoints, NDArray[np.int64]]:
    """Points of a film with spots whose phases are off, and the bins of these spots."""
    near = np.flatnonzero(grid.near_mirror(ANALYSIS_MM + 25.0))
    points = placed(grid.rays[:, near])
    offset_mm = grid.averaging_bias_mm(TRACER, points, FILM, near)
    screen_mm = TRACER.predict_screen(points, FILM) + offset_mm
    pattern = OPTICS.pattern
    phase_rad = screen_mm / screen_scale.mm_per_rad(pattern)
    phase_rad += screen_scale.centre_phase_rad(pattern)
    rng = np.random.default_rng(1)
    phase_rad += 1e-3 * rng.standard_normal(phase_rad.shape)
    dust = rng.choice(near.size, near.size // 50, replace=False)
    phase_rad[:, dust] += dust_rad
    found = select_points(grid, TRACER, near, phase_rad, pattern, ANALYSIS_MM)
    return found, near[dust]


def test_every_spot_of_dust_is_left_out(grid: BinGrid) -> None:
    """The first surface goes through a fourth of the bins."""
    found, dust = selected(grid, 0.1)
    assert not np.isin(dust, found.index).any()
    assert np.hypot(*TRACER.position_mm(found.points)).max() <= ANALYSIS_MM + 1e-3
    # White noise of 1 mrad is 1 nm of figure; the bias of the bins is added after the fit.
    without, _ = selected(grid, 0.0)
    assert found.surface.parameters == pytest.approx(without.surface.parameters, abs=3e-5)
    bias_mm = grid.averaging_bias_mm(TRACER, without.points, without.surface, without.index)
    centre_mm = screen_scale.screen_mm(np.zeros(1), OPTICS.pattern)
    assert without.offset_mm == pytest.approx(bias_mm - centre_mm, abs=1e-5)
    clean = without.index[~np.isin(without.index, dust)]
    assert np.isin(clean, found.index).mean() > 0.999
