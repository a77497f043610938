"""Allan deviation, spectrum and slope against references and known truths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from membrane_ctrl.review.allan import allan_deviation
from membrane_ctrl.review.drift import slope
from membrane_ctrl.review.psd import power_spectrum

allantools = pytest.importorskip("allantools", reason="the reference for the Allan deviation is not installed")
RATE_HZ = 10.0


def coloured(size: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return signal.lfilter([1.0], [1.0, -0.97], rng.normal(size=size)) + 100.0 + rng.normal(size=size)


@pytest.mark.parametrize("seed", [0, 1])
def test_allan_deviation_is_allantools(seed: int) -> None:
    values = coloured(20_000, seed)
    ours = allan_deviation(values, 1 / RATE_HZ)
    taus, reference, _, counts = allantools.oadev(values, rate=RATE_HZ, data_type="freq", taus=ours.tau_s)
    assert ours.tau_s.size > 10
    np.testing.assert_allclose(ours.tau_s, taus)
    np.testing.assert_allclose(ours.deviation, reference, rtol=1e-6)
    np.testing.assert_array_equal(ours.windows, counts)


def test_allan_deviation_leaves_gaps_out() -> None:
    values = coloured(40_000, 2)
    whole = allan_deviation(values, 1 / RATE_HZ, np.array([1, 16]))
    values[10_000:10_050] = np.nan
    gapped = allan_deviation(values, 1 / RATE_HZ, np.array([1, 16]))
    assert (gapped.windows < whole.windows).all()
    np.testing.assert_allclose(gapped.deviation, whole.deviation, rtol=0.02)


def test_allan_deviation_of_next_to_nothing_is_empty() -> None:
    assert allan_deviation(np.full(100, np.nan), 0.1).tau_s.size == 0


@pytest.mark.parametrize("length", [256, 1000, 1001])
def test_spectrum_is_scipys(length: int) -> None:
    values = coloured(20_000, 3)
    ours = power_spectrum(values, RATE_HZ, length)
    frequency_hz, density = signal.welch(
        values, RATE_HZ, "hann", length, noverlap=length - length // 2, detrend="constant"
    )
    np.testing.assert_allclose(ours.frequency_hz, frequency_hz)
    np.testing.assert_allclose(ours.density, density, rtol=1e-6)


def test_band_rms_of_a_sine_and_a_gap() -> None:
    time_s = np.arange(20_000) / RATE_HZ
    values = 2.0 * np.sin(2 * np.pi * 0.5 * time_s)
    values[7000] = np.nan
    spectrum = power_spectrum(values, RATE_HZ, 1024)
    assert spectrum.band_rms(0.4, 0.6) == pytest.approx(np.sqrt(2), rel=0.01)
    assert spectrum.band_rms(1.0, 5.0) < 0.01
    assert power_spectrum(values[:100], RATE_HZ, 1024).segments == 0


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_the_interval_of_the_slope_covers_the_truth_as_often_as_it_says(memory: float) -> None:
    rng = np.random.default_rng(4)
    time_s = 60.0 * np.arange(400)
    true_per_hour = 0.1
    covered = 0
    for _ in range(200):
        noise = signal.lfilter([1.0], [1.0, -memory], rng.normal(size=500))[100:]
        found = slope(time_s, true_per_hour * time_s / 3600 + noise)
        covered += found.low <= true_per_hour <= found.high
    assert 180 <= covered <= 199


def test_a_slope_is_seen_and_too_few_values_say_nothing() -> None:
    time_s = 60.0 * np.arange(100)
    values = 0.5 * time_s / 3600 + 0.01 * np.random.default_rng(5).normal(size=100)
    values[10] = np.nan
    found = slope(time_s, values)
    assert found.significant
    assert found.per_hour == pytest.approx(0.5, abs=0.02)
    assert np.isnan(slope(time_s[:4], values[:4]).per_hour)
