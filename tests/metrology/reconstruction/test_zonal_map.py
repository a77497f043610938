"""The zonal map: least-squares height on masks, with disconnected parts."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.reconstruction.masked_laplacian import MaskedLaplacian
from membrane_ctrl.metrology.reconstruction.zonal_map import (
    CellSums,
    ResidualGrid,
    integrate_residual,
    residual_grid,
)

AXIS = np.linspace(-100.0, 100.0, 101)
X, Y = np.meshgrid(AXIS, AXIS)


def bowl_grid(seen: np.ndarray) -> ResidualGrid:
    """Slopes of 1e-6 (x^2 + x y): Southwell's mean of two slopes is exact for it."""
    return ResidualGrid(
        AXIS, np.where(seen, 1e-6 * (2 * X + Y), 0), np.where(seen, 1e-6 * X, 0), seen.astype(float)
    )


@pytest.mark.parametrize("hole_mm", [0.0, 20.0])
def test_a_quadratic_comes_back_whatever_the_mask(hole_mm: float) -> None:
    radius = np.hypot(X, Y)
    seen = (radius <= 95) & ((radius >= hole_mm) | (radius == 0))
    # the vertex alone in the hole would be a part of its own
    seen &= (radius > 0) | (hole_mm == 0)
    height = integrate_residual(bowl_grid(seen))
    assert np.array_equal(np.isfinite(height), seen)
    error = (height - 1e-6 * (X**2 + X * Y))[seen]
    assert np.ptp(error) < 1e-4 * np.ptp(height[seen])


def test_the_vertex_is_zero() -> None:
    height = integrate_residual(bowl_grid(np.hypot(X, Y) <= 95))
    assert height[50, 50] == 0.0


def test_parts_that_do_not_hang_together_lie_on_the_fit() -> None:
    seen = np.hypot(X, Y) <= 95
    seen[:, 60:63] = False
    height = integrate_residual(ResidualGrid(AXIS, 1e-6 * seen, 0.0 * seen, seen.astype(float)))
    left, right = height[:, :60], height[:, 63:]
    assert np.nanmean(left) == pytest.approx(np.nanmean(right), abs=1e-9)
    assert np.nanmax(height) - np.nanmin(height) < 1e-6 * 160


def test_nothing_measured_is_nan() -> None:
    empty = np.zeros((101, 101))
    assert np.isnan(integrate_residual(ResidualGrid(AXIS, empty, empty, empty))).all()


def test_pixels_are_averaged_in_their_cell_and_weights_count() -> None:
    field = np.zeros((6, 4))
    field[:2, 1] = 50.0, -20.0
    field[:2, 2] = 50.0, -20.0
    field[2] = 1e-6, 2e-6, 4e-6, 8e-6
    field[:2, 3] = 9e9, 0.0  # off the grid
    grid = residual_grid(field, np.array([1.0, 1.0, 3.0, 1.0]), 100.0)
    cell = grid.count == 4
    assert np.count_nonzero(cell) == 1
    assert grid.slope_x[cell] == pytest.approx(3.5e-6)
    assert np.sum(grid.count) == 5
    assert abs(Y.min()) == 100.0


def test_pixels_may_come_in_parts() -> None:
    rng = np.random.default_rng(4)
    field = rng.uniform(-90, 90, (6, 3000))
    weights = rng.uniform(0, 1, 3000)
    whole = residual_grid(field, weights, 100.0)
    cells = CellSums(3000, 100.0)
    for part in (slice(0, 1300), slice(1300, 3000)):
        cells.add_pixels(field[:, part], weights[part])
    again = cells.mean_residual()
    assert np.allclose(again.slope_x, whole.slope_x, rtol=1e-12, atol=0)
    assert np.allclose(again.count, whole.count, rtol=1e-12, atol=0)


def test_the_solver_meets_its_tolerance() -> None:
    rng = np.random.default_rng(3)
    right, down = rng.uniform(0, 1, (2, 65, 70))
    right[:, -1] = 0
    down[-1] = 0
    true = rng.normal(size=(65, 70))
    rhs = np.zeros_like(true)
    flow = right[:, :-1] * (true[:, :-1] - true[:, 1:])
    rhs[:, :-1] += flow
    rhs[:, 1:] -= flow
    fall = down[:-1] * (true[:-1] - true[1:])
    rhs[:-1] += fall
    rhs[1:] -= fall
    solved = MaskedLaplacian(right, down).solve(rhs, tolerance=1e-10, max_iterations=200)
    assert np.ptp(solved - true) < 1e-6
