"""Intensities and weather gains from synthetic series of known truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from membrane_ctrl.config.schema import LoopConfig
from tuning.identification.disturbance import observe_disturbance
from tuning.identification.noise_spectrum import fit_noise
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Record
from tuning.identification.weather_gains import WeatherGain, fit_weather, lag_series

DT_S = 0.02
N = 30_000
PLANT, LOOP = (
    PlantModel(1.0, 0.1, 0.15, 1.2),
    LoopConfig(feedforward_barometer=False, feedforward_temperature=False),
)


def walk(rng: np.random.Generator, per_s: float) -> np.ndarray:
    return np.cumsum(rng.standard_normal(N)) * np.sqrt(per_s * DT_S)


W = np.geomspace(0.15, 3.0, 8)  # where it matters to a loop


def test_both_walks_are_distinguished_from_noise() -> None:
    rng = np.random.default_rng(2)
    series = walk(rng, 0.05) + lag_series(walk(rng, 1.0), 12.0, DT_S) + 0.5 * rng.standard_normal(N)
    found = fit_noise(series, DT_S, 12.0)
    assert found.white == pytest.approx(0.5, rel=0.02)
    assert found.moving_psd(W) == pytest.approx((0.05 + 1 / (1 + (W * 12) ** 2)) / W**2, rel=0.35)


def coloured(rng: np.random.Generator, psd: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A series of a given two-sided spectrum; the FFT of white noise
    shares no code with the fit.
    """
    w = 2 * np.pi * np.fft.rfftfreq(N, DT_S)
    w[0] = w[1]
    return np.fft.irfft(np.fft.rfft(rng.standard_normal(N)) * np.sqrt(psd(w) / DT_S), N)


COLOURS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "1/f, no higher than 1 Hz": lambda w: 0.05 / w / (1 + (w / 6.3) ** 2) ** 2,
    "1/f^1.5": lambda w: 0.03 / w**1.5,
    "one hump at 0.1 Hz": lambda w: 0.3 / (1 + (w / 0.6) ** 2) ** 2,
}


@pytest.mark.parametrize("psd", COLOURS.values(), ids=COLOURS)
@pytest.mark.parametrize("laser_um", [0.1, 1.0])
def test_the_deviation_of_a_loop_is_predicted_in_movement_of_any_colour(
    psd: Callable[[np.ndarray], np.ndarray], laser_um: float
) -> None:
    """A loop without delay, K / (s + K): its deviation is an integral over the true spectrum."""
    rng = np.random.default_rng(7)
    found = fit_noise(coloured(rng, psd) + laser_um * rng.standard_normal(N), DT_S, 12.0)
    w = np.geomspace(0.02, np.pi / DT_S, 2000)
    for k in (0.2, 0.5):
        predicted, true = (
            np.trapezoid(s * w**2 / (w**2 + k**2), w) for s in (found.moving_psd(w), psd(w))
        )
        assert predicted**0.5 == pytest.approx(true**0.5, rel=0.2)


def test_weather_that_comes_and_goes_widens_the_prediction() -> None:
    """The same loop's record in steady weather, and with two minutes of gusts in ten."""
    rng = np.random.default_rng(9)
    steady = coloured(rng, COLOURS["1/f, no higher than 1 Hz"])
    gust = np.where(np.arange(N) % N < N // 5, 4.0, 1.0)
    found = [
        observe_disturbance(
            Record(
                DT_S, np.full(N, 1.2), x + 0.1 * rng.standard_normal(N), *np.full((2, N), np.nan)
            ),
            PLANT,
            LOOP,
        )
        for x in (steady, gust * steady)
    ]
    assert found[0].unsteady < 0.15
    assert found[1].unsteady > 2 * found[0].unsteady


def test_white_noise_alone_moves_little() -> None:
    found = fit_noise(np.random.default_rng(8).standard_normal(N), DT_S, 12.0)
    w = np.geomspace(0.1, np.pi / DT_S, 500)
    assert np.trapezoid(found.moving_psd(w), w) / np.pi < 0.05**2


def test_a_trend_is_no_disturbance() -> None:
    rng = np.random.default_rng(3)
    series = walk(rng, 0.01) + rng.standard_normal(N)
    plain, tilted = (fit_noise(s, DT_S, 12.0) for s in (series, series + 0.5 * DT_S * np.arange(N)))
    assert tilted.moving_psd(W) == pytest.approx(plain.moving_psd(W), rel=0.05, abs=1e-4)
    assert tilted.white == pytest.approx(plain.white, rel=1e-3)


def test_the_spectrum_is_that_of_a_random_walk() -> None:
    found = fit_noise(walk(np.random.default_rng(4), 0.04), DT_S, 0.0)
    assert found.moving_psd(np.array([2.0]))[0] == pytest.approx(0.04 / 4.0, rel=0.15)


def test_a_short_hold_is_refused() -> None:
    with pytest.raises(ValueError, match="too short"):
        fit_noise(np.zeros(5000), DT_S, 12.0)


def weather_record(seed: int, sensor_pa: float) -> Record:
    rng = np.random.default_rng(seed)
    pressure, air = walk(rng, 0.1), walk(rng, 2e-5)
    y = (
        -0.36 * pressure
        + 120.0 * lag_series(air, 12.0, DT_S)
        + walk(rng, 1e-4)
        + rng.standard_normal(N)
    )
    return Record(
        DT_S,
        np.full(N, 1.2),
        y + 1.2 * DT_S * np.arange(N),
        101_325.0 + pressure + sensor_pa * rng.standard_normal(N),
        23.0 + air + 0.002 * rng.standard_normal(N),
    )


@pytest.mark.parametrize("sensor_pa", [0.02, 1.0])
def test_weather_gains_also_behind_a_noisy_barometer(sensor_pa: float) -> None:
    """The noisy barometer's gain would come out at a third without the correction."""
    found = fit_weather(weather_record(1, sensor_pa), PLANT, 12.0)
    assert found.barometer is not None
    assert found.air is not None
    assert found.barometer.gain == pytest.approx(-0.36, abs=max(0.02, 3 * found.barometer.sigma))
    assert abs(found.barometer.gain) > 0.25
    assert found.air.gain == pytest.approx(120.0, abs=3 * found.air.sigma + 2.0)
    w = np.geomspace(0.3, 1.5, 5)
    assert found.barometer.psd(w) == pytest.approx(0.1 / w**2, rel=0.35)
    assert found.barometer.noise == pytest.approx(sensor_pa, rel=0.1)


def test_without_sensors_everything_is_left_as_rest() -> None:
    whole = weather_record(1, 0.05)
    absent = np.full(N, np.nan)
    blind = Record(DT_S, whole.flow_um_per_s, whole.displacement_um, absent, absent)
    found = fit_weather(blind, PlantModel(1.0, 0.1, 0.15, 1.2), 12.0)
    assert found.barometer is None
    assert found.air is None
    assert found.rest_um.size == N


@pytest.mark.parametrize(
    ("gain", "sigma", "expected"),
    [(-0.30, 0.01, -0.30), (-0.30, 0.05, -0.358), (-0.10, 0.05, -0.10)],
    ids=["known well: taken", "known badly, agrees: configured", "known badly, contradicts: taken"],
)
def test_which_gain_is_used(gain: float, sigma: float, expected: float) -> None:
    assert WeatherGain(gain, sigma, 0.1, 0.05, 0.0).choose_gain(-0.358) == expected
