"""Changes between two sets of the second world whose camera or screen has moved in between."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.studies.second_world_errors import MeasuredErrors, measured_errors, sigma_um
from tests.worlds.second_optics import YAW, Bench, Effects, Mirror, Sensor, Stated, World

SCALE = 0.125
FINE = Stated(sigma_share=0.01)
QUIET = Effects(sensor=Sensor(bits=16, read_adu=60.0, full_well=0.0), laser_noise_um=0.0)
MIRROR = Mirror()
POINTS_MM = np.array([[0.0, 200.0, -300.0], [350.0, 100.0, 200.0]])
FloatArray = NDArray[np.float64]


def measured(folder: Path, bench: Bench, seed: int) -> MeasuredErrors:
    world = World(MIRROR, bench, QUIET, FINE, seed=seed)
    truth = world.write_set(folder)
    return measured_errors(folder, MIRROR, truth, POINTS_MM)


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> MeasuredErrors:
    return measured(tmp_path_factory.mktemp("before"), Bench.paper(SCALE), 1)


def turned(urad: float) -> Bench:
    camera = np.zeros(6)
    camera[YAW] = 1e-6 * urad
    return Bench.paper(SCALE).moved(camera, np.zeros(6))


def change_um(before: MeasuredErrors, after: MeasuredErrors) -> FloatArray:
    """Change of the sag and of Z4 to Z11; the film rests."""
    assert before.error_um is not None
    assert after.error_um is not None
    return np.asarray(after.error_um - before.error_um)[:9]


@pytest.mark.parametrize("urad", [3.0, 30.0, 150.0])
def test_a_camera_that_turned_is_within_the_bar_of_the_change(
    before: MeasuredErrors, tmp_path: Path, urad: float
) -> None:
    """Changes were 9 sigma off after 3 µrad, both sets `ok`."""
    after = measured(tmp_path, turned(urad), 2)
    assert before.budget is not None
    assert after.budget is not None
    off_um = np.abs(change_um(before, after))
    at_rest = after.budget.steady_change_covariance(before.budget)
    assert (off_um / sigma_um(after.rows, at_rest)[:9]).max() > 3.0
    assert (off_um / after.change_sigma_um(before)[:9]).max() < 3.0


def test_motions_of_a_bench_at_rest_are_small_and_unnamed(
    before: MeasuredErrors, tmp_path: Path
) -> None:
    after = measured(tmp_path, Bench.paper(SCALE), 2)
    assert before.budget is not None
    assert after.budget is not None
    found = after.budget.find_motion(before.budget)
    assert found is not None
    assert not found.is_proven
    sigmas_um = after.change_sigma_um(before)[:9]
    assert sigmas_um[0] < 0.3
    assert sigmas_um[1:].max() < 0.15
