"""Climate sensors beside the states: what is used, what is reported, and what is predicted."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from firmware_iface.roles import NO_READING, BenchReading
from membrane_ctrl.config.schema import ClimateConfig, Config
from membrane_ctrl.controller.climate_part import ClimatePart
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver
from membrane_ctrl.model.telemetry import State

MINUTE_S = 60.0
CONFIG = Config(climate=ClimateConfig(film_follows_humidity_s=0.0))


def _reading(
    film_c: float = math.nan, ring_c: float = math.nan, humidity: float = math.nan, k: int = 0
) -> BenchReading:
    """A reading with the last digit's noise."""
    noise = 0.001 * (k % 7)
    return replace(
        NO_READING,
        film_temperature_c=film_c + noise,
        ring_temperature_c=ring_c + noise,
        humidity_percent=humidity + noise,
        air_temperature_c=21.0,
    )


def _run(
    part: ClimatePart, minutes: int, state: State = State.HOLD, **values: float
) -> list[Event]:
    events = []
    for k in range(minutes):
        events += part.step(_reading(**values, k=k), state, MINUTE_S)
    return events


def test_humidity_changes_the_figure_behind_a_held_centre_and_is_reported_once() -> None:
    part = ClimatePart(CONFIG)
    assert _run(part, 20, film_c=21.0, ring_c=21.0, humidity=45.0) == []
    assert part.telemetry()["climate_figure_um"] < 0.1
    (notice,) = _run(part, 20, film_c=21.0, ring_c=21.0, humidity=55.0)
    assert isinstance(notice, Maintenance)
    assert notice.name == "climate_figure"
    # 60 ppm: by the issue's own Ritz model 15 µm for 70 ppm
    assert part.telemetry()["climate_figure_um"] == pytest.approx(15.0 * 60 / 70, rel=0.05)
    assert part.telemetry()["film_strain_ppm"] == pytest.approx(60.0, abs=0.5)
    assert 0.1 < part.telemetry()["climate_sigma_um"] / part.telemetry()["climate_figure_um"] < 0.2
    (over,) = _run(part, 20, film_c=21.0, ring_c=21.0, humidity=46.0)
    assert isinstance(over, MaintenanceOver)


def test_film_and_ring_that_warm_together_differ_by_their_expansions() -> None:
    part = ClimatePart(CONFIG)
    _run(part, 20, film_c=21.0, ring_c=21.0, humidity=45.0)
    _run(part, 20, film_c=22.0, ring_c=22.0, humidity=45.0)
    assert part.memory.strain.excess_ppm == pytest.approx(17.0 - 23.0, abs=0.2)


@pytest.mark.parametrize(
    ("values", "name", "words"),
    [
        ({"film_c": 294.0, "ring_c": 21.0, "humidity": 45.0}, "film_thermometer", "unit"),
        ({"film_c": 21.0, "ring_c": -40.0, "humidity": 45.0}, "ring_thermometer", "unit"),
        ({"film_c": 21.0, "ring_c": 21.0, "humidity": 140.0}, "hygrometer", "unit"),
        ({"film_c": 21.0, "ring_c": 21.0}, "hygrometer", "no value"),
        ({"film_c": 21.0, "ring_c": 21.0, "humidity": math.inf}, "hygrometer", "no value"),
    ],
    ids=["kelvin", "cold", "scale", "missing", "infinite"],
)
def test_a_wrong_sensor_is_ignored_and_reported(
    values: dict[str, float], name: str, words: str
) -> None:
    part = ClimatePart(CONFIG)
    _run(part, 20, film_c=21.0, ring_c=21.0, humidity=45.0)
    sigma_um = part.telemetry()["climate_sigma_um"]
    (notice,) = _run(part, 120, **values)
    assert isinstance(notice, Maintenance)
    assert notice.name == name
    assert words in notice.message
    assert part.telemetry()["climate_figure_um"] < 0.1  # the state stays
    assert part.telemetry()["climate_sigma_um"] > sigma_um + 0.5  # and is less sure
    (over,) = _run(part, 20, film_c=21.0, ring_c=21.0, humidity=45.0)
    assert isinstance(over, MaintenanceOver)


def test_a_frozen_sensor_is_reported_after_an_hour() -> None:
    part = ClimatePart(CONFIG)
    _run(part, 20, film_c=21.0, ring_c=21.0, humidity=45.0)
    events: list[Event] = []
    for k in range(90):
        reading = replace(_reading(21.0, 21.0, 45.0, k), humidity_percent=45.3)
        events += part.step(reading, State.HOLD, MINUTE_S)
    (notice,) = events
    assert isinstance(notice, Maintenance)
    assert "stuck" in notice.message


def test_a_bench_without_climate_sensors_predicts_nothing() -> None:
    part = ClimatePart(CONFIG)
    assert _run(part, 200) == []
    assert part.telemetry() == {}
    assert part.step(None, State.HOLD, MINUTE_S) == []


def test_without_a_ring_thermometer_the_ring_follows_the_air_with_its_lag() -> None:
    config = Config(climate=ClimateConfig(ring_follows_air_s=3600.0))
    part = ClimatePart(config)
    for k in range(180):
        warm = replace(_reading(film_c=21.0 if k < 60 else 23.0, k=k), ring_temperature_c=math.nan)
        warm = replace(warm, air_temperature_c=21.0 if k < 60 else 23.0)
        part.step(warm, State.HOLD, MINUTE_S)
    share = 1 - math.exp(-2.0)
    assert part.memory.strain.ring_ppm == pytest.approx(23.0 * 2 * share, rel=0.02)


@pytest.mark.parametrize("humidity", [0.0, 0.45], ids=["no current", "a fraction"])
def test_a_hygrometer_below_one_per_cent_is_not_used(humidity: float) -> None:
    part = ClimatePart(CONFIG)
    (notice,) = _run(part, 20, film_c=21.0, ring_c=21.0, humidity=humidity)
    assert isinstance(notice, Maintenance)
    assert "check its unit" in notice.message
    assert math.isnan(part.fresh_strains.water_ppm)


def test_the_air_thermometer_alone_explains_nothing() -> None:
    """It stands for film and ring only beside a sensor of the climate."""
    part = ClimatePart(CONFIG)
    _run(part, 20, humidity=45.0)
    assert math.isfinite(part.fresh_strains.heat_ppm)
    _run(part, 6)
    strains = part.fresh_strains
    assert all(map(math.isnan, (strains.heat_ppm, strains.water_ppm, strains.ring_ppm)))
