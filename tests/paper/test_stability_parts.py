"""The stability series: air that is missing, pairs of sets, and sets without a laser."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.paper.comparison import Agreement
from membrane_ctrl.paper.stability_parts import (
    PAPER_MEAN_SD_UM,
    SetSeries,
    compare_pairs,
    estimate_film_share_um,
    find_air_um,
    report_too_few,
)


def make_series(time_s: list[float], displacement_um: list[float]) -> SetSeries:
    return SetSeries(np.zeros((len(time_s), 3)), np.array(time_s), np.array(displacement_um), 0)


def test_air_is_added_in_squares_to_what_is_there() -> None:
    still_um, air_um = np.full(5, 2.0), np.full(5, 1.5)  # air of 100 µm
    expected_um = 100.0 * np.sqrt(PAPER_MEAN_SD_UM**2 - 2.0**2) / 1.5
    assert find_air_um(still_um, air_um) == pytest.approx(expected_um)


def test_pairs_are_an_interval_apart_in_time() -> None:
    # the set at 60 s is missing, and the last comes late
    series = make_series([0.0, 30.0, 90.0, 151.0], [0.0] * 4)
    height_um = np.array([[0.0], [1.0], [3.0], [7.0]])
    found = compare_pairs(series, height_um, 60.0)
    assert found is not None
    comparison, values = found
    assert values == {"pairs": 2.0, "mean_um": 3.0, "max_um": 4.0}
    assert comparison.agreement is Agreement.UNSTATED
    assert compare_pairs(series, height_um, 600.0) is None
    assert compare_pairs(make_series([np.nan] * 4, [0.0] * 4), height_um, 60.0) is None


def test_sets_farther_apart_than_the_interval_are_no_pairs() -> None:
    series = make_series([0.0, 600.0, 1200.0], [0.0] * 3)
    assert compare_pairs(series, np.zeros((3, 1)), 60.0) is None


@pytest.mark.parametrize("readings_um", [[0.0, np.nan, 1.0], [2.0, 2.0, 2.0]])
def test_the_film_has_no_share_without_readings(readings_um: list[float]) -> None:
    series = make_series([0.0, 4.0, 8.0], readings_um)
    assert estimate_film_share_um(series, np.ones((3, 2))) is None


def test_the_share_of_the_film_follows_the_readings() -> None:
    series = make_series([0.0, 4.0, 8.0], [0.0, 1.0, 2.0])
    height_um = np.outer([0.0, 1.0, 2.0], [0.5, 0.9])
    np.testing.assert_allclose(estimate_film_share_um(series, height_um), height_um, atol=1e-12)


def test_one_figure_is_reported() -> None:
    result = report_too_few(make_series([0.0], [0.0]))
    assert "1 of 1 sets gave a figure" in result.comparisons[0].ours
