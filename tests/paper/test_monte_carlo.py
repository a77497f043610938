"""The Monte Carlo of the height: what a wrong angle does in each reading, and its verdicts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.paper import monte_carlo_part
from membrane_ctrl.paper.comparison import Agreement
from membrane_ctrl.paper.monte_carlo_part import AngleReading, TrialInputs, run_trials
from membrane_ctrl.paper.reference_iteration import POWERS, PolynomialSurface, predict_seen
from membrane_ctrl.paper.reference_pmd import PaperGeometry

BENCH = PaperGeometry(2672.0, 2871.0, math.radians(80.9))
X_SQUARED, Y_SQUARED = POWERS.index((2, 0)), POWERS.index((0, 2))


def make_inputs(sigmas: tuple[float, float, float], screen_sigma_mm: float = 0.0) -> TrialInputs:
    """A paraboloid of 34 mm, seen by rays to even points of a disc of 475 mm."""
    random = np.random.default_rng(4)
    radius_mm = 475.0 * np.sqrt(random.random(400))
    angle_rad = 2 * np.pi * random.random(400)
    x_mm, y_mm = radius_mm * np.cos(angle_rad), radius_mm * np.sin(angle_rad)
    coeffs_mm = np.zeros(len(POWERS))
    coeffs_mm[[X_SQUARED, Y_SQUARED]] = 34.0
    film = PolynomialSurface(coeffs_mm, 500.0)
    rays = np.stack([x_mm, y_mm, film.height_mm(x_mm, y_mm)]) - BENCH.pinhole_mm[:, None]
    seen = predict_seen(BENCH, rays / np.linalg.norm(rays, axis=0), film)
    return TrialInputs(seen, film, BENCH, sigmas, screen_sigma_mm, 475.0, 1)


def curvature_changes_um() -> dict[AngleReading, FloatArray]:
    """Changes of the coefficients of x^2 and y^2 by one wrong angle."""
    inputs = make_inputs((0.0, 0.0, math.radians(0.3)))
    (trial,) = run_trials(inputs, [0])
    changes_um = 1e3 * (trial - inputs.nominal.coeffs_mm)[:, [X_SQUARED, Y_SQUARED]]
    # by the sign of the change in x
    return {
        reading: change * np.sign(change[0])
        for reading, change in zip(AngleReading, changes_um, strict=True)
    }


def test_a_wrong_angle_acts_in_y_as_each_reading_has_it() -> None:
    changes = curvature_changes_um()
    for reading in (AngleReading.PIXEL_RAYS, AngleReading.FIXED_POINTS):
        x_um, y_um = changes[reading]
        assert y_um < -0.5 * x_um
    x_um, y_um = changes[AngleReading.ANGLE_IN_X]
    assert abs(y_um) < 0.05 * x_um
    x_um, y_um = changes[AngleReading.ANGLE_AS_IN_X]
    assert y_um == pytest.approx(x_um, rel=0.1)


def test_exact_readings_agree_with_bisectors_of_rays() -> None:
    """With a wrong distance a, normals are bisectors of the rays to camera and screen."""
    inputs = make_inputs((2.0, 0.0, 0.0))
    (trial,) = run_trials(inputs, [0])
    error_mm = 2.0 * np.random.default_rng((1, 0)).standard_normal(3)[0]
    wrong = PaperGeometry(BENCH.a_mm + error_mm, BENCH.b_mm, BENCH.alpha_rad)
    found = PolynomialSurface(trial[list(AngleReading).index(AngleReading.PIXEL_RAYS)], 500.0)
    # the surface that is found shows the wrong bench what the true one shows the true bench
    shown = predict_seen(wrong, inputs.seen.rays, found)
    np.testing.assert_allclose(shown.screen_mm, inputs.seen.screen_mm, atol=0.02)


def test_the_scatter_of_trials_does_not_decide_a_verdict() -> None:
    lucky_um, expected_um = np.array([24.8]), np.array([18.7])
    compare = monte_carlo_part.compare_with_paper
    row = compare(AngleReading.ANGLE_AS_IN_X, lucky_um, expected_um, 100)
    assert row.agreement is Agreement.DIFFERS
    assert "scatters by 7 %; without scatter 18.7" in row.note
    assert compare(AngleReading.PIXEL_RAYS, expected_um, lucky_um, 2).agreement is (
        Agreement.REPRODUCED
    )


def test_a_pair_shares_its_geometry_and_has_noise_of_its_own() -> None:
    to_height = np.eye(len(POWERS))[[X_SQUARED, Y_SQUARED]]
    by_geometry_um = monte_carlo_part.compute_pair_rmse_um(
        make_inputs((2.0, 2.0, math.radians(0.3))), to_height, 10
    )
    assert np.max(by_geometry_um) < 0.05  # of 10 µm; a single height has 25 µm
    noisy = make_inputs((0.0, 0.0, 0.0), 0.1)
    heights_mm = run_trials(noisy, range(10))[:, 0] @ to_height.T
    single_um = 1e3 * np.std(heights_mm, axis=0, ddof=1)
    pair_um = monte_carlo_part.compute_pair_rmse_um(noisy, to_height, 10)
    assert np.all((pair_um > 0.7 * single_um) & (pair_um < 2.6 * single_um))
