"""The scalars of a run and the image of a star, from figures in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.review.report.figures import draw_scalars
from membrane_ctrl.review.statistics.held_scalars import HeldSeries, review_scalars
from tests.worlds.changing_film import figure_change
from tests.worlds.synthetic_shape import from_estimates, shape_at

BOWL_UM = 37_100.0 * zernike_projection()
COVARIANCE = 0.01**2 * np.eye(ZERNIKE_TERMS)


def series_of(config: Config, count: int = 6) -> HeldSeries | None:
    """A film whose spherical aberration grows by 0.3 µm a cycle, the last cycle rejected."""
    figures = [
        replace(
            shape_at(10.0 * (number + 1)),
            coeffs_um=BOWL_UM + figure_change(0.3 * number),
            hencky_um=37_100.0,
            covariance_um2=COVARIANCE,
            verdict="rejected" if number == count - 1 else "ok",
        )
        for number in range(count)
    ]
    return review_scalars(from_estimates(figures), np.ones(count, dtype=bool), config)


def test_the_series_shows_what_grows() -> None:
    series = series_of(Config())
    assert series is not None
    assert series.holds == "vertex"
    assert series.values_of("vertex_um") == pytest.approx(np.zeros(5), abs=1e-9)
    focus_um = 1e3 * series.values_of("focus_mm")
    assert abs(focus_um[-1] - focus_um[0]) == pytest.approx(1.2 * 62.0, rel=0.02)
    assert series.values_of("rms_um")[-1] == pytest.approx(1.2 * 0.88, rel=0.05)
    assert np.all(series.values_of("least_rms_um") <= series.values_of("rms_um"))


def test_the_image_has_error_bars_and_is_drawn() -> None:
    series = series_of(Config())
    assert series is not None
    assert series.image is not None
    assert series.image.resolved
    assert 0.0 < series.strehl_sigma < 0.01
    assert series.radius_80_sigma_um < 0.1 * series.image.radius_80_um
    assert 0.999 < series.change_strehl < 1.0
    assert "Image of a star at 1000" in draw_scalars(series)


def test_a_stored_figure_is_the_reference() -> None:
    stored = tuple((BOWL_UM + figure_change(0.6)).tolist())
    series = series_of(Config(loop=LoopConfig(holds="best_fit", reference_figure_um=stored)))
    assert series is not None
    assert series.stored_reference
    rms_um = series.values_of("rms_um")
    assert int(np.argmin(rms_um)) == 2
    assert rms_um[2] < 0.05


def test_two_cycles_are_no_series() -> None:
    assert series_of(Config(), count=3) is None
