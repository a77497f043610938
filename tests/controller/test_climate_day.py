"""A day of the twin's climate: expansions learned in its first night predict the next day."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.roles import NO_READING
from membrane_ctrl.config.schema import ClimateConfig, Config, TwinConfig
from membrane_ctrl.controller.climate_part import ClimatePart
from membrane_ctrl.metrology.film.climate_figure import compute_climate_sensitivity
from membrane_ctrl.metrology.film.climate_fit import ClimateFit, Expansion, fit_climate
from membrane_ctrl.model.events import Maintenance
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.climate import FILM_PPM_PER_K, RING_PPM_PER_K, ClimateBlock, Room
from membrane_ctrl.sim.sensors import FILM_NOISE_K, HUMIDITY_NOISE_PERCENT, RING_NOISE_K
from tests.worlds.climate_terms import compute_figure_change_per_ppm

MINUTE_S = 60.0
NIGHT = 14 * 60
SENSITIVITY = compute_climate_sensitivity(500.0, 37.1)


def _noisy(block: ClimateBlock, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Means of film and ring thermometer and hygrometer over 60 readings."""
    count = block.film_c.size
    share = 1 / np.sqrt(60)
    return (
        block.film_c + FILM_NOISE_K * share * rng.standard_normal(count),
        block.ring_c + RING_NOISE_K * share * rng.standard_normal(count),
        block.humidity_percent + HUMIDITY_NOISE_PERCENT * share * rng.standard_normal(count),
    )


def _learn(block: ClimateBlock, time_s: np.ndarray, rng: np.random.Generator) -> ClimateFit:
    film_c, ring_c, humidity = (values[:NIGHT] for values in _noisy(block, rng))
    spherical_um = compute_figure_change_per_ppm()[2] * block.excess_ppm[:NIGHT]
    return fit_climate(
        time_s[:NIGHT],
        spherical_um + 0.05 * rng.standard_normal(NIGHT),
        film_c,
        ring_c,
        humidity,
        float(SENSITIVITY.terms_um[10]),
        Expansion(23.0, 0.7),
    )


def _config_of(fit: ClimateFit) -> ClimateConfig:
    assert fit.film_per_k is not None
    assert fit.ring_per_k is not None
    assert fit.film_per_percent is not None
    return ClimateConfig(
        film_ppm_per_k=fit.film_per_k.value,
        ring_ppm_per_k=fit.ring_per_k.value,
        film_ppm_per_percent=fit.film_per_percent.value,
        film_follows_humidity_s=fit.follows_humidity_s,
        film_sigma_relative=0.03,
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_a_learned_climate_predicts_the_next_day_within_a_micrometre(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time_s = MINUTE_S * np.arange(NIGHT + 1440)
    block = Room(TwinConfig(climate="day", seed=seed)).make_block(time_s)
    fit = _learn(block, time_s, rng)
    part = ClimatePart(Config(climate=_config_of(fit)))
    film_c, ring_c, humidity = _noisy(block, rng)
    change_per_ppm = float(np.linalg.norm(compute_figure_change_per_ppm()))
    misses_um = []
    true_um = []
    notices = 0
    start = NIGHT + 10
    # The film's moisture is known some time constants after the sensors began
    for k in range(NIGHT - 240, time_s.size):
        reading = replace(
            NO_READING,
            film_temperature_c=film_c[k],
            ring_temperature_c=ring_c[k],
            humidity_percent=humidity[k],
        )
        state = State.HOLD if k >= start else State.SETTLE
        events = part.step(reading, state, MINUTE_S)
        notices += sum(isinstance(event, Maintenance) for event in events)
        if k > start:
            # All terms are proportional to the excess: the RMS of the error is theirs times its
            true_ppm = block.excess_ppm[k] - block.excess_ppm[start]
            misses_um.append(abs(part.memory.strain.excess_ppm - true_ppm) * change_per_ppm)
            true_um.append(abs(true_ppm) * change_per_ppm)
    assert max(true_um) > 10.0
    assert max(misses_um) < 1.0
    assert notices >= 1


def test_an_air_conditioner_limits_the_figure_by_less_than_the_notice() -> None:
    time_s = 10.0 * np.arange(1000)
    block = Room(TwinConfig(climate="hvac")).make_block(time_s)
    change_um = np.ptp(block.excess_ppm) * SENSITIVITY.change_rms_um
    assert 1.0 < change_um < 12.0


def test_a_lamp_strains_the_film_by_its_share() -> None:
    time_s = 10.0 * np.arange(400)
    block = Room(TwinConfig(climate="lamp")).make_block(time_s)
    assert np.ptp(block.excess_ppm) == pytest.approx(18.5 * 0.065, rel=0.02)
    assert np.ptp(block.ring_c) < 1e-9


def _learn_day(hours: float, seed: int) -> ClimateFit:
    """Expansions from the first hours of the twin's day, with 10 nm of noise a minute."""
    count = round(60 * hours)
    time_s = np.arange(count, dtype=np.float64) * MINUTE_S
    block = Room(TwinConfig(climate="day", seed=seed)).make_block(time_s)
    rng = np.random.default_rng([seed, 7])
    film_c, ring_c, humidity = _noisy(block, rng)
    spherical_um = compute_figure_change_per_ppm()[2] * block.excess_ppm
    return fit_climate(
        time_s,
        spherical_um + 0.01 * rng.standard_normal(count),
        film_c,
        ring_c,
        humidity,
        float(SENSITIVITY.terms_um[10]),
        Expansion(23.0, 0.7),
    )


@pytest.mark.parametrize("hours", [10.0, 14.0, 24.0])
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_night_of_any_phase_gives_the_expansion_of_the_film_within_its_error(
    hours: float, seed: int
) -> None:
    """Film and ring are nearly in phase over some hours: noise of the thermometers and the
    unknown time constant of the moisture must not bias what the ring's prior separates.
    """
    fit = _learn_day(hours, seed)
    assert fit.film_per_k is not None
    assert fit.ring_per_k is not None
    assert fit.film_per_k.value == pytest.approx(FILM_PPM_PER_K, rel=0.06)
    assert fit.film_per_k.sigma < 0.08 * FILM_PPM_PER_K
    for found, true in (
        (fit.film_per_k, FILM_PPM_PER_K),
        (fit.ring_per_k, RING_PPM_PER_K),
    ):
        assert abs(found.value - true) < 2.0 * found.sigma


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_five_hours_of_a_day_state_that_they_do_not_give_it(seed: int) -> None:
    film = _learn_day(5.0, seed).film_per_k
    assert film is not None
    assert film.sigma > 0.25 * FILM_PPM_PER_K
    assert abs(film.value - FILM_PPM_PER_K) < 3.0 * film.sigma
