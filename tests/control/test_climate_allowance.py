"""A changing room moves film and gauge apart: that is no contradiction, and hides none for long.

The truth is the room of the twin, whose film is solved by least energy and whose expansions are
not those that the comparison is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import ClimateConfig, LimitsConfig, MirrorConfig, TwinConfig
from membrane_ctrl.control.climate import Climate, ClimateReadings, StrainParts
from membrane_ctrl.control.climate_allowance import (
    HOUR_MOST_UM,
    MINUTES_MOST_UM,
    ClimateAllowance,
    StrainAhead,
    find_gain,
)
from membrane_ctrl.control.film_monitor import (
    LAW_SHARE,
    NO_STRAINS,
    SINCE_DAY_S,
    SINCE_HOUR_S,
    SINCE_MINUTES_S,
    SMOOTH_S,
    FilmMonitor,
)
from membrane_ctrl.control.plausibility import PlausibilityCheck
from membrane_ctrl.model.events import FaultySensor
from membrane_ctrl.sim.climate import Room
from membrane_ctrl.sim.sensors import FILM_NOISE_K, HUMIDITY_NOISE_PERCENT, RING_NOISE_K
from tests.worlds.sound_figure import SOUND_FIGURE

SAG_UM, PRESSURE_PA = 37_100.0, 600.0
LIMITS = LimitsConfig()
UM_PER_PPM = 3.45
Altered = Callable[[float, ClimateReadings], ClimateReadings]
MISSING = ClimateReadings(math.nan, math.nan, math.nan, math.nan)


def keep_readings(time_s: float, readings: ClimateReadings) -> ClimateReadings:
    """Sound sensors."""
    return readings


def find_contradiction(
    room: str,
    duration_s: float,
    dt_s: float = 1.0,
    creep_um: Callable[[float], float] = lambda time_s: 0.0,
    zero_pa: Callable[[float], float] = lambda time_s: 0.0,
    alter: Altered = keep_readings,
    seed: int = 1,
    limits: LimitsConfig = LIMITS,
) -> tuple[str, float]:
    """The first contradiction of a film whose laser is held, and when; empty and NaN without.

    The laser creeps by `creep_um`, which the loop puts into the film; the gauge reads `zero_pa`
    too much.
    """
    rng = np.random.default_rng(seed)
    times_s = np.arange(round(duration_s / dt_s), dtype=np.float64) * dt_s
    block = Room(TwinConfig.model_validate({"climate": room, "seed": seed})).make_block(times_s)
    monitor = FilmMonitor(limits, MirrorConfig(), climate=ClimateConfig())
    climate = Climate(ClimateConfig())
    noise = rng.standard_normal((times_s.size, 5))
    for k, time_s in enumerate(times_s.tolist()):
        readings = ClimateReadings(
            float(block.film_c[k] + FILM_NOISE_K * noise[k, 0]),
            float(block.ring_c[k] + RING_NOISE_K * noise[k, 1]),
            float(block.humidity_percent[k] + HUMIDITY_NOISE_PERCENT * noise[k, 2]),
            21.0,
        )
        climate.step(alter(time_s, readings), dt_s)
        monitor.note_strains(climate.fresh_parts)
        # Hencky's law, of a film whose sag at equal pressure follows the climate
        share = 1 - creep_um(time_s) / SAG_UM
        true_pa = PRESSURE_PA * (share / float(block.mirror_factor[k])) ** 3
        found = monitor.step(
            dt_s,
            float(noise[k, 3]),
            0.0,
            true_pa + zero_pa(time_s) + 0.15 * float(noise[k, 4]),
        )
        if found:
            return found, time_s
    return "", math.nan


def ramp(per_s: float, start_s: float = 300.0) -> Callable[[float], float]:
    """A drift that begins after a while."""
    return lambda time_s: per_s * max(time_s - start_s, 0.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_air_conditioner_is_a_contradiction_only_without_climate_sensors(seed: int) -> None:
    """It moves the film by 18 µm; gusts, creep and noise of a hold add to it."""
    tight = LimitsConfig(laser_gauge_apart_max_um=15.0)
    assert find_contradiction("hvac", 1200.0, seed=seed, limits=tight)[0] == ""
    found, _ = find_contradiction(
        "hvac", 1200.0, alter=lambda t, r: MISSING, seed=seed, limits=tight
    )
    assert found.startswith("laser ")
    assert "temperature or humidity has changed" in found


@pytest.mark.parametrize("seed", [1, 2])
def test_a_day_of_weather_is_no_contradiction(seed: int) -> None:
    assert find_contradiction("day", 86_400.0, dt_s=10.0, seed=seed)[0] == ""


@pytest.mark.parametrize("rate_um_per_s", [-2.0, -0.5, 0.5, 2.0])
def test_in_a_steady_room_sensors_of_the_climate_delay_no_contradiction(
    rate_um_per_s: float,
) -> None:
    _, blind_s = find_contradiction(
        "lamp", 700.0, creep_um=ramp(rate_um_per_s), alter=lambda t, r: MISSING
    )
    found, at_s = find_contradiction("lamp", 700.0, creep_um=ramp(rate_um_per_s))
    assert "explain" in found
    assert at_s - 300.0 < 45.0 / abs(rate_um_per_s)
    assert at_s - blind_s < 5.0 / abs(rate_um_per_s)  # a lamp warms the film by 4 µm


@pytest.mark.parametrize("rate_um_per_s", [-2.0, -0.5, 0.5, 2.0])
@pytest.mark.parametrize("start_s", [300.0, 500.0, 700.0, 900.0])
def test_a_laser_that_creeps_is_found_while_the_room_changes(
    rate_um_per_s: float, start_s: float
) -> None:
    found, at_s = find_contradiction("hvac", 1200.0, creep_um=ramp(rate_um_per_s, start_s))
    assert found
    assert at_s > start_s
    # As without sensors, 45 µm, and what the room hides
    assert (at_s - start_s) * abs(rate_um_per_s) < 45.0 + MINUTES_MOST_UM


@pytest.mark.parametrize("pa_per_s", [-0.1, 0.1])
@pytest.mark.parametrize("room", ["hvac", "lamp"])
def test_a_gauge_that_drifts_is_found_while_the_room_changes(room: str, pa_per_s: float) -> None:
    found, at_s = find_contradiction(room, 900.0, zero_pa=ramp(pa_per_s))
    assert found
    assert at_s - 300.0 < 30.0


def _jump(time_s: float, readings: ClimateReadings) -> ClimateReadings:
    """A film thermometer that reads 10 K too much from some time on."""
    if time_s < 300.0:
        return readings
    return replace(readings, film_c=readings.film_c + 10.0)


def _drift(time_s: float, readings: ClimateReadings) -> ClimateReadings:
    """A film thermometer that drifts by 0.01 K/s, 0.6 µm/s of the centre."""
    return replace(readings, film_c=readings.film_c + 0.01 * max(time_s - 300.0, 0.0))


def _stick(time_s: float, readings: ClimateReadings) -> ClimateReadings:
    """A film thermometer that is stuck while the ring's follows the room."""
    return replace(readings, film_c=22.0)


def _fall(time_s: float, readings: ClimateReadings) -> ClimateReadings:
    """All sensors are lost."""
    if time_s < 300.0:
        return readings
    return MISSING


@pytest.mark.parametrize("alter", [_jump, _drift, _stick, _fall])
def test_a_wrong_climate_sensor_ends_no_hold_in_a_steady_room(alter: Altered) -> None:
    assert find_contradiction("lamp", 2000.0, alter=alter)[0] == ""


@pytest.mark.parametrize("alter", [_jump, _drift, _stick, _fall])
@pytest.mark.parametrize("rate_um_per_s", [-0.6, 0.6])
def test_a_wrong_climate_sensor_hides_a_creep_by_no_more_than_the_stated_bound(
    alter: Altered, rate_um_per_s: float
) -> None:
    found, at_s = find_contradiction("lamp", 900.0, creep_um=ramp(rate_um_per_s), alter=alter)
    assert found
    # The reference follows: a creep r is r T (1 - exp(-t / T)) ahead of it
    most_um = LIMITS.laser_gauge_apart_max_um + MINUTES_MOST_UM
    latest_s = -SINCE_MINUTES_S * math.log(1 - most_um / (abs(rate_um_per_s) * SINCE_MINUTES_S))
    assert at_s - 300.0 < latest_s + 2 * SMOOTH_S


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_thermometer_that_drifts_with_a_slow_laser_hides_it_within_an_hour_up_to_the_bound(
    sign: float,
) -> None:
    """0.06 µm/s: minutes do not show it, and the thermometer explains all of it."""

    def lie(time_s: float, readings: ClimateReadings) -> ClimateReadings:
        # The film goes the other way than the laser: deeper than by the gauge
        drift_k = sign * 0.06 * max(time_s - 300.0, 0.0) / (17.0 * UM_PER_PPM)
        return replace(readings, film_c=readings.film_c + drift_k)

    limit_um = LIMITS.laser_gauge_drift_max_um + HOUR_MOST_UM
    creep_um = ramp(sign * 0.1)
    found, at_s = find_contradiction("lamp", 12_000.0, 5.0, creep_um=creep_um, alter=lie)
    assert found
    ahead_um = 0.1 * SINCE_HOUR_S
    assert abs(creep_um(at_s)) < -ahead_um * math.log(1 - limit_um / ahead_um) + 40.0


def test_the_climate_explains_within_bounds_and_in_one_direction() -> None:
    allowance = ClimateAllowance(UM_PER_PPM, 0.15, MINUTES_MOST_UM)
    assert allowance.find_range(StrainAhead()) == (0.0, 0.0)
    low_um, high_um = allowance.find_range(StrainAhead(heat_ppm=4.0))
    assert low_um == 0.0
    assert high_um == pytest.approx(UM_PER_PPM * 4.0 * 1.3)
    assert allowance.find_range(StrainAhead(ring_ppm=100.0)) == (-MINUTES_MOST_UM, 0.0)
    # Parts that cancel leave the error of each
    low_um, high_um = allowance.find_range(StrainAhead(heat_ppm=5.0, water_ppm=-5.0))
    assert high_um == pytest.approx(-low_um)
    assert high_um == pytest.approx(2 * UM_PER_PPM * 0.15 * math.hypot(5.0, 5.0))


def test_what_was_explained_fades_when_the_sensor_is_lost() -> None:
    ahead = StrainAhead()
    ahead.follow(StrainParts(5.0, 0.0, 0.0), 1.0, SINCE_MINUTES_S)
    lost = find_gain(NO_STRAINS, StrainParts(5.0, 1.0, 1.0))
    for _ in range(round(3 * SINCE_MINUTES_S)):
        ahead.follow(lost, 1.0, SINCE_MINUTES_S)
    assert ahead.heat_ppm == pytest.approx(5.0 * math.exp(-3.0), rel=0.01)


def test_a_change_during_a_gap_of_the_sensor_is_not_explained() -> None:
    climate = Climate(ClimateConfig())
    readings = ClimateReadings(21.0, 21.0, 45.0, 21.0)
    for _ in range(10):
        climate.step(readings, 10.0)
    before = climate.fresh_parts
    assert math.isfinite(before.heat_ppm)
    # Minutes without a value are within what a slow instrument may miss
    missing = replace(readings, film_c=math.nan)
    for _ in range(29):
        climate.step(missing, 10.0)
    assert climate.fresh_parts.heat_ppm == before.heat_ppm
    for _ in range(5):
        climate.step(missing, 10.0)
    assert math.isnan(climate.fresh_parts.heat_ppm)
    climate.step(replace(readings, film_c=24.0), 10.0)
    back = climate.fresh_parts
    assert back.heat_ppm == pytest.approx(17.0 * 24.0)
    assert find_gain(back, NO_STRAINS).heat_ppm == 0.0


def _judge_knock(
    start_s: float, laser_um: float, camera_um: float, has_sensors: bool
) -> set[FaultySensor]:
    """Verdicts within 90 s after a knock of laser or camera in the air conditioner's room; the loop
    keeps the laser's reading. Two ticks and half a figure a second.
    """
    times_s = np.arange(round(2 * (start_s + 90.0)), dtype=np.float64) / 2
    block = Room(TwinConfig(climate="hvac", seed=1)).make_block(times_s)
    noise = np.random.default_rng(1).standard_normal((times_s.size, 6))
    allowance = ClimateAllowance(UM_PER_PPM, 0.15, MINUTES_MOST_UM)
    check = PlausibilityCheck(10.0, SAG_UM, allowance=allowance)
    climate = Climate(ClimateConfig())
    verdicts: set[FaultySensor] = set()
    for k, time_s in enumerate(times_s.tolist()):
        readings = ClimateReadings(
            float(block.film_c[k] + FILM_NOISE_K * noise[k, 0]),
            float(block.ring_c[k] + RING_NOISE_K * noise[k, 1]),
            float(block.humidity_percent[k] + HUMIDITY_NOISE_PERCENT * noise[k, 2]),
            21.0,
        )
        climate.step(readings, 0.5)
        if has_sensors:
            check.note_strains(climate.fresh_parts)
        knocked = time_s >= start_s
        film_um = -laser_um * knocked
        share = (1 + film_um / SAG_UM) / float(block.mirror_factor[k])
        sag_um = SAG_UM + film_um + camera_um * knocked + 0.1 * float(noise[k, 4])
        figure = replace(SOUND_FIGURE, time_s=time_s, sag_um=sag_um) if k % 4 == 0 else None
        gauge_pa = PRESSURE_PA * share**3 + 0.2 * float(noise[k, 5])
        verdict = check.step(0.5, float(noise[k, 3]), gauge_pa, figure)
        if knocked:
            verdicts.add(verdict)
    return verdicts


@pytest.mark.parametrize("size_um", [-15.0, 15.0, 25.0])
@pytest.mark.parametrize("right", [FaultySensor.LASER, FaultySensor.OPTICS])
def test_a_gauge_that_climate_moves_sides_with_no_wrong_sensor(
    size_um: float, right: FaultySensor
) -> None:
    knocks_um = {FaultySensor.LASER: (size_um, 0.0), FaultySensor.OPTICS: (0.0, size_um)}[right]
    (wrong,) = {FaultySensor.LASER, FaultySensor.OPTICS} - {right}
    starts_s = (200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
    found = [_judge_knock(start_s, *knocks_um, has_sensors=True) for start_s in starts_s]
    assert not any(wrong in verdicts for verdicts in found)
    assert sum(right in verdicts for verdicts in found) >= 4
    # Without sensors the gauge, 18 µm off, misleads it
    blind = [_judge_knock(start_s, *knocks_um, has_sensors=False) for start_s in starts_s]
    assert any(wrong in verdicts for verdicts in blind)


SOUND = ClimateReadings(21.0, 21.0, 45.0, 21.0)


def _step_for(climate: Climate, readings: ClimateReadings, seconds: int) -> StrainParts:
    """Strains after a while of the same readings."""
    for _ in range(seconds):
        climate.step(readings, 1.0)
    return climate.fresh_parts


def test_a_sensor_of_film_or_ring_that_comes_late_explains_nothing_by_its_coming() -> None:
    """Until then the air stood for it, which is 4 K colder: 234 µm of the centre."""
    climate = Climate(ClimateConfig())
    before = _step_for(climate, replace(SOUND, film_c=math.nan, ring_c=math.nan), 100)
    after = _step_for(climate, replace(SOUND, film_c=25.0, ring_c=25.0), 100)
    gain = find_gain(after, before)
    assert (gain.heat_ppm, gain.ring_ppm) == pytest.approx((0.0, 0.0))
    # Nor does it change the predicted figure
    assert climate.step(SOUND, 1e-6).excess_ppm == pytest.approx(0.0, abs=1e-3)
    # From then on it counts
    warmer = _step_for(climate, replace(SOUND, film_c=26.0, ring_c=25.0), 100)
    assert find_gain(warmer, after).heat_ppm == pytest.approx(17.0, rel=0.01)


def test_a_ring_whose_thermometer_is_lost_explains_nothing_until_it_is_back() -> None:
    climate = Climate(ClimateConfig())
    _step_for(climate, SOUND, 100)
    # The air, by which the figure is predicted meanwhile, is 5 K warmer
    lost = replace(SOUND, ring_c=math.nan, air_c=26.0)
    assert _step_for(climate, lost, 290).ring_ppm == pytest.approx(23.0 * 21.0)
    assert math.isnan(_step_for(climate, lost, 20).ring_ppm)
    back = replace(SOUND, ring_c=24.0)
    assert _step_for(climate, back, 1).ring_ppm == pytest.approx(23.0 * 24.0)


def test_a_film_has_followed_the_humidity_in_a_gap_of_the_hygrometer() -> None:
    """What it has gained there must not excuse a difference after it."""
    climate = Climate(ClimateConfig(film_follows_humidity_s=2000.0))
    _step_for(climate, SOUND, 100)
    assert math.isnan(_step_for(climate, replace(SOUND, humidity_percent=math.nan), 8000).water_ppm)
    humid = replace(SOUND, humidity_percent=55.0)
    back = _step_for(climate, humid, 1)
    later = _step_for(climate, humid, 4000)
    assert find_gain(later, back).water_ppm < 0.02 * 60.0


def test_a_slow_instrument_explains_as_soon_as_a_fast_one() -> None:
    """It gives a value each minute, and none between."""
    climate = Climate(ClimateConfig())
    before = _step_for(climate, SOUND, 100)
    for _ in range(2):
        climate.step(replace(SOUND, film_c=23.0), 1.0)
        _step_for(climate, replace(SOUND, film_c=math.nan), 59)
    assert find_gain(climate.fresh_parts, before).heat_ppm == pytest.approx(34.0, rel=0.01)


def test_within_a_day_the_climate_explains_nothing() -> None:
    """A laser of 0.04 µm/s: minutes and an hour do not show it, whatever thermometers say."""

    def lie(time_s: float, readings: ClimateReadings) -> ClimateReadings:
        drift_k = 0.04 * time_s / (17.0 * UM_PER_PPM)
        return replace(readings, film_c=readings.film_c + drift_k)

    creep_um = ramp(0.04)
    found, at_s = find_contradiction("lamp", 30_000.0, 10.0, creep_um=creep_um, alter=lie)
    assert found
    ahead_um = 0.04 * SINCE_DAY_S
    limit_um = LIMITS.laser_gauge_day_max_um + LAW_SHARE * 10.0
    assert creep_um(at_s) < -ahead_um * math.log(1 - limit_um / ahead_um) + 40.0
