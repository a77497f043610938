"""Colours of maps: typical values set the scale, and steep maps do not hide the rest."""

import numpy as np
import pytest

from membrane_ctrl.drawing.axis_scale import Spacing
from membrane_ctrl.measure.map_colours import choose_map_colours, describe_map

SMOOTH = np.random.default_rng(1).normal(5.0, 1.0, (90, 90))


def test_typical_values_set_the_scale_of_a_plain_map() -> None:
    values = SMOOTH.copy()
    values[3, 4] = 1e6
    values[:, 0] = np.nan
    scale = choose_map_colours(values, values, even=False)
    assert scale.spacing is Spacing.LINEAR
    assert (scale.low, scale.high) == pytest.approx((2.4, 7.6), abs=0.2)


def test_an_even_scale_is_centred_on_zero() -> None:
    scale = choose_map_colours(SMOOTH - 5, SMOOTH - 5, even=True)
    assert scale.low == -scale.high
    assert scale.spacing is Spacing.LINEAR
    assert scale.high == pytest.approx(2.6, abs=0.2)


def test_a_steep_place_is_drawn_on_a_logarithmic_scale() -> None:
    values = SMOOTH - 5
    values[30:33, 30:33] = 200.0
    scale = choose_map_colours(values, values, even=True)
    assert scale.spacing is Spacing.SYMMETRIC
    assert scale.linear_to < 4
    assert scale.high == pytest.approx(200.0)


def test_a_map_of_one_value_has_a_scale() -> None:
    flat = np.zeros((9, 9))
    for even in (False, True):
        scale = choose_map_colours(flat, flat, even)
        assert scale.low < scale.high
        assert np.isfinite(scale.shares(flat)).all()


def test_numbers_beside_a_map() -> None:
    values = np.array([[1.0, np.nan], [3.0, 5.0]])
    assert describe_map(values) == "PV 4\nRMS 1.63"
