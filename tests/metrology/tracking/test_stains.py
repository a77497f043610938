"""A stain and a motion of the bench, by what the fit of a frame leaves in cells of the mirror."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.tracking.stains import Stain, find_stain

SIDE = 4  # bins of a cell
CELLS = 600
NOISE_ADU = 0.5
Array = NDArray[np.float64]


def draw(stain: float, phase_rad: float) -> tuple[Array, Array]:
    """Products and powers of cells with fringes of 12 bins along x and y, where patches have
    changed light and phases by so much RMS.
    """
    rng = np.random.default_rng(5)
    place = np.arange(SIDE) * 2 * np.pi / 12
    x = place[:, None] + rng.uniform(0, 2 * np.pi, (CELLS, 1, 1)) + np.zeros((1, 1, SIDE))
    y = place[None, :] + rng.uniform(0, 2 * np.pi, (CELLS, 1, 1)) + np.zeros((1, SIDE, 1))
    waves = np.stack([100 + 40 * np.cos(x) + 40 * np.cos(y), -40 * np.sin(x), -40 * np.sin(y)])
    amounts = np.array([stain, phase_rad, phase_rad])[:, None]
    amounts = (amounts * rng.standard_normal((3, CELLS)))[:, :, None, None]
    residual = np.sum(amounts * waves, axis=0) + NOISE_ADU * rng.standard_normal(x.shape)
    products = np.sum(waves * residual, axis=(2, 3))
    return products, np.sum(waves**2, axis=(2, 3))


def test_noise_and_turned_phases_are_no_stain() -> None:
    assert find_stain(*draw(0.0, 0.0), NOISE_ADU) is None
    assert find_stain(*draw(0.0, 0.05), NOISE_ADU) is None


@pytest.mark.parametrize("share", [0.01, 0.02, 0.05])
def test_a_stain_is_found_with_its_size(share: float) -> None:
    stain = find_stain(*draw(share, 0.0), NOISE_ADU)
    assert stain is not None
    assert stain.share == pytest.approx(share, rel=0.15)
    assert f"{stain.share:.1%}" in stain.describe()


def test_a_stain_beside_larger_errors_of_the_phases_is_none() -> None:
    assert find_stain(*draw(0.01, 0.1), NOISE_ADU) is None


def test_a_stain_explains_a_figure_that_is_bent_a_little() -> None:
    assert Stain(0.02).explains(0.14)
    assert not Stain(0.02).explains(1.0)


def test_a_dark_picture_shows_no_stain() -> None:
    assert find_stain(np.zeros((3, 5)), np.zeros((3, 5)), NOISE_ADU) is None
