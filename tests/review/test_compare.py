"""The tests of a comparison: equal runs seldom differ, differences are found, rows state their
test.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from membrane_ctrl.review import open_run
from membrane_ctrl.review.statistics.analysis import Analysis, analyse_run
from membrane_ctrl.review.statistics.compare import compare_analyses
from membrane_ctrl.review.statistics.difference_tests import mean_p, spread_p, window_means
from tests.studies.comparison_rates import rates
from tests.support.review_runs import written

HOURS = 0.5


def series(
    rng: np.random.Generator, hours: float, std: float = 1.0, memory: float = 0.9
) -> np.ndarray:
    """(2, n): seconds and a wander of that standard deviation."""
    size = round(hours * 3600)
    noise = signal.lfilter([1.0], [1.0, -memory], rng.normal(size=size + 500))[500:]
    return np.stack((np.arange(size) + 0.5, std * math.sqrt(1 - memory**2) * noise))


def long_windows(values: np.ndarray, window_s: float) -> np.ndarray:
    return np.stack(window_means(values[0], values[1], window_s))


@pytest.mark.parametrize("window_s", [1.0, 4.0, 60.0])
def test_spreads_of_equal_series_of_different_length_seldom_differ(window_s: float) -> None:
    rng = np.random.default_rng(1)
    seen = [
        spread_p(*(long_windows(series(rng, hours), window_s) for hours in (0.5, 3.0)), window_s)
        for _ in range(150)
    ]
    assert np.mean(np.array(seen) < 0.01) < 0.05
    assert np.mean(seen) > 0.35


@pytest.mark.parametrize("window_s", [4.0, 60.0])
def test_a_spread_half_as_large_again_is_seen(window_s: float) -> None:
    rng = np.random.default_rng(2)
    parts = [long_windows(series(rng, 4.0, std), window_s) for std in (1.0, 1.5)]
    assert spread_p(*parts, window_s) < 0.01


@pytest.mark.parametrize("excursions", [False, True])
def test_equal_runs_are_seldom_called_different(excursions: bool) -> None:
    spreads, means = rates(1200, 10.0, 1.0, 60, excursions)
    assert spreads <= 0.1
    assert means <= 0.1


@pytest.mark.parametrize("size", [120, 1200])
@pytest.mark.parametrize("memory_s", [0.0, 300.0])
def test_a_factor_of_ten_is_always_found(size: int, memory_s: float) -> None:
    assert rates(size, memory_s, 10.0, 20)[0] == 1.0


def test_a_single_burst_that_makes_the_spread_ten_times_as_large_is_found() -> None:
    rng = np.random.default_rng(5)
    quiet, burst = (series(rng, 3.0, 0.246) for _ in range(2))
    burst[1, 5000:5400] += 11.5
    assert burst[1].std() / quiet[1].std() > 8
    assert spread_p(quiet, burst) < 1e-3


def test_what_never_varies_is_tested_too() -> None:
    time_s = np.arange(3600) + 0.5
    flat = [np.stack((time_s, np.full(3600, value))) for value in (1.0, 1.0, 1.5)]
    assert (mean_p(flat[0], flat[1]), mean_p(flat[0], flat[2])) == (1.0, 0.0)
    assert math.isnan(spread_p(flat[0], flat[1]))


def test_what_all_blocks_of_a_run_share_is_no_difference() -> None:
    rng = np.random.default_rng(3)
    without, with_it = [], []
    for _ in range(100):
        a, b = (series(rng, 1.0, 0.1) + np.array([[0.0], [0.1 * rng.normal()]]) for _ in range(2))
        without.append(mean_p(a, b))
        with_it.append(mean_p(a, b, offset=0.1 * math.sqrt(2)))
    assert np.mean(np.array(without) < 0.01) > 0.4
    assert np.mean(np.array(with_it) < 0.01) < 0.05


def test_blocks_that_remember_each_other_count_for_fewer() -> None:
    rng = np.random.default_rng(4)
    seen = [mean_p(*(series(rng, 4.0, memory=0.999) for _ in range(2))) for _ in range(60)]
    assert np.mean(np.array(seen) < 0.01) < 0.1


@pytest.fixture(scope="module")
def analyses(tmp_path_factory: pytest.TempPathFactory) -> list[Analysis]:
    logs: Path = tmp_path_factory.mktemp("compare")
    return [
        analyse_run(open_run(written(logs, HOURS, seed=seed, name=f"2026112{seed}T180000Z-n")))
        for seed in (1, 2)
    ]


def test_every_row_is_tested_or_states_why_not(analyses: list[Analysis]) -> None:
    rows = {row.name: row for row in compare_analyses(*analyses)}
    assert all(
        math.isfinite(row.p_value) or row.note.startswith("no test") for row in rows.values()
    )
    assert {name for name, row in rows.items() if not math.isfinite(row.p_value)} <= {
        "pump strokes",
        "lateness p99",
    }
    assert "stretches" in rows["leak"].note
    assert not any(row.verdict_text in {"larger", "smaller"} for row in rows.values())


def test_too_short_a_run_is_reported(tmp_path: Path, analyses: list[Analysis]) -> None:
    short = analyse_run(open_run(written(tmp_path, 0.05, seed=3)))
    rows = {row.name: row for row in compare_analyses(analyses[0], short)}
    assert rows["reading, std of 60 s"].note == "no test: too short"
    assert rows["reading, std of 60 s"].verdict_text == ""
