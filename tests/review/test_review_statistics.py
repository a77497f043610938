"""Allan deviation, spectrum and slope against references and known truths."""

from __future__ import annotations

import allantools
import numpy as np
import pytest
from scipy import signal

from membrane_ctrl.review.statistics.allan_deviation import allan_deviation
from membrane_ctrl.review.statistics.drift import fit_slope
from membrane_ctrl.review.statistics.error_series import slow_spectrum
from membrane_ctrl.review.statistics.power_spectrum import (
    Spectrum,
    band_rms,
    power_spectrum,
    unseen_s,
)

RATE_HZ = 10.0


def coloured(size: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (
        signal.lfilter([1.0], [1.0, -0.97], rng.normal(size=size)) + 100.0 + rng.normal(size=size)
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_allan_deviation_is_allantools(seed: int) -> None:
    values = coloured(20_000, seed)
    ours = allan_deviation(values, 1 / RATE_HZ)
    taus, reference, _, counts = allantools.oadev(
        values, rate=RATE_HZ, data_type="freq", taus=ours.tau_s
    )
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


def spectra(values: np.ndarray, rate_hz: int) -> tuple[Spectrum, Spectrum]:
    """Of ticks and of their 1 s means."""
    means = values.reshape(-1, rate_hz).mean(axis=1)
    kept = np.isfinite(means)
    return power_spectrum(values, rate_hz), slow_spectrum(
        np.arange(means.size)[kept] + 0.5, means[kept]
    )


@pytest.mark.parametrize(
    ("hours", "period_s"), [(8.0, 1800.0), (8.0, 600.0), (8.0, 60.0), (0.5, 200.0)]
)
def test_the_bands_of_a_long_hold_add_up_and_slow_motion_is_in_its_own(
    hours: float, period_s: float
) -> None:
    time_s = np.arange(round(hours * 3600 * 50)) / 50
    values = np.sin(2 * np.pi * time_s / period_s) + 0.1 * np.random.default_rng(6).normal(
        size=time_s.size
    )
    found = band_rms(*spectra(values, 50))
    powers = {band.low_hz: band.rms_um**2 for band in found if np.isfinite(band.rms_um)}
    assert np.sqrt(sum(powers.values())) == pytest.approx(values.std(), rel=0.01)
    own = next(band for band in found if band.low_hz < 1 / period_s <= band.high_hz)
    assert own.rms_um == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert sum(power for low_hz, power in powers.items() if low_hz != own.low_hz) == pytest.approx(
        0.01, rel=0.05
    )
    assert unseen_s(found) == pytest.approx(hours * 1800, rel=0.02)


def test_a_lost_light_leaves_the_slow_bands() -> None:
    time_s = np.arange(36_000 * 10) / 10
    values = np.sin(2 * np.pi * time_s / 1800)
    values[100_000:100_030] = np.nan  # bridged
    values[250_000:260_000] = np.nan  # not bridged
    fast, slow = spectra(values, 10)
    assert slow.segments >= 2
    assert next(
        band for band in band_rms(fast, slow) if band.low_hz == 1e-4
    ).rms_um == pytest.approx(0.707, rel=0.03)


def test_too_short_for_a_band_is_reported() -> None:
    assert all(np.isnan(band.rms_um) for band in band_rms(*spectra(np.full(100, np.nan), 10)))
    found = band_rms(*spectra(np.random.default_rng(7).normal(size=600), 10))
    assert [np.isnan(band.from_hz) for band in found] == [True, True, True, False, False, False]
    assert found[3].from_hz > found[3].low_hz


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_the_interval_of_the_slope_covers_the_truth_as_often_as_stated(memory: float) -> None:
    rng = np.random.default_rng(4)
    time_s = 60.0 * np.arange(400)
    true_per_hour = 0.1
    covered = 0
    for _ in range(200):
        noise = signal.lfilter([1.0], [1.0, -memory], rng.normal(size=500))[100:]
        found = fit_slope(time_s, true_per_hour * time_s / 3600 + noise)
        covered += found.low <= true_per_hour <= found.high
    assert 180 <= covered <= 199


@pytest.mark.parametrize(
    ("count", "step_s", "tau_s"), [(60, 60.0, 300.0), (600, 1.0, 30.0), (600, 1.0, 100.0)]
)
def test_the_interval_of_a_short_record_allows_for_the_wander_that_the_line_took_up(
    count: int, step_s: float, tau_s: float
) -> None:
    rng, memory = np.random.default_rng(0), np.exp(-step_s / tau_s)
    time_s = step_s * np.arange(count)
    covered = 0
    for _ in range(200):
        noise = rng.normal(size=count) * np.sqrt(1 - memory**2)
        noise[0] = rng.normal()
        found = fit_slope(time_s, np.asarray(signal.lfilter([1.0], [1.0, -memory], noise)))
        covered += found.low <= 0.0 <= found.high
    assert 0.89 <= covered / 200 <= 0.98


def test_a_slope_is_found_and_too_few_values_give_none() -> None:
    time_s = 60.0 * np.arange(100)
    values = 0.5 * time_s / 3600 + 0.01 * np.random.default_rng(5).normal(size=100)
    values[10] = np.nan
    found = fit_slope(time_s, values)
    assert found.is_significant
    assert found.per_hour == pytest.approx(0.5, abs=0.02)
    assert np.isnan(fit_slope(time_s[:4], values[:4]).per_hour)
