"""A bright patch with sharp edges and ordinary fringes is a second reflection of the screen."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.frame_checks.film_image import FilmImage, find_film_image

SHAPE = (128, 153)
MM = 7.0  # of a bin on the mirror


def not_needed() -> np.ndarray:
    """The swing of fringes in which nothing is brighter."""
    raise AssertionError("the swing is not needed")


def find(
    light_excess: float, swing_excess: float, blur: bool = False, noise: float = 1.0
) -> FilmImage:
    """Search bins of which a rectangle is brighter."""
    row, column = np.indices(SHAPE).reshape(2, -1)
    position_mm = MM * np.stack([column - 76.0, 63.5 - row])
    index = np.flatnonzero(np.hypot(*position_mm) < 440)
    position_mm = position_mm[:, index]
    x, y = position_mm / 475
    patch = ((np.abs(x - 0.05) < 0.12) & (np.abs(y) < 0.1)).astype(float)
    if blur:
        patch = np.exp(-((x - 0.05) ** 2 + y**2) / 0.05)
    rng = np.random.default_rng(1)
    smooth = 1000 * (1 - 0.2 * x + 0.1 * y - 0.15 * (x**2 + y**2))
    light = smooth * (1 + light_excess * patch) + rng.normal(0, noise, x.size)
    swing = smooth / 2 * (1 + swing_excess * patch) + rng.normal(0, noise, x.size)
    return find_film_image(SHAPE, index, position_mm, light, lambda: swing)


def test_a_patch_of_added_light_is_named_with_place_and_share() -> None:
    found = find(0.14, 0.01)
    assert found.share == pytest.approx(0.14, abs=0.01)
    assert found.x_mm == pytest.approx(24, abs=5)
    assert found.width_mm == pytest.approx(2 * 0.12 * 475, abs=15)
    assert "14% of the light" in found.describe()
    assert "mirror.front_film" in found.describe()


def test_noise_of_the_bins_does_not_hide_a_patch() -> None:
    assert find(0.14, 0.0, noise=35.0).share == pytest.approx(0.14, abs=0.03)
    assert not find(0.0, 0.0, noise=35.0).is_found


@pytest.mark.parametrize(
    ("light", "swing", "blur"),
    [(0.0, 0.0, False), (0.14, 0.14, False), (0.14, 0.0, True), (-0.2, -0.2, False)],
    ids=["even", "a bright panel", "a soft glow", "dust"],
)
def test_other_light_is_none(light: float, swing: float, blur: bool) -> None:
    assert not find(light, swing, blur).is_found
    assert find(light, swing, blur).describe() == ""


def test_the_fringes_are_not_asked_where_no_part_is_brighter() -> None:
    row, column = np.indices(SHAPE).reshape(2, -1)
    position_mm = MM * np.stack([column - 76.0, 63.5 - row])
    index = np.flatnonzero(np.hypot(*position_mm) < 440)
    light = 1000 - 0.3 * position_mm[0, index]
    assert not find_film_image(SHAPE, index, position_mm[:, index], light, not_needed).is_found
