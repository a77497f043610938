"""Rows and signatures of a bench against formulas that are written here."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.frame_checks.phase_drift import PhaseShifts
from membrane_ctrl.metrology.frame_checks.picture_blur import estimate_blur_px, phase_gradients
from membrane_ctrl.metrology.rays import bench_motions
from membrane_ctrl.metrology.rays.bench_motions import group_columns
from membrane_ctrl.metrology.rays.geometry import Geometry, project_points
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.reconstruction.zonal_map import ResidualGrid
from membrane_ctrl.metrology.uncertainty.cycle_errors import LiveErrors
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.image_blur import blur_source
from membrane_ctrl.metrology.uncertainty.motion_evidence import ring_tilt_urad
from membrane_ctrl.metrology.uncertainty.pair_motion import PairMotion, motion_changes
from membrane_ctrl.metrology.uncertainty.phase_drift_error import phase_drift_source
from membrane_ctrl.metrology.uncertainty.residual_patches import Patches
from membrane_ctrl.metrology.uncertainty.response_wave_error import estimate_response_waves
from membrane_ctrl.metrology.uncertainty.rim_check import measure_rim_misfit
from membrane_ctrl.metrology.uncertainty.set_budget import _vertex_source
from membrane_ctrl.metrology.uncertainty.slope_misfit import measure_curl_urad
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench, moves_mm, predicted_mm
from membrane_ctrl.metrology.uncertainty.unseen_motion import estimate_unseen_motion
from tests.support.metrology_truth import RADIUS_MM

Array = NDArray[np.float64]
CAMERA = CameraConfig(width_px=306, height_px=256, pixel_um=3.45 * 8)
OPTICS = OpticsConfig(camera=CAMERA)
PARAMETERS = Surface.hencky_bowl(37.1, RADIUS_MM).parameters.copy()
PARAMETERS[[4, 7, 20]] += (0.8, -0.5, 0.05)
FILM = Surface.from_parameters(PARAMETERS, RADIUS_MM)


@pytest.fixture(scope="module")
def bench() -> TrialBench:
    geometry = Geometry.from_config(OPTICS)
    tracer = Tracer(geometry, RADIUS_MM)
    column, row = np.meshgrid(np.arange(0, 306, 4.0), np.arange(0, 256, 4.0))
    places_px = np.stack([column.ravel(), row.ravel()])
    rays = geometry.rays(*places_px)
    on_plane_mm = geometry.pinhole_mm[:, None] - geometry.pinhole_mm[2] / rays[2] * rays
    near = np.hypot(*on_plane_mm[:2]) < 440.0
    points = Points.from_rays(rays[:, near], np.zeros((2, int(near.sum()))))
    tracer.place_on_shape(points, FILM.height)
    tracer.intersect(points, FILM, newton=3)
    points.screen_mm[:] = tracer.predict_screen(points, FILM)
    exact = np.zeros(points.screen_mm.shape)
    return TrialBench.from_points(OPTICS, tracer, FILM, points, places_px[:, near], exact, 10_000)


def test_the_row_of_the_blur_is_the_error_of_blurred_phases(bench: TrialBench) -> None:
    """The mean over a Gaussian by quadrature with 7 x 7 nodes."""
    sigma_px = 1.5
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    weights = weights / weights.sum()
    nominal = bench.geometry()
    mean_mm = np.zeros_like(bench.screen_mm)
    for right, of_right in zip(nodes, weights, strict=True):
        for down, of_down in zip(nodes, weights, strict=True):
            moved = TrialBench(
                **vars(bench)
                | {
                    "column_px": bench.column_px + sigma_px * right,
                    "row_px": bench.row_px + sigma_px * down,
                }
            )
            mean_mm += of_right * of_down * predicted_mm(moved, nominal, FILM)
    expected = bench.solve(nominal, mean_mm - bench.screen_mm) - FILM.parameters
    found = blur_source(bench, sigma_px).effects_mm[:, 0]
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)
    assert np.linalg.norm(expected) > 1e-4


@pytest.mark.parametrize("sigma_px", [0.0, 0.8, 2.0])
def test_a_blur_is_found_by_the_swings_of_its_fringes(sigma_px: float) -> None:
    rows, columns = 60, 80
    row, column = np.mgrid[:rows, :columns].astype(float)
    bin_px = 4
    # Fringes that are finer on one side: rad per pixel is a quarter of that per bin.
    phases = np.stack([0.01 * column**2, 0.3 * row + 0.004 * row * column])
    squares = [np.sum(np.square(np.gradient(phase)), axis=0) / bin_px**2 for phase in phases]
    variance = sigma_px**2 + (bin_px**2 - 1) / 12
    swings = np.stack([90.0 * np.exp(-variance * square / 2).ravel() for square in squares])
    index = np.arange(rows * columns)
    gradients = phase_gradients(phases.reshape(2, -1), index, (rows, columns), bin_px)
    found = estimate_blur_px(gradients, swings, bin_px)
    assert found == pytest.approx(sigma_px, abs=1e-3)


def test_signatures_of_a_pair_are_the_changes_of_the_fitted_surface(bench: TrialBench) -> None:
    """A motion of 10 µm or µrad, and the fit to the screen points after it."""
    signatures = PairMotion.from_changes(bench, motion_changes(bench)).effects.figure_mm
    geometry = bench.geometry().geometry
    rays = geometry.rays(bench.column_px, bench.row_px)
    changes = bench_motions.screen_changes(geometry, rays, bench.t_mm, FILM, 0.0)
    for columns in group_columns():
        for k in range(columns.start, columns.stop):
            after = bench.solve(bench.geometry(), 10.0 * changes[k])
            moved_mm = (after - FILM.parameters) / 10.0
            size = np.linalg.norm(moved_mm)
            assert np.linalg.norm(signatures[:, k] - moved_mm) < 0.02 * size + 1e-12


def test_the_tilt_of_the_ring_is_that_of_a_plane() -> None:
    plane = PARAMETERS.copy()
    plane[:2] += np.array([3e-3, -4e-3])  # mm RMS of Z2 and Z3, which are 2 r cos and 2 r sin
    later = Surface.from_parameters(plane, RADIUS_MM)
    rim_mm = np.array([later.height(RADIUS_MM, 0.0) - FILM.height(RADIUS_MM, 0.0)])
    beside_mm = np.array([later.height(0.0, RADIUS_MM) - FILM.height(0.0, RADIUS_MM)])
    expected_urad = 1e6 * float(np.hypot(rim_mm, beside_mm)[0]) / RADIUS_MM
    assert ring_tilt_urad(FILM, later) == pytest.approx(expected_urad, rel=1e-9)
    assert expected_urad == pytest.approx(20.0, rel=0.01)
    assert ring_tilt_urad(later, later) == 0.0


def test_points_are_averaged_in_patches_of_a_fortieth_of_the_square() -> None:
    """Reach 400 mm: patches of 20 mm, counted row by row from the corner."""
    places_mm = np.array([[-395.0, -385.0, 5.0, 5.0], [-395.0, -395.0, 25.0, 35.0]])
    count = np.array([1.0, 3.0, 2.0, 2.0])
    slopes = np.array([[4.0, 8.0, 1.0, 3.0], [0.0, 4.0, -1.0, -1.0]])
    found = Patches.from_points(places_mm, count, slopes, 400.0)
    corner, middle = 0, 21 * 40 + 20
    assert np.flatnonzero(found.count).tolist() == [corner, middle]
    assert found.count[[corner, middle]].tolist() == [4.0, 4.0]
    assert found.slopes[:, corner].tolist() == [7.0, 3.0]
    assert found.slopes[:, middle].tolist() == [2.0, -1.0]
    assert found.places_mm[:, corner].tolist() == [-387.5, -395.0]
    assert found.places_mm[:, middle].tolist() == [5.0, 30.0]


def grid_of(slope_x: Array, slope_y: Array, axis_mm: Array) -> ResidualGrid:
    return ResidualGrid(axis_mm, slope_x, slope_y, np.ones_like(slope_x))


def test_slopes_of_a_height_have_no_curl_and_those_of_a_whirl_have_their_size() -> None:
    axis_mm = np.linspace(-450, 450, 241)
    x, y = np.meshgrid(axis_mm, axis_mm)
    height_mm = 1e-7 * x**2 - 2e-7 * x * y
    of_height = grid_of(2e-7 * x - 2e-7 * y, -2e-7 * x, axis_mm)
    assert measure_curl_urad(of_height, height_mm) < 1e-6
    turn = 2e-8  # rad per mm
    whirl = grid_of(-turn * y, turn * x, axis_mm)
    expected_urad = 1e6 * turn * 900 / np.sqrt(12)
    assert measure_curl_urad(whirl, np.zeros_like(x)) == pytest.approx(expected_urad, rel=0.02)


def test_noise_of_cells_is_averaged_over_patches() -> None:
    """40 patches along a side of 240 cells: 36 cells each."""
    rng = np.random.default_rng(1)
    axis_mm = np.linspace(-450, 450, 241)
    shape = (241, 241)
    noise = grid_of(1e-6 * rng.standard_normal(shape), 1e-6 * rng.standard_normal(shape), axis_mm)
    # A slope between two cells is their mean; that of a patch counts its cells once.
    assert measure_curl_urad(noise, np.zeros(shape)) == pytest.approx(1 / 6, rel=0.1)


def waving(bench: TrialBench, amplitude_mm: float, noise_mm: float) -> tuple[TrialBench, Array]:
    """The bench with waves of four times the fringes' phase in x, and its waves (2, n)."""
    phase_rad = bench.screen_mm[0] * 2 * np.pi / OPTICS.pattern.period_mm
    waves_mm = np.stack([amplitude_mm * np.cos(4 * phase_rad + 0.3), np.zeros(phase_rad.size)])
    solved = bench.solve(bench.geometry(), waves_mm, linear=True)
    there = Surface.from_parameters(solved, RADIUS_MM)
    taken_mm = predicted_mm(bench, bench.geometry(), there) - bench.screen_mm
    noise = noise_mm * np.random.default_rng(1).standard_normal(waves_mm.shape)
    return replace(bench, residual_mm=waves_mm - taken_mm + noise), waves_mm


def test_waves_of_a_response_have_the_effect_that_the_fit_takes_of_them(bench: TrialBench) -> None:
    waved, waves_mm = waving(bench, 0.02, 0.002)
    found = estimate_response_waves(waved, steps=4)
    expected_mm = bench.solve(bench.geometry(), waves_mm, linear=True) - FILM.parameters
    effects_mm = found.source.effects_mm
    assert np.linalg.norm(effects_mm[:, 0] - expected_mm) < 0.05 * np.linalg.norm(expected_mm)
    assert np.linalg.norm(effects_mm[:, 1]) < 0.05 * np.linalg.norm(expected_mm)
    assert found.share == pytest.approx(1 - 0.002**2 * 2 / (0.02**2 / 2), abs=0.02)


def test_noise_has_no_waves_beyond_chance(bench: TrialBench) -> None:
    waved, _ = waving(bench, 0.0, 0.002)
    found = estimate_response_waves(waved, steps=4)
    assert found.share < 0.01


CAMERA_TURN = next(k for k, group in enumerate(bench_motions.GROUPS) if "turned" in group.name)


def drift_of(bench: TrialBench, changes_mm: Array, film_rad: float = 0.0) -> list[PhaseShifts]:
    """Shifts of four frames of x and four of y, 8 frames later, during steady changes (2, n)."""
    mm_per_rad = OPTICS.pattern.period_mm / (2 * np.pi)
    found = []
    for axis, moves in enumerate(moves_mm(bench)):
        design = np.stack([np.ones_like(moves), moves - moves.mean()], axis=1)
        shift_mm = np.linalg.lstsq(design, changes_mm[axis], rcond=None)[0][0]
        frames = 8.0 * axis + np.arange(4.0)
        shift_rad = frames * shift_mm / mm_per_rad
        found.append(PhaseShifts(frames, shift_rad, film_rad, np.zeros((4, 1))))
    return found


def test_the_row_of_a_drift_contains_the_camera_that_turns(bench: TrialBench) -> None:
    """1.5 µrad a frame of yaw: x is taken 4 frames before the middle, y 4 frames after."""
    changes_mm = motion_changes(bench)
    turned_mm = 1.5 * changes_mm[group_columns()[CAMERA_TURN]][1]
    x, y = drift_of(bench, turned_mm)
    source = phase_drift_source(bench, changes_mm, (x, y))
    off_mm = turned_mm * np.array([[-4.0], [4.0]])
    expected_mm = bench.solve(bench.geometry(), off_mm, linear=True) - FILM.parameters
    bodies = np.linalg.norm(source.effects_mm, axis=0) > 0
    effects_mm = source.effects_mm * np.sqrt(np.count_nonzero(bodies))
    away = np.linalg.norm(effects_mm - expected_mm[:, None], axis=0)
    assert away.min() < 1e-3 * np.linalg.norm(expected_mm)


def test_a_drift_that_the_film_explains_is_none(bench: TrialBench) -> None:
    changes_mm = motion_changes(bench)
    x, y = drift_of(bench, changes_mm[group_columns()[CAMERA_TURN]][0], film_rad=1.0)
    assert not phase_drift_source(bench, changes_mm, (x, y)).known_mm.any()


def test_a_drift_that_scatters_over_the_picture_is_stated_beyond_its_scatter(
    bench: TrialBench,
) -> None:
    """Twice the scatter explains half of the drift's square: half of its effects' is left."""
    changes_mm = motion_changes(bench)
    x, y = drift_of(bench, changes_mm[group_columns()[CAMERA_TURN]][0])
    sure = phase_drift_source(bench, changes_mm, (x, y)).known_mm
    drift_rad2 = x.drift_rad**2 + y.drift_rad**2
    of_patch_rad = x.frames[:, None] * math.sqrt(drift_rad2 / 8)
    scattered = phase_drift_source(bench, changes_mm, (replace(x, patches_rad=of_patch_rad), y))
    assert np.sum(scattered.known_mm**2) == pytest.approx(np.sum(sure**2) / 2, rel=1e-6)


def test_the_vertex_without_a_laser_may_have_moved_by_half_the_motion(bench: TrialBench) -> None:
    checked: Any = SimpleNamespace(stack=SimpleNamespace(readings_um=np.full(8, np.nan)))
    source = _vertex_source(bench, SigmasConfig(), checked, 30.0)
    assert source.sigma == pytest.approx(math.hypot(20.0, 15.0))


def test_the_correction_of_cycles_is_as_wrong_as_the_sensitivity_of_the_bench(
    bench: TrialBench,
) -> None:
    """A focal length 1 % off: per µm that the film is deeper in x than in y."""
    spread = GeometrySpread(("focal_relative",), np.array([[0.01**2]]))
    shifts_rad = np.tile(np.pi / 2 * np.arange(4), (2, 1))
    seen: Any = SimpleNamespace(harmonics=np.zeros((2, 2)))
    none = np.zeros((PARAMETERS.size, 0))
    light = np.ones_like(bench.screen_mm)
    found = LiveErrors.from_benches(bench, bench, shifts_rad, light, seen, spread, 0.0, none)
    off_mm = moves_mm(bench, bench.geometry(("focal_relative",), [0.01])) - moves_mm(bench)
    half_mm = off_mm * np.array([[0.5], [-0.5]])
    expected_mm = bench.solve(bench.geometry(), half_mm, linear=True) - FILM.parameters
    size_mm = math.sqrt(float(np.trace(found.corrected_um2)))
    assert size_mm == pytest.approx(float(np.linalg.norm(expected_mm)), rel=0.2)


def test_a_motion_from_x_to_y_is_found_with_the_sigma_of_its_noise(bench: TrialBench) -> None:
    """50 µm, in points with 10 µm of noise on the screen."""
    noise_mm = 0.01 * np.random.default_rng(1).standard_normal(bench.screen_mm.shape)
    moved_mm = 50.0 * moves_mm(bench) * np.array([[-0.5], [0.5]])
    off_mm = moved_mm + noise_mm
    nominal = bench.geometry()
    fitted = Surface.from_parameters(bench.solve(nominal, off_mm), RADIUS_MM)
    taken_mm = predicted_mm(bench, nominal, fitted) - bench.screen_mm
    moved = replace(bench, residual_mm=off_mm - taken_mm)
    spread = GeometrySpread(("focal_relative",), np.array([[1e-6**2]]))
    found = estimate_unseen_motion(moved, spread, np.full(2, 0.01**2))
    assert abs(found.moved_um - 50.0) < 4 * found.sigma_um
    assert found.noise_um == pytest.approx(found.sigma_um, rel=0.5)
    assert found.is_significant


def test_a_misfit_of_the_rim_is_in_sigmas_of_the_stated_geometry(bench: TrialBench) -> None:
    """The picture may be shifted by 4 px (1 sigma), and the ring is known to 1 mm; its size, to
    0.17 %.
    """
    theta = 2 * np.pi * np.arange(720) / 720
    height_mm = np.full(theta.size, bench.vertex_z_mm + FILM.sag_mm)
    rim_mm = np.stack([RADIUS_MM * np.cos(theta), RADIUS_MM * np.sin(theta), height_mm])
    rim_px = project_points(bench.geometry().geometry, rim_mm)
    radius_px = np.hypot(*(rim_px - rim_px.mean(axis=1)[:, None])).mean()
    spread = GeometrySpread(("principal_x_px",), np.array([[4.0**2]]))
    place_sigma_mm = math.hypot(4.0 * RADIUS_MM / radius_px, 1.0)

    shifted = measure_rim_misfit(bench, spread, Outline(rim_px, (0, 0), (0, 0), 40.0, 1.0))
    assert shifted.sigmas == pytest.approx(40.0 / place_sigma_mm, rel=1e-3)
    assert shifted.widening == pytest.approx(max(1.0, shifted.sigmas / 2))
    larger = measure_rim_misfit(bench, spread, Outline(rim_px, (0, 0), (0, 0), 0.0, 1.01))
    assert larger.sigmas == pytest.approx(0.01 / 0.0017, rel=0.02)
    assert larger.contradicts
