"""Sensors that repeat their readings: slower than the ticks, or with coarse steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tests.tuning import synthetic
from tests.worlds.drawn_laboratories import DrawnPlant, LaserFlaws, Room
from tests.worlds.foreign_plant import ForeignPump, foreign_bench, foreign_config
from tuning.identification.disturbance import DisturbanceModel
from tuning.identification.experiments import fit_experiments, run_experiments
from tuning.identification.fit_quality import judge_fit
from tuning.identification.noise_spectrum import Noise
from tuning.identification.plant_fit import identify_plant
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Record, Series
from tuning.proposal.model_bench import ModelBench
from tuning.proposal.preview import preview_loop
from tuning.proposal.record_replay import replay_um
from tuning.rigs.bench_rig import Rig
from tuning.rigs.hold_rig import HoldRig
from tuning.rigs.operating_point import estimate_laser_noise_um
from tuning.twin_hold import TwinHold

PLANT = PlantModel(1.0, 0.08, 0.15, 1.24)
# The curve of the straight pump, known from a map
STRAIGHT = PumpConfig(
    start_fraction=0.1, stall_fraction=0.1, curve_fraction=(0.1, 1.0), curve_um_per_s=(0.0, 5.3)
)


def make_record(displacement_um: Series) -> Record:
    absent = np.full(displacement_um.size, math.nan)
    return Record(0.05, np.ones(displacement_um.size), displacement_um, absent, absent)


@pytest.mark.parametrize("ticks_of_a_sample", [1.0, 1.15, 1.5, 2.0, 3.4])
def test_repeated_samples_hide_no_noise(ticks_of_a_sample: float) -> None:
    """At two ticks a sample, half of the differences are 0, and so is their median."""
    rng = np.random.default_rng(5)
    samples_um = np.round(0.7 * rng.standard_normal(4000), 3)
    places = np.floor(np.arange(3000) / ticks_of_a_sample).astype(int)
    found_um = estimate_laser_noise_um(make_record(samples_um[places]))
    assert found_um == pytest.approx(0.7, rel=0.1)


@pytest.mark.parametrize(("step_um", "noise_um"), [(1.0, 0.15), (0.5, 0.3), (0.1, 0.05)])
def test_coarse_steps_count_as_noise(step_um: float, noise_um: float) -> None:
    """The error of rounding belongs to the noise, of a mirror that moves over a few steps."""
    rng = np.random.default_rng(6)
    mirror_um = 3.0 * np.sin(np.arange(6000) / 400.0)
    read_um = np.round((mirror_um + noise_um * rng.standard_normal(6000)) / step_um) * step_um
    true_um = math.hypot(noise_um, step_um / math.sqrt(12.0))
    found_um = estimate_laser_noise_um(make_record(read_um))
    assert 0.5 * true_um < found_um < 1.5 * true_um


@pytest.mark.fast_cases("0.0-0.05", "0.15-0.15")
@pytest.mark.parametrize(
    ("pace_s", "dt_s"),
    [(0.0, 0.05), pytest.param(0.06, 0.05, marks=pytest.mark.campaign), (0.1, 0.1), (0.15, 0.15)],
)
def test_a_laser_slower_than_the_ticks_gives_a_reading_for_each_sample(
    pace_s: float, dt_s: float
) -> None:
    """With three ticks a sample, a fit of all ticks does not know the gain, and blames the pump."""
    pump = ForeignPump("straight", 5.3, 0.1, 0.2)
    plant = DrawnPlant(pump, 3, Room(0.5, False), LaserFlaws(pace_s=pace_s), 1.24, 0.5, True)
    config = foreign_config(rate_hz=20.0).model_copy(update={"pump": STRAIGHT})
    rig = HoldRig(TwinHold(config, bench=foreign_bench(plant)), "tester")
    done = fit_experiments(run_experiments(rig))
    found, record = done.identified, done.experiments.record
    assert record.dt_s == pytest.approx(dt_s)
    assert done.quality.verdict != "refused"
    assert found.model.gain == pytest.approx(1.0, abs=0.05)
    assert found.model.delay_s == pytest.approx(0.3 + 0.5 * pace_s, abs=0.08)


def test_a_replay_and_a_preview_run_at_the_rate_of_the_readings() -> None:
    """The loop ticks three times as often as its laser reads."""
    loop = LoopConfig(rate_hz=50.0, feedforward_barometer=False, feedforward_temperature=False)
    weather = DisturbanceModel(Noise(0.3, 0.01, 0.01, 12.0, 0.06), None, None)
    slow = loop.model_copy(update={"rate_hz": 1.0 / 0.06})
    bench = ModelBench(PLANT, weather, STRAIGHT, 3)
    rig = Rig(bench, slow, STRAIGHT, PLANT.holding_flow_um_per_s)
    rig.hold(30.0)
    record = rig.hold(120.0)
    replayed_um = replay_um(record, record.displacement_um, PLANT, loop, STRAIGHT)
    assert replayed_um.size == len(record) - 1
    assert replayed_um.std() == pytest.approx(record.displacement_um.std(), rel=0.1)
    seen = preview_loop(loop, STRAIGHT, PLANT, weather)
    assert seen.std_um == pytest.approx(preview_loop(slow, STRAIGHT, PLANT, weather).std_um)


def test_jumps_do_not_count_as_noise() -> None:
    rng = np.random.default_rng(7)
    read_um = 0.7 * rng.standard_normal(3000)
    read_um[1500:] += 40.0
    assert estimate_laser_noise_um(make_record(read_um)) == pytest.approx(0.7, rel=0.1)


def test_a_sensor_that_repeats_samples_is_named_as_the_cause_of_colour() -> None:
    record = synthetic.record(PLANT, samples=6000)
    held_um = np.repeat(record.displacement_um[::2], 2)
    slow = replace(record, displacement_um=held_um)
    reasons = judge_fit(slow, identify_plant(slow)).reasons
    assert any("the sensor is slower than the ticks" in reason for reason in reasons)
    assert not any("something periodic" in reason for reason in reasons)
