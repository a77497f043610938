"""Streaming estimators against NumPy on the same data."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.run_files.run_statistics import LogHistogram, Moments, SecondMeans


@pytest.mark.parametrize("batch", [1, 7, 50, 1000])
def test_moments_agree_with_numpy_in_any_batches(batch: int) -> None:
    # a mean a million times the deviation: a sum of squares would have lost all digits
    values = 1e6 + np.random.default_rng(1).normal(size=1000)
    moments = Moments()
    for start in range(0, values.size, batch):
        moments.add(values[start : start + batch])
    assert moments.count == 1000
    assert moments.mean == pytest.approx(values.mean(), rel=1e-14)
    assert moments.std == pytest.approx(values.std(), rel=1e-9)


def test_moments_leave_out_what_is_not_finite() -> None:
    moments = Moments()
    moments.add(np.array([np.nan, 1.0, 3.0, np.inf]))
    assert (moments.count, moments.mean, moments.std) == (2, 2.0, 1.0)


def test_moments_of_nothing_are_nan() -> None:
    moments = Moments()
    moments.add(np.array([]))
    assert math.isnan(moments.std)


@pytest.mark.parametrize("share", [0.01, 0.5, 0.9, 0.99, 0.999])
def test_quantiles_are_within_a_bin_of_numpys(share: float) -> None:
    values = np.random.default_rng(2).lognormal(0.3, 1.0, 20_000)
    histogram = LogHistogram()
    for part in np.array_split(values, 37):
        histogram.add(part)
    assert histogram.find_quantile(share) == pytest.approx(np.quantile(values, share), rel=0.02)
    assert histogram.largest == values.max()


def test_values_out_of_range_are_counted_at_the_ends() -> None:
    histogram = LogHistogram()
    histogram.add(np.array([-5.0, 0.0, 1e9]))
    assert histogram.count == 3
    assert histogram.find_quantile(0.5) == pytest.approx(1e-3, rel=0.02)
    assert histogram.find_quantile(1.0) == pytest.approx(1e5, rel=0.03)
    assert histogram.largest == 1e9


def test_quantile_of_nothing_is_nan() -> None:
    assert math.isnan(LogHistogram().find_quantile(0.5))


@pytest.mark.parametrize("batch", [1, 7, 50, 1000])
def test_second_means_agree_with_numpy(batch: int) -> None:
    values = np.random.default_rng(3).normal(size=(20, 50))
    time_s = np.arange(1000) * 0.02
    means = SecondMeans(band=0.1, least=45.0)
    for start in range(0, 1000, batch):
        means.add(time_s[start : start + batch], values.ravel()[start : start + batch])
    found, expected = means.result(), values.mean(axis=1)
    assert found["seconds"] == 20
    assert found["in_band"] == pytest.approx(np.mean(np.abs(expected) <= 0.1))
    assert (found["first_um"], found["last_um"]) == pytest.approx((expected[0], expected[-1]))
    assert (found["mean_um"], found["std_um"]) == pytest.approx((expected.mean(), expected.std()))
    assert means.result() == found


def test_a_second_with_a_gap_gives_no_mean() -> None:
    means = SecondMeans(band=1.0, least=9.0)
    time_s = np.array([*np.arange(0, 0.75, 0.1), *np.arange(2.0, 3.35, 0.1)])
    means.add(time_s, np.where(time_s >= 2, 1.0, 100.0))
    found = means.result()
    assert (found["seconds"], found["first_um"], found["last_um"]) == (1, 1.0, 1.0)
    assert np.isnan(SecondMeans(band=1.0, least=9.0).result()["in_band"])


@pytest.mark.parametrize("late_ms", [0.05, 0.3, 1.0, 2.1, 4.9])
def test_a_tenth_of_a_millisecond_more_lateness_is_seen(late_ms: float) -> None:
    found_ms = []
    for shift_ms in (0.0, 0.1):
        histogram = LogHistogram()
        histogram.add(np.full(100, late_ms + shift_ms))
        found_ms.append(histogram.find_quantile(0.5))
    assert found_ms[0] == pytest.approx(late_ms, abs=0.05)
    assert found_ms[1] > found_ms[0]
