"""Running statistics and pairs: the same numbers as from everything at once, in memory that does
not grow.
"""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from membrane_ctrl.metrology.uncertainty.figure_pairs import Moment, PairFinder
from membrane_ctrl.metrology.uncertainty.running_statistics import (
    RunningCovariance,
    Tally,
    default_points_mm,
)
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS


def test_running_covariance() -> None:
    vectors = np.random.default_rng(1).normal(
        1e4, [0.1, 2.0, 30.0], (500, 3)
    )  # far from 0: no cancellation
    running = RunningCovariance(3)
    assert not running.covariance.any()
    for vector in vectors:
        running.add(vector)
    assert running.count == 500
    assert running.mean == pytest.approx(vectors.mean(axis=0), rel=1e-12)
    assert running.covariance == pytest.approx(np.cov(vectors, rowvar=False), rel=1e-9, abs=1e-9)


def test_tally() -> None:
    tally = Tally()
    assert math.isnan(tally.mean)
    for value in (3.0, -1.0, 4.0):
        tally.add(value)
    assert (tally.count, tally.mean, tally.low, tally.high) == (3, 2.0, -1.0, 4.0)


def test_default_points_are_inside_the_mirror_and_different() -> None:
    points = default_points_mm(475.0)
    assert list(points) == ["A", "B", "C"]
    radii = [math.hypot(*place) for place in points.values()]
    assert radii == pytest.approx([0.45 * 475, 0.70 * 475, 0.95 * 475])


def _moment(time_s: float, value: float = 0.0, trials: int = 3) -> Moment:
    return Moment(
        f"{time_s:g}",
        time_s,
        np.full(ZERNIKE_TERMS, value),
        np.full((trials, ZERNIKE_TERMS), value),
    )


def _lags(finder: PairFinder, time_s: float) -> dict[float, str]:
    return {pair.lag_s: pair.earlier.name for pair in finder.add(_moment(time_s))}


def test_every_set_finds_its_partners() -> None:
    finder = PairFinder()
    found = {4.0 * k: _lags(finder, 4.0 * k) for k in range(200)}
    assert found[52.0] == {}  # the first set is 8 s too near: more than a tenth of the minute
    assert found[56.0] == {60.0: "0"}
    assert found[400.0] == {60.0: "340"}
    assert found[796.0] == {60.0: "736", 600.0: "196"}


def test_a_missing_set_is_stood_in_for_by_its_neighbour() -> None:
    finder = PairFinder((60.0,))
    times = [4.0 * k for k in range(20) if k != 3]
    found = {time: _lags(finder, time) for time in times}
    assert found[72.0][60.0] in ("8", "16")


def test_a_gap_makes_no_pair() -> None:
    finder = PairFinder((60.0,))
    assert _lags(finder, 0.0) == {}
    assert _lags(finder, 90.0) == {}
    assert _lags(finder, 150.0) == {60.0: "90"}


def test_sets_without_a_time_and_with_another_clock() -> None:
    finder = PairFinder((60.0,))
    assert _lags(finder, math.nan) == {}
    assert _lags(finder, 1000.0) == {}
    assert _lags(finder, 0.0) == {}  # the clock was set back
    assert _lags(finder, 60.0) == {60.0: "0"}


def test_what_both_sets_share_cancels_trial_by_trial() -> None:
    rng = np.random.default_rng(2)
    shared, own = (
        rng.normal(0, 10.0, (400, ZERNIKE_TERMS)),
        rng.normal(0, 0.1, (2, 400, ZERNIKE_TERMS)),
    )
    finder = PairFinder((60.0,))
    finder.add(Moment("a", 0.0, np.zeros(ZERNIKE_TERMS), shared + own[0]))
    (pair,) = finder.add(Moment("b", 60.0, np.ones(ZERNIKE_TERMS), shared + own[1]))
    assert pair.change_mm == pytest.approx(np.ones(ZERNIKE_TERMS))
    assert np.sqrt(np.diag(pair.covariance)).mean() == pytest.approx(0.1 * math.sqrt(2), rel=0.05)


def test_memory_stays_flat() -> None:
    finder = PairFinder((60.0,))
    sizes = []
    tracemalloc.start()
    try:
        for k in range(600):
            finder.add(_moment(4.0 * k, trials=20))
            if k in (100, 599):
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[1] < 1.2 * sizes[0]
