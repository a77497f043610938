"""Surroundings, sensors, determinism and time of the plant."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.sim.bench_events import AmbientChange, LaserDrift, LaserDropout
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.surroundings import SCENARIOS, OrnsteinUhlenbeck
from membrane_ctrl.sim.truth import TRUTH_BYTES, Truth

PUMP = PumpConfig()


@pytest.mark.parametrize("scenario", ["quiet", "typical", "gusty"])
@pytest.mark.parametrize("quantity", [0, 1])
def test_ornstein_uhlenbeck_has_the_scenarios_spread_and_memory(
    scenario: str, quantity: int
) -> None:
    std, correlation_s = SCENARIOS[scenario][quantity]
    step_s = correlation_s / 10
    noise = OrnsteinUhlenbeck(std, correlation_s, step_s, np.random.default_rng(3))
    values = np.concatenate(
        [noise.next_values(1000) for _ in range(200)]
    )  # 20 000 correlation times
    assert values.std() == pytest.approx(std, rel=0.03)
    assert values.mean() == pytest.approx(0.0, abs=0.04 * std)
    after_one_constant = np.corrcoef(values[:-10], values[10:])[0, 1]
    assert after_one_constant == pytest.approx(math.exp(-1), abs=0.02)


def test_blocks_join_without_a_seam() -> None:
    def values(blocks: list[int]) -> np.ndarray:
        noise = OrnsteinUhlenbeck(1.0, 30.0, 0.005, np.random.default_rng(5))
        return np.concatenate([noise.next_values(n) for n in blocks])

    assert np.array_equal(values([600]), values([1, 99, 500]))


def test_calm_is_calm() -> None:
    plant = Plant(TwinConfig(scenario="calm"), PUMP)
    plant.advance(30.0)
    assert plant.truth().ambient_pressure_pa == 101_325.0
    assert plant.truth().air_temperature_c == pytest.approx(23.0)


def test_same_seed_and_calls_give_the_same_samples_and_another_seed_does_not() -> None:
    def night(seed: int) -> list[object]:
        plant = Plant(TwinConfig(seed=seed), PUMP, [AmbientChange(3.0, 20.0)])
        samples = []
        for k in range(300):
            plant.actuate(0.2 + 0.1 * math.sin(k), 0.0)
            plant.advance(0.02)
            samples.append(plant.sample())
        return samples

    assert night(7) == night(7)
    assert night(7) != night(8)


def test_truth_depends_neither_on_sampling_nor_on_how_time_is_cut() -> None:
    coarse, fine = Plant(TwinConfig(), PUMP), Plant(TwinConfig(), PUMP)
    coarse.advance(30.0)
    for _ in range(10_000):
        fine.advance(0.003)
        fine.sample()
    assert fine.time_s == coarse.time_s == pytest.approx(30.0)
    assert fine.truth() == coarse.truth()


def test_time_passes_in_whole_steps_and_loses_none() -> None:
    plant = Plant(TwinConfig(scenario="calm"), PUMP)
    plant.advance(0.004)
    assert plant.time_s == 0.0
    plant.advance(0.004)
    assert plant.time_s == pytest.approx(0.005)
    for _ in range(3000):
        plant.advance(0.02)
    assert plant.time_s == pytest.approx(60.005)


def test_laser_noise_and_resolution() -> None:
    config = TwinConfig(scenario="calm", laser_noise_um=1.0, laser_resolution_um=0.5)
    plant = Plant(config, PUMP)
    readings = np.array([plant.sample().displacement_um for _ in range(4000)])
    assert readings.std() == pytest.approx(math.hypot(1.0, 0.5 / math.sqrt(12)), rel=0.05)
    assert readings.mean() == pytest.approx(-25.0, abs=0.08)
    assert np.array_equal(readings, np.round(readings / 0.5) * 0.5)


def test_noise_free_sensors_show_the_true_values() -> None:
    quiet = {
        "laser_noise_um": 0.0,
        "laser_resolution_um": 0.0,
        "barometer_noise_pa": 0.0,
        "thermometer_noise_k": 0.0,
    }
    plant = Plant(TwinConfig.model_validate(quiet), PUMP)
    plant.advance(12.0)
    sample, truth = plant.sample(), plant.truth()
    assert sample.displacement_um == truth.displacement_um
    assert sample.ambient_pressure_pa == truth.ambient_pressure_pa
    assert sample.air_temperature_c == truth.air_temperature_c
    assert sample.gas_temperature_c == truth.gas_temperature_c
    assert sample.gauge_pressure_pa == pytest.approx(truth.gauge_pressure_pa, abs=3.0)


def test_samples_are_counted_and_stamped() -> None:
    plant = Plant(TwinConfig(), PUMP)
    plant.actuate(0.4, 0.05)
    stamps = []
    for _ in range(3):
        plant.advance(0.02)
        stamps.append((plant.sample().sample_counter, plant.sample().device_time_s))
    assert [counter for counter, _ in stamps] == [1, 3, 5]
    assert [time_s for _, time_s in stamps] == pytest.approx([0.02, 0.04, 0.06])
    assert (plant._pump_fraction, plant._vent_fraction) == (0.4, 0.05)


def test_laser_without_light_has_no_reading() -> None:
    plant = Plant(TwinConfig(scenario="calm"), PUMP, [LaserDropout(at_s=1.0, duration_s=0.5)])
    seen = []
    for _ in range(100):
        plant.advance(0.02)
        sample = plant.sample()
        assert math.isnan(sample.displacement_um) == (sample.displacement_quality != 0)
        if sample.displacement_quality:
            seen.append(sample.device_time_s)
    assert min(seen) == pytest.approx(1.0)
    assert max(seen) == pytest.approx(1.48)
    assert len(seen) == 25


def test_laser_mount_drifts_and_the_mirror_does_not() -> None:
    events = [LaserDrift(at_s=60.0, rate_um_per_min=3.0, duration_s=20.0)]
    plant = Plant(
        TwinConfig(scenario="calm", laser_noise_um=0.0, laser_drift_um_per_min=2.0), PUMP, events
    )
    plant.advance(120.0)
    truth = plant.truth()
    assert truth.laser_bias_um == pytest.approx(2 * 2.0 + 1.0)
    assert plant.sample().displacement_um - truth.displacement_um == pytest.approx(5.0, abs=0.06)
    assert truth.displacement_um == pytest.approx(-25.0, abs=0.1)


def test_truth_crosses_as_doubles() -> None:
    truth = replace(Plant(TwinConfig(), PUMP).truth(), time_s=12.5)
    assert len(truth.pack()) == TRUTH_BYTES
    # without a climate its values are NaN, which equals nothing
    unpacked, expected = astuple(Truth.unpack(truth.pack())), astuple(truth)
    np.testing.assert_array_equal(unpacked, expected)
