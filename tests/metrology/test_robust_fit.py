"""Dust, glints and a wrinkled edge against the fit."""

from __future__ import annotations

import numpy as np
import pytest
from metrology_truth import OPTICS, RADIUS_MM, SMALL, TrueFilm, look, pixel_grid

from membrane_ctrl.metrology.geometry import Geometry
from membrane_ctrl.metrology.reconstruct import Points, Tracer, parabola, solve
from membrane_ctrl.metrology.robust import Loss, robust_sigma, robust_weights, solve_robust

GEOMETRY = Geometry.from_config(OPTICS)
TRACER = Tracer(GEOMETRY, RADIUS_MM)
FILM = TrueFilm(37.1, {5: 1.0, 8: -0.8})
SEEN = look(GEOMETRY, FILM, *pixel_grid(SMALL, 3))


def _dirty(rng: np.random.Generator) -> Points:
    """20 um of noise on the screen, 3 % of the points up to 20 mm off to one side, all in one corner."""
    screen = SEEN.screen_mm + rng.normal(0, 0.02, SEEN.screen_mm.shape)
    corner = np.flatnonzero((SEEN.film_mm[0] > 150) & (SEEN.film_mm[1] > 150))
    bad = rng.choice(corner, round(0.03 * screen.shape[1]), replace=False)
    screen[:, bad] += rng.uniform(2, 20, bad.size)
    return Points.of(SEEN.rays, screen)


def _error_um(points: Points, loss: Loss | None) -> float:
    fit = solve(TRACER, points, parabola(40.0, RADIUS_MM))
    if loss is not None:
        fit = solve_robust(TRACER, points, fit, loss)
    assert fit.converged
    x, y = SEEN.film_mm[:2]
    return float(1e3 * np.sqrt(np.mean((fit.surface.height(x, y) - FILM.height(x, y)) ** 2)))


@pytest.mark.parametrize(("loss", "gain"), [("huber", 20), ("tukey", 200)])
def test_outliers_lose_their_pull(loss: Loss, gain: float) -> None:
    plain = _error_um(_dirty(np.random.default_rng(1)), None)
    assert _error_um(_dirty(np.random.default_rng(1)), loss) < plain / gain


def test_clean_points_lose_little_by_it() -> None:
    errors = []
    for loss in (None, "tukey"):
        rng = np.random.default_rng(2)
        points = Points.of(SEEN.rays, SEEN.screen_mm + rng.normal(0, 0.02, SEEN.screen_mm.shape))
        errors.append(_error_um(points, loss))  # type: ignore[arg-type]
    assert errors[1] < 1.3 * errors[0]


def test_points_left_out_stay_out() -> None:
    points = _dirty(np.random.default_rng(3))
    points.weights[::7] = 0
    solve_robust(TRACER, points, solve(TRACER, points, parabola(40.0, RADIUS_MM)))
    assert not points.weights[::7].any()


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_weights_fall_with_the_residual(loss: Loss) -> None:
    rng = np.random.default_rng(4)
    residual = rng.normal(0, 1e-5, (2, 4000))
    assert robust_sigma(residual) == pytest.approx(1e-5, rel=0.05)
    residual[:, 0] = 1e-3
    weights = robust_weights(residual, loss)
    order = np.argsort(np.hypot(*residual))
    assert np.all(np.diff(weights[order]) <= 0)
    assert weights[order[0]] == pytest.approx(1, abs=1e-3)
    assert weights[0] < 0.02
