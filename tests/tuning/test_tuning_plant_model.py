"""The exact response against brute-force integration, and what a record says of itself."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import telegraph, way_um

from membrane_ctrl.control.experiments.experiment import BenchSample
from tuning.identification.plant_model import PlantModel, compute_driven_um
from tuning.identification.record import Record


@pytest.mark.parametrize("dead_time_s", [0.0, 0.02, 0.0755, 0.313])
@pytest.mark.parametrize("lag_s", [0.05, 0.4])
def test_response_is_exact_for_any_dead_time(dead_time_s: float, lag_s: float) -> None:
    flow = telegraph(np.random.default_rng(3), 400, 0.3, 5.0, hold=15)
    truth = way_um(flow, PlantModel(1.0, dead_time_s, lag_s, 0.0), 0.02)
    assert compute_driven_um(flow, dead_time_s, lag_s, 0.02) == pytest.approx(truth, abs=2e-3)


def test_a_ramp_comes_late_by_dead_time_and_lag() -> None:
    flow = np.concatenate((np.zeros(50), np.ones(950)))
    way = compute_driven_um(flow, 0.1, 0.2, 0.02)
    assert way[-1] == pytest.approx(950 * 0.02 - 0.02 - 0.3, abs=1e-9)


def test_without_lag_only_the_dead_time_is_left() -> None:
    flow = np.concatenate((np.zeros(5), np.ones(20)))
    assert compute_driven_um(flow, 0.04, 0.0, 0.02)[-1] == pytest.approx(
        19 * 0.02 - 0.04, abs=1e-12
    )


def test_holding_flow_is_the_leak_in_commands() -> None:
    model = PlantModel(0.5, 0.1, 0.15, 1.2)
    assert model.holding_flow_um_per_s == 2.4
    assert model.delay_s == 0.25


def test_lost_readings_are_counted_and_bridged() -> None:
    samples = [BenchSample(v) for v in (0.0, float("nan"), 2.0, 3.0)]
    record = Record.from_samples(0.02, [1.0] * 4, samples)
    assert record.lost_fraction == 0.25
    assert record.filled_displacement_um().tolist() == [0.0, 1.0, 2.0, 3.0]
    assert not record.has_barometer
    assert not record.has_thermometer


def test_a_record_without_any_reading_is_refused() -> None:
    record = Record.from_samples(0.02, [1.0] * 3, [BenchSample(float("nan"))] * 3)
    with pytest.raises(ValueError, match="no reading of the mirror"):
        record.filled_displacement_um()


def test_parts_join_again_and_hash_the_same() -> None:
    whole = Record.from_samples(
        0.02, [1.0, 2.0, 3.0, 4.0], [BenchSample(float(i), 1.0, 2.0) for i in range(4)]
    )
    joined = whole.cut(0.0, 0.04).followed_by(whole.cut(0.04, 0.08))
    assert joined.sha256() == whole.sha256()
    assert joined.sha256() != whole.cut(0.0, 0.06).sha256()


def test_records_of_different_rates_do_not_join() -> None:
    one = Record.from_samples(0.02, [1.0], [BenchSample(0.0)])
    other = Record.from_samples(0.05, [1.0], [BenchSample(0.0)])
    with pytest.raises(ValueError, match="sample times"):
        one.followed_by(other)
