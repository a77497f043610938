"""The forward model of the calibration, its derivatives, and its parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.metrology.calibration.point_averages import average_points
from membrane_ctrl.metrology.calibration.set_state import SetState
from membrane_ctrl.metrology.rays.bench_parameters import ALL, NAMES, POSE, prior_sigmas
from membrane_ctrl.metrology.rays.bench_poses import (
    OPTICAL,
    BenchGeometry,
    bench_at,
    pose_derivatives,
    poses_at,
)
from membrane_ctrl.metrology.rays.forward_model import (
    BEYOND,
    COLUMNS,
    LOCAL,
    MOTION,
    linearise_points,
    residual_mm,
)
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.rim_harmonics import rim_harmonics
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from tests.support.calibration_truth import OPTICS, STATED, make

RNG = np.random.default_rng(1)
LENS = Geometry.from_config(
    OpticsConfig(camera=CameraConfig(distortion=(-0.05, 0.02, 1e-3, -5e-4)))
)
VALUES = np.array([0.5 * p.sigma for p in ALL]) * RNG.normal(size=len(ALL))
SURFACE = Surface.from_parameters(
    Surface.hencky_bowl(37.0, 500.0).parameters
    + np.append(RNG.normal(size=PARAMETERS - 1) * 0.1, 0.0),
    500.0,
)


def looked(count: int = 200) -> SetPhases:
    """Pixels that see the mirror."""
    column, row = RNG.uniform(700, 1700, count), RNG.uniform(500, 1500, count)
    return SetPhases("a", column, row, np.zeros((2, count)), np.ones(count), 0.0)


def test_derivatives_are_those_of_the_model() -> None:
    phases, z_mm = looked(), 0.3

    def predicted(values=VALUES, surface=SURFACE, z=z_mm):  # type: ignore[no-untyped-def]
        return -residual_mm(bench_at(LENS, values), phases, surface, z)

    chunk = next(
        iter(
            linearise_points(
                bench_at(LENS, VALUES), pose_derivatives(LENS, VALUES), phases, SURFACE, z_mm
            )
        )
    )
    assert chunk.derivatives.shape == (2, COLUMNS, 200)
    for column in range(COLUMNS):
        if column < PARAMETERS:
            step = np.eye(PARAMETERS)[column] * 1e-3
            both = [
                predicted(surface=Surface.from_parameters(SURFACE.parameters + sign * step, 500.0))
                for sign in (1, -1)
            ]
            numeric = (both[0] - both[1]) / 2e-3
        elif column == PARAMETERS:
            numeric = (predicted(z=z_mm + 1e-2) - predicted(z=z_mm - 1e-2)) / 2e-2
        elif column == MOTION:  # a bowl that is deeper in the x frames, its ring at rest
            deeper = Surface.hencky_bowl(1e-2, 500.0).parameters
            both = [
                predicted(
                    surface=Surface.from_parameters(SURFACE.parameters + s * deeper, 500.0),
                    z=z_mm - s * 1e-2,
                )
                for s in (0.5, -0.5)
            ]
            numeric = (both[0] - both[1]) / 1e-2 * np.array([[0.5], [-0.5]])
        elif column < LOCAL:
            steps = [np.eye(LOCAL)[column, BEYOND] * size for size in (1e-5, -1e-5)]
            both = [
                predicted(surface=replace(SURFACE, beyond_mm=tuple(step.tolist())))
                for step in steps
            ]
            numeric = (both[0] - both[1]) / 2e-5
        else:
            step = np.zeros(len(NAMES))
            step[column - LOCAL] = 1e-2 * ALL[column - LOCAL].sigma
            numeric = (predicted(VALUES + step) - predicted(VALUES - step)) / (2 * step.max())
        error = np.abs(chunk.derivatives[:, column] - numeric).max()
        assert error <= 3e-6 * np.abs(numeric).max(), (
            column
        )  # of a seat: the fringes do not depend on it


def test_the_model_is_the_twins_trace() -> None:
    truth = make(VALUES * (np.arange(len(NAMES)) < len(POSE)), seed=3, points=500, bow_mm=0.7)
    values = truth.values.copy()
    values[NAMES.index("bow_mm")] = 0.7
    for phases, sag_mm in zip(truth.sets, (33.0, 41.0), strict=False):
        # the film in the model's own terms: its bowl and its 36 Zernike terms
        coeffs_mm = np.array(truth.film.zernike_um) / 1e3
        bowl = Surface.hencky_bowl(sag_mm, 500.0).parameters
        surface = Surface.from_parameters(bowl + np.append(coeffs_mm[1:], 0.0), 500.0)
        if sag_mm == 33.0:
            left = residual_mm(bench_at(STATED, values), phases, surface, 4.0)
            assert np.abs(left).max() < 6 * phases.sigma_mm[0]


def test_zero_parameters_are_the_stated_bench() -> None:
    bench = bench_at(LENS, np.zeros(len(NAMES)))
    assert bench.geometry.face.is_plane
    assert bench.pitch == 1
    for field in (
        "pinhole_mm",
        "rotation",
        "screen_origin_mm",
        "screen_s_x",
        "screen_s_y",
        "principal_px",
    ):
        assert np.allclose(getattr(bench.geometry, field), getattr(LENS, field), atol=1e-12), field
    assert bench.geometry.distortion == LENS.distortion


def test_a_b_alpha_are_the_papers() -> None:
    values = np.zeros(len(NAMES))
    values[:3] = 2.0, -3.0, 0.4
    there = bench_at(STATED, values).geometry
    optics = OPTICS.model_copy(
        update={"geometry": GeometryConfig(a_mm=2674.0, b_mm=2868.0, alpha_deg=81.3)}
    )
    expected = Geometry.from_config(optics)
    for field in ("pinhole_mm", "rotation", "screen_origin_mm", "screen_s_x", "screen_s_y"):
        assert np.allclose(getattr(there, field), getattr(expected, field), atol=1e-9), field


def test_pose_derivatives_are_exact() -> None:
    for k, turn in enumerate(pose_derivatives(STATED, VALUES)):
        step = np.zeros(len(NAMES))
        step[k] = 1e-4
        plus, minus = poses_at(STATED, VALUES + step), poses_at(STATED, VALUES - step)
        for field in ("pinhole_mm", "camera", "origin_mm", "screen"):
            numeric = (getattr(plus, field) - getattr(minus, field)) / 2e-4
            assert np.allclose(getattr(turn, field), numeric, atol=1e-7), (k, field)


def test_sigmas_free_and_hold() -> None:
    own = prior_sigmas({"bow_mm": 2.0, "a_mm": 0.0})
    assert own[NAMES.index("bow_mm")] == 2.0
    assert own[NAMES.index("a_mm")] == 0.0
    assert own[NAMES.index("k1")] == 0.0
    assert own[NAMES.index("b_mm")] > 0
    with pytest.raises(ValueError, match="radius_mm is not a parameter"):
        prior_sigmas({"radius_mm": 1.0})
    with pytest.raises(ValueError, match="a_mm: a sigma"):
        prior_sigmas({"a_mm": -1.0})


def test_camera_over_the_screen_is_refused() -> None:
    optics = OPTICS.model_copy(
        update={"geometry": GeometryConfig(a_mm=2000.0, b_mm=2500.0, alpha_deg=90.0)}
    )
    with pytest.raises(ValueError, match="in line with the vertex"):
        poses_at(Geometry.from_config(optics), np.zeros(len(NAMES)) + 0j)


def test_rim_harmonics_are_those_of_the_surface() -> None:
    theta = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    height = SURFACE.height(500 * np.cos(theta), 500 * np.sin(theta))
    mean, *waves = rim_harmonics() @ SURFACE.parameters
    series = mean + sum(
        waves[m - 1] * np.cos(m * theta) + waves[m + 6] * np.sin(m * theta)
        for m in range(1, len(waves) // 2 + 1)
    )
    assert np.allclose(series, height, atol=1e-10)


def test_averaged_points_give_the_result_of_the_bins() -> None:
    truth = make(np.zeros(len(NAMES)), seed=2, points=20_000)
    phases, bench = truth.sets[2], BenchGeometry(STATED)
    state = SetState(SURFACE, 0.0)
    few = average_points(bench, phases, state, 1000)
    assert 700 < few.column_px.size < 1600
    # all the information is kept, and so is the residual's mean
    assert np.sum(1 / few.sigma_mm**2) == pytest.approx(np.sum(1 / phases.sigma_mm**2), rel=0.2)
    left = residual_mm(bench, phases, SURFACE, 0.0)
    mean = np.average(residual_mm(bench, few, SURFACE, 0.0), axis=1, weights=1 / few.sigma_mm**2)
    assert np.allclose(mean, left.mean(axis=1), atol=0.3 * left.std())


def test_optical_parameters_come_before_the_laser() -> None:
    assert NAMES[OPTICAL:] == ("laser_relative",)
