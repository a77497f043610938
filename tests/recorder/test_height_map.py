"""Maps of an estimate: the right shape, the right way up, the right size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_TERMS
from membrane_ctrl.run_files.shapes import (
    MAP_PX,
    Scatter,
    difference_map_um,
    height_map_mm,
    outside_disc,
    uncertainty_map_um,
    without_terms,
)
from tests.worlds.synthetic_run import shape_of

# pixel centres on the unit disc, row 0 on top
AXIS = (np.arange(MAP_PX) + 0.5) * 2 / MAP_PX - 1
X, Y = np.meshgrid(AXIS, -AXIS)


def flat() -> np.ndarray:
    return np.zeros(ZERNIKE_TERMS)


def test_a_paraboloid_is_one() -> None:
    coeffs_um = flat()
    coeffs_um[[0, 3]] = 37_000 / 2, 37_000 / (2 * np.sqrt(3))
    height_mm = height_map_mm(replace(shape_of(0.0, 0), coeffs_um=coeffs_um))
    expected = np.where(np.hypot(X, Y) <= 1, 37.0 * (X**2 + Y**2), np.nan)
    assert height_mm == pytest.approx(expected, abs=1e-5, nan_ok=True)


@pytest.mark.parametrize(("j", "slope"), [(2, X), (3, Y)])
def test_tilt_shows_right_and_up(j: int, slope: np.ndarray) -> None:
    now = flat()
    now[j - 1] = 0.5
    reference = shape_of(0.0, 0)
    change_um = difference_map_um(
        replace(reference, coeffs_um=reference.coeffs_um + now), reference
    )
    inside = np.isfinite(change_um)
    assert change_um[inside] == pytest.approx(slope[inside], abs=1e-5)


def test_outside_is_where_nothing_is() -> None:
    height_mm = height_map_mm(shape_of(0.0, 0))
    assert np.array_equal(outside_disc() == 1, np.isnan(height_mm))


def test_uncertainty_agrees_with_drawn_coefficients() -> None:
    rng = np.random.default_rng(4)
    root = 0.01 * rng.normal(size=(ZERNIKE_TERMS, ZERNIKE_TERMS))
    reference = shape_of(0.0, 0)
    drawn = [
        difference_map_um(
            replace(
                reference, coeffs_um=reference.coeffs_um + root @ rng.normal(size=ZERNIKE_TERMS)
            ),
            reference,
        )
        for _ in range(400)
    ]
    expected = np.std(drawn, axis=0)
    found = uncertainty_map_um(root @ root.T)
    inside = np.isfinite(found)
    # 400 draws know a deviation to 3.5 %; four of that at the worst pixel
    assert np.abs(found[inside] / expected[inside] - 1).max() < 0.16


@pytest.mark.parametrize(("terms", "removed"), [(0, ()), (3, (1, 2, 3)), (4, (1, 2, 3, 4))])
def test_only_the_wanted_terms_are_removed(terms: int, removed: tuple[int, ...]) -> None:
    coeffs_um = flat()
    coeffs_um[:7] = 3.0, -0.5, 0.7, 2.0, 0.0, 0.4, 0.2
    reference = shape_of(0.0, 0)
    left = np.where(np.isin(NOLL_INDICES, removed), 0.0, coeffs_um)

    def change_um(of: np.ndarray) -> np.ndarray:
        return difference_map_um(replace(reference, coeffs_um=reference.coeffs_um + of), reference)

    expected = change_um(left)
    if terms:  # above its mean, not above its vertex
        expected -= np.nanmean(expected)
    assert without_terms(change_um(coeffs_um), terms) == pytest.approx(
        expected, abs=2e-3, nan_ok=True
    )


def test_scatter_is_the_deviation_of_the_cycles() -> None:
    rng = np.random.default_rng(5)
    cycles = 1e4 + rng.normal(size=(12, ZERNIKE_TERMS))
    scatter = Scatter()
    for coeffs_um in cycles:
        scatter.add(coeffs_um)
    assert scatter.map_um() == pytest.approx(
        uncertainty_map_um(np.cov(cycles.T)), rel=1e-4, nan_ok=True
    )


def test_one_cycle_does_not_scatter() -> None:
    scatter = Scatter()
    scatter.add(flat() + 1e4)
    assert np.nanmax(scatter.map_um()) == 0.0


def test_terms_are_removed_from_a_map_of_another_size_and_area() -> None:
    x, y = np.meshgrid(*2 * [(np.arange(128) + 0.5) / 64 - 1])
    tilted_um = np.where(np.hypot(x, y) < 0.8, 2 + x + 3 * y + x**2 + y**2, np.nan)
    left_um = without_terms(tilted_um, 4)
    assert (np.isnan(left_um) == np.isnan(tilted_um)).all()
    assert np.nanmax(np.abs(left_um)) < 1e-9
