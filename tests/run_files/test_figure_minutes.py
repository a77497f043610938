"""Measured figures minute by minute: means and scatter are those of the minute's figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import decode_state, encode_state
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.figure_minutes import FigureMinute, OpenFigureMinute
from tests.worlds.synthetic_run import shape_of

SAG_UM = 18_500.0


def figures(count: int, interval_s: float, seed: int = 1) -> list[ShapeEstimate]:
    """Figures of a deep bowl, which scatter by nanometres."""
    rng = np.random.default_rng(seed)
    return [
        replace(
            shape_of(number * interval_s, number),
            coeffs_um=SAG_UM + 0.002 * rng.standard_normal(ZERNIKE_TERMS),
        )
        for number in range(count)
    ]


def minutes_of(estimates: list[ShapeEstimate]) -> list[FigureMinute]:
    opened = OpenFigureMinute()
    ended = [opened.add_figure(estimate) for estimate in estimates] + [opened.end_minute()]
    return [minute for minute in ended if minute is not None]


def test_each_minute_has_mean_and_scatter_of_its_figures() -> None:
    estimates = figures(100, 2.0)
    found = minutes_of(estimates)
    assert [(each.time_s, each.figures) for each in found] == [
        (0.0, 30),
        (60.0, 30),
        (120.0, 30),
        (180.0, 10),
    ]
    for number, minute in enumerate(found):
        coeffs_um = np.array([each.coeffs_um for each in estimates[30 * number : 30 * number + 30]])
        np.testing.assert_allclose(minute.coeffs_um, coeffs_um.mean(axis=0), rtol=1e-14)
        np.testing.assert_allclose(minute.scatter_um, coeffs_um.std(axis=0), rtol=1e-6)


def test_rejected_figures_and_those_without_numbers_do_not_count() -> None:
    good = figures(3, 2.0)
    unusable = [
        replace(good[0], verdict="rejected", coeffs_um=np.full(ZERNIKE_TERMS, 1e6)),
        replace(good[0], coeffs_um=np.full(ZERNIKE_TERMS, np.nan)),
    ]
    (minute,) = minutes_of([*good[:2], *unusable, good[2]])
    assert minute.figures == 3
    assert np.isfinite(minute.coeffs_um).all()
    assert minutes_of(unusable) == []


def test_minutes_without_figures_have_no_row() -> None:
    early, late = figures(2, 600.0)
    assert [each.time_s for each in minutes_of([early, late])] == [0.0, 600.0]


def test_a_late_figure_counts_in_the_present_minute_and_reopens_none() -> None:
    estimates = figures(40, 2.0)
    late = replace(estimates[-1], time_s=5.0)
    assert [(each.time_s, each.figures) for each in minutes_of([*estimates, late])] == [
        (0.0, 30),
        (60.0, 11),
    ]


@pytest.mark.parametrize("count", [0, 1, 17])
def test_a_successor_continues_the_minute(count: int) -> None:
    estimates = figures(29, 2.0)
    opened = OpenFigureMinute()
    for estimate in estimates[:count]:
        opened.add_figure(estimate)
    successor = decode_state(encode_state(opened), OpenFigureMinute, 100_000)
    for estimate in estimates[count:]:
        successor.add_figure(estimate)
    (whole,) = minutes_of(estimates)
    ended = successor.end_minute()
    assert ended is not None
    assert ended.figures == whole.figures
    np.testing.assert_array_equal(ended.coeffs_um, whole.coeffs_um)
    np.testing.assert_array_equal(ended.scatter_um, whole.scatter_um)
