"""Verdicts on motions, by draws of noise on benches whose signatures are traced.

The error of a figure is known here: the noise and the planted motion are linear in the screen
points. `test_cycle_motion` and `test_tracked_motions` do the same with rendered frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.config.optics import GeometryConfig, OpticsConfig
from membrane_ctrl.metrology.rays import bench_motions
from membrane_ctrl.metrology.rays.bench_motions import GROUPS, MotionGroup, group_columns
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface, parameter_to_coeffs
from membrane_ctrl.metrology.uncertainty.motion_evidence import (
    MotionEffects,
    MotionFinding,
    MotionTest,
    SlopeEvidence,
    find_motion_doubt,
    ring_tilt,
)
from membrane_ctrl.metrology.uncertainty.tilt_causes import find_tilt_causes

Array = NDArray[np.float64]
GRID = 40  # points along the picture
STEP_MM = 0.01
LOUD_UM, QUIET_UM = 0.1, 0.02  # noise of a figure, RMS without tilt
FIGURE = slice(3, None)  # of the terms: from defocus on
BENCHES = [(2672.0, 2871.0, 80.9, 37.1), (2750.0, 2871.0, 83.0, 37.1), (2672.0, 2800.0, 79.5, 36.0)]


def factor(covariance: Array) -> Array:
    """Matrix F with F F^T = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


@dataclass(frozen=True)
class Bench:
    """Signatures of a bench, and the noise of its figures.

    Attributes
    ----------
    effects : MotionEffects
    own_mm2 : (parameters, parameters) array
        Covariance of a figure.
    slopes : SlopeEvidence
        Of the difference of two figures.
    """

    effects: MotionEffects
    own_mm2: Array
    slopes: SlopeEvidence

    @classmethod
    def of(cls, geometry: tuple[float, float, float, float], noise_um: float) -> Bench:
        """A bench whose figure has a noise of `noise_um` RMS without tilt."""
        a_mm, b_mm, alpha_deg, sag_mm = geometry
        optics = OpticsConfig(geometry=GeometryConfig(a_mm=a_mm, b_mm=b_mm, alpha_deg=alpha_deg))
        stated = Geometry.from_config(optics)
        tracer = Tracer(stated, optics.mirror.radius_mm, 0.0)
        surface = Surface.hencky_bowl(sag_mm, optics.mirror.radius_mm)
        column, row = np.meshgrid(
            np.linspace(0, optics.camera.width_px - 1, GRID),
            np.linspace(0, optics.camera.height_px - 1, GRID),
        )
        rays = stated.rays(column.ravel(), row.ravel())
        place_mm = stated.pinhole_mm[:, None] - stated.pinhole_mm[2] / rays[2] * rays
        rays = rays[:, np.hypot(*place_mm[:2]) < 0.9 * optics.mirror.radius_mm]
        points = Points.from_rays(rays, np.zeros((2, rays.shape[1])))
        tracer.place_on_shape(points, surface.height)
        tracer.intersect(points, surface, newton=5)
        half_mm = optics.pattern.periods * optics.pattern.period_mm / 2
        screen_mm = tracer.predict_screen(points, surface)
        points = points.subset(np.abs(screen_mm).max(axis=0) < half_mm)

        columns = []
        for step_mm in STEP_MM * np.eye(PARAMETERS):
            ends = []
            for sign in (1, -1):
                moved = Surface.from_parameters(
                    surface.parameters + sign * step_mm, surface.radius_mm
                )
                tracer.intersect(points, moved, newton=3)
                ends.append(tracer.predict_screen(points, moved))
            columns.append((ends[0] - ends[1]) / (2 * STEP_MM))
        jacobian = np.stack(columns, axis=1)
        tracer.intersect(points, surface, newton=3)
        changes = bench_motions.screen_changes(stated, points.rays, points.t_mm, surface, 0.0)
        weights = np.ones((2, points.t_mm.size))
        effects = MotionEffects.from_changes(changes, jacobian, weights)

        own = np.linalg.inv(np.einsum("apn,aqn->pq", jacobian, jacobian))
        scale = (1e-3 * noise_um) ** 2 / np.trace(own[2:, 2:])
        gram = effects.gram(weights)
        return cls(effects, scale * own, SlopeEvidence(2 * scale * gram, gram))

    def draw(self, motion: Array, rng: np.random.Generator) -> tuple[MotionFinding, str, Array]:
        """A later figure after a motion (components,): what is found, the doubt, and the errors of
        its terms in sigmas.
        """
        change_mm2 = 2 * self.own_mm2
        moved_mm = factor(change_mm2) @ rng.standard_normal(PARAMETERS)
        moved_mm += self.effects.figure_mm @ motion
        left = factor(self.slopes.covariance) @ rng.standard_normal(motion.size)
        left += self.slopes.gram @ motion
        ring = ring_tilt()
        test = MotionTest(self.effects, ring @ change_mm2 @ ring.T, self.slopes, None)
        found = test.find_motions(ring @ moved_mm, np.zeros(2), left)
        doubt = find_motion_doubt(found, self.own_mm2, math.hypot(*(ring @ moved_mm)))
        to_coeffs = parameter_to_coeffs()
        covariance_mm2 = to_coeffs @ (change_mm2 + found.covariance_mm2) @ to_coeffs.T
        errors = (to_coeffs @ moved_mm) / np.sqrt(np.diag(covariance_mm2))
        return found, doubt, errors[FIGURE]

    def draw_change(self, motion: Array, rng: np.random.Generator) -> Array:
        """A later set after a motion (components,): errors of the change's terms in sigmas, by the
        causes of the ring's tilt.
        """
        change_mm2 = 2 * self.own_mm2
        moved_mm = factor(change_mm2) @ rng.standard_normal(PARAMETERS)
        moved_mm += self.effects.figure_mm @ motion
        ring = ring_tilt()
        tilt_mm2 = ring @ change_mm2 @ ring.T
        causes = find_tilt_causes(self.effects.figure_mm, ring, ring @ moved_mm, tilt_mm2)
        by_motion_mm2 = causes.knocked_mm2 + causes.allowed_mm2
        to_coeffs = parameter_to_coeffs()
        covariance_mm2 = to_coeffs @ (change_mm2 + by_motion_mm2) @ to_coeffs.T
        return np.asarray((to_coeffs @ moved_mm / np.sqrt(np.diag(covariance_mm2)))[FIGURE])


@pytest.fixture(scope="module")
def benches() -> list[Bench]:
    return [Bench.of(geometry, LOUD_UM) for geometry in BENCHES]


@pytest.fixture(scope="module")
def quiet_benches() -> list[Bench]:
    return [Bench.of(geometry, QUIET_UM) for geometry in BENCHES]


def test_a_bench_at_rest_is_doubted_in_at_most_one_of_a_thousand_figures(
    benches: list[Bench],
) -> None:
    """With a gain of 4 for each component as the limit, 1 of 100 on the first two benches."""
    rng = np.random.default_rng(1)
    none = np.zeros(bench_motions.COMPONENTS)
    doubts = [bench.draw(none, rng)[1] for bench in benches for _ in range(500)]
    assert sum(map(bool, doubts)) <= 2


def moved_by(group: MotionGroup, columns: slice, size: float, rng: np.random.Generator) -> Array:
    direction = rng.standard_normal(group.components)
    motion = np.zeros(bench_motions.COMPONENTS)
    motion[columns] = size * direction / np.linalg.norm(direction)
    return motion


# The tilt of the mirror is no error: the film has moved with it.
@pytest.mark.parametrize(
    "number",
    [k for k, group in enumerate(GROUPS) if not group.is_of_mirror and not group.is_hidden],
)
def test_a_motion_is_in_the_bars_or_doubted(quiet_benches: list[Bench], number: int) -> None:
    group, columns = GROUPS[number], group_columns()[number]
    rng = np.random.default_rng(number)
    for bench in quiet_benches:
        for size in 10.0 ** np.arange(-0.5, 3.1, 0.5):
            motion = moved_by(group, columns, size, rng)
            for _ in range(8):
                _, doubt, errors = bench.draw(motion, rng)
                # 1 of 15,000 values is beyond 4 sigma; 2400 are compared.
                assert doubt or np.abs(errors).max() < 4.5, (group.name, size)


@pytest.mark.parametrize("number", [2, 12])
def test_a_motion_that_noise_hides_is_in_the_bars(benches: list[Bench], number: int) -> None:
    """A camera or picture that turned by 18 to 30 µrad was up to 6 sigma off in an `ok` figure."""
    group, columns = GROUPS[number], group_columns()[number]
    rng = np.random.default_rng(number)
    for size in (15.0, 20.0, 25.0, 30.0):
        for _ in range(8):
            _, doubt, errors = benches[0].draw(moved_by(group, columns, size, rng), rng)
            assert doubt or np.abs(errors).max() < 4.5, size


@pytest.mark.parametrize("number", [0, 2, 8, 12])
def test_a_large_motion_is_doubted(benches: list[Bench], number: int) -> None:
    group, columns = GROUPS[number], group_columns()[number]
    rng = np.random.default_rng(number)
    for bench in benches:
        found, doubt, _ = bench.draw(moved_by(group, columns, 100.0, rng), rng)
        assert found.is_beyond_chance
        assert "moved" in doubt or "knocked" in doubt


def test_bars_of_a_change_are_as_wide_as_motions_within_the_allowances(
    quiet_benches: list[Bench],
) -> None:
    """With the worst body as the only cause, they were up to 1.8 times as wide; and if two bodies
    had tilted the ring in opposite directions, 3.7 sigma too narrow.
    """
    allowances = np.zeros(bench_motions.COMPONENTS)
    for group, columns in zip(GROUPS, group_columns(), strict=True):
        allowances[columns] = group.allowance
    rng = np.random.default_rng(3)
    for bench in quiet_benches[:2]:
        errors = np.array(
            [
                bench.draw_change(allowances * rng.standard_normal(allowances.size), rng)
                for _ in range(250)
            ]
        )
        assert 0.93 < np.mean(np.abs(errors) < 1.96) < 0.97
        rms = np.sqrt(np.mean(errors**2, axis=0))
        assert rms.min() > 0.8
        assert rms.max() < 1.2


@pytest.mark.parametrize("number", [0, 2, 4, 6, 8, 12])
def test_a_knock_between_two_sets_is_in_the_bars_of_their_change(
    quiet_benches: list[Bench], number: int
) -> None:
    group, columns = GROUPS[number], group_columns()[number]
    rng = np.random.default_rng(number)
    errors = [
        bench.draw_change(moved_by(group, columns, 150.0, rng), rng)
        for bench in quiet_benches
        for _ in range(8)
    ]
    assert np.abs(errors).max() < 5.0
