"""The geometry file of a calibration: readable by the others, its covariance that of the
parameters.
"""

from __future__ import annotations

import copy
import tomllib

import numpy as np
import pytest
import tomli_w

from membrane_ctrl.config.optics import GeometryConfig, OpticsConfig, ScreenPoseConfig
from membrane_ctrl.metrology.calibration.geometry_tables import (
    Origin,
    general_covariance,
    make_geometry_tables,
)
from membrane_ctrl.metrology.calibration.solver import Solution, solve_calibration
from membrane_ctrl.metrology.rays.bench_parameters import NAMES, prior_sigmas
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.uncertainty.geometry_spread import (
    GENERAL_NAMES,
    GeometrySpread,
    change_geometry,
)
from membrane_ctrl.model.geometry_hash import hash_content
from tests.support.calibration_truth import OPTICS, make

ORIGIN = Origin("2026-01-01T00:00:00+00:00", ("a", "b"), 1.0, 2.0, 1.5, 3.0, ("a note",))
FREE = prior_sigmas({"bow_mm": 1.5, "k1": 0.02, "pitch_relative": 1e-3})


@pytest.fixture(scope="module")
def solution() -> Solution:
    truth = make(FREE * 0.3, seed=4, points=1500)
    return solve_calibration(truth.problem(FREE))


def test_the_file_contains_the_calibrated_bench(solution: Solution) -> None:
    tables = tomllib.loads(tomli_w.dumps(make_geometry_tables(solution, OPTICS, ORIGIN)))
    geometry = GeometryConfig.model_validate(tables["geometry"])
    assert geometry.reference_displacement_um == 0.0
    there = Geometry.from_config(OpticsConfig(geometry=geometry))
    bench = solution.bench
    for field in ("pinhole_mm", "rotation", "screen_origin_mm", "screen_s_x", "screen_s_y"):
        assert np.array_equal(getattr(there, field), getattr(bench.geometry, field)), field
    assert tables["geometry"]["screen"]["bow_mm"] == pytest.approx(
        solution.values[NAMES.index("bow_mm")]
    )
    assert there.face.bow_per_mm == pytest.approx(bench.geometry.face.bow_per_mm, rel=1e-14)
    assert tables["camera"]["distortion"] == list(bench.geometry.distortion)
    assert tables["pattern"]["period_mm"] == pytest.approx(OPTICS.pattern.period_mm * bench.pitch)
    assert tables["calibration"]["sets"] == ["a", "b"]
    assert tables["parameters"]["names"] == solution.free_names


def test_only_what_was_free_is_written() -> None:
    truth = make(np.zeros(len(NAMES)), seed=4, points=1200)
    tables = make_geometry_tables(solve_calibration(truth.problem(prior_sigmas())), OPTICS, ORIGIN)
    assert not {"camera", "pattern"} & set(tables)
    assert tables["geometry"]["screen"]["bow_mm"] == 0


def test_a_stated_bow_and_map_are_kept() -> None:
    stated_map = {
        "s_x_mm": [-300, 0, 300],
        "s_y_mm": [-300, 300],
        "heights_mm": [[0.1, 0, 0.1], [0, 0, 0]],
    }
    stated = OPTICS.geometry.model_copy(
        update={"screen": ScreenPoseConfig(bow_mm=0.5, height_map=stated_map)}
    )
    optics = OPTICS.model_copy(update={"geometry": stated})
    bench = bench_at(Geometry.from_config(optics), FREE)
    assert bench.geometry.face.bow_per_mm * 200.0**2 == pytest.approx(2.0)
    assert bench.geometry.face.cells_mm.size
    truth = make(np.zeros(len(NAMES)), seed=4, points=1200)
    screen = make_geometry_tables(solve_calibration(truth.problem(prior_sigmas())), optics, ORIGIN)[
        "geometry"
    ]["screen"]
    assert ScreenPoseConfig.model_validate(screen).height_map == stated.screen.height_map


def test_the_covariance_is_that_of_drawn_parameters(solution: Solution) -> None:
    covariance = general_covariance(solution)
    freed = ("k1", "bow_mm", "pitch_relative")
    whole = GeometrySpread((*GENERAL_NAMES, *freed), covariance)  # refuses what is no covariance
    own = [NAMES.index(name) for name in freed]
    assert whole.covariance[12:, 12:] == pytest.approx(
        solution.covariance[np.ix_(own, own)], rel=1e-9
    )
    spread = GeometrySpread(GENERAL_NAMES, covariance[:12, :12])
    # a change along one parameter, and the poses' own change by the twelve numbers that stand for
    # it
    config = GeometryConfig.model_validate(
        make_geometry_tables(solution, OPTICS, ORIGIN)["geometry"]
    )
    rng = np.random.default_rng(0)
    inverse = np.linalg.pinv(spread.correlation(), rcond=1e-10)
    k = len(solution.values)
    root = np.linalg.cholesky(solution.covariance[np.ix_(FREE > 0, FREE > 0)][:11, :11])
    far = []
    for _ in range(40):
        values = solution.values.copy()
        values[:11] += root @ rng.normal(size=11)
        there = bench_at(solution.problem.stated, values).geometry
        here = solution.bench.geometry
        shift = there.pinhole_mm - here.pinhole_mm, there.screen_origin_mm - here.screen_origin_mm
        turns = (_turn(here.rotation, there.rotation), _turn(_rows(here), _rows(there)))
        change = np.concatenate([shift[0], turns[0], shift[1], turns[1]])
        moved = Geometry.from_config(
            OpticsConfig(geometry=change_geometry(config, GENERAL_NAMES, change))
        )
        assert np.allclose(moved.rotation, there.rotation, atol=1e-9)
        assert np.allclose(moved.screen_s_x, there.screen_s_x, atol=1e-9)
        scaled = change / np.where(spread.sigmas > 0, spread.sigmas, 1.0)
        far.append(scaled @ inverse @ scaled)
    # a chi-square of eleven degrees of freedom
    assert k >= 11
    assert 9 < np.mean(far) < 13


def _rows(geometry: Geometry) -> np.ndarray:
    normal = np.cross(geometry.screen_s_x, geometry.screen_s_y)
    return np.stack([geometry.screen_s_x, geometry.screen_s_y, normal])


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(after.T @ before).as_rotvec()


def test_the_hash_depends_on_the_numbers_alone(solution: Solution) -> None:
    tables = make_geometry_tables(solution, OPTICS, ORIGIN)
    there_and_back = tomllib.loads(tomli_w.dumps(tables))
    assert hash_content(there_and_back) == tables["calibration"]["hash"]
    later = make_geometry_tables(
        solution, OPTICS, Origin("2027-01-01T00:00:00+00:00", ("c",), 1.0, 2.0, 1.5, 3.0)
    )
    assert later["calibration"]["hash"] == tables["calibration"]["hash"]
    edited = copy.deepcopy(there_and_back)
    edited["geometry"]["camera"]["position_mm"][0] += 0.001
    assert hash_content(edited) != tables["calibration"]["hash"]
