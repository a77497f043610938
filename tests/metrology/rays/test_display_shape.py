"""Screen shape and response curves."""

import numpy as np
import pytest

from tests.support.sofast_facet import DisplayResponse, MeasuredScreen, RectangularScreen


def test_a_rectangle_has_its_origin_in_the_middle_and_an_edge():
    screen = RectangularScreen(8000.0, 3000.0)
    out = screen.screen_mm(np.array([[0.5, 1.0, 1.01], [0.5, 0.0, 0.5]]))
    np.testing.assert_allclose(out[:, :2], [[0, 4000], [0, -1500]])
    assert np.isnan(out[0, 2])


def test_measured_points_are_met_and_lines_between_them_straight():
    points = np.stack(np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 4))).reshape(2, -1)
    skewed = np.array([[800.0, 30.0], [-10.0, 300.0]]) @ points - 100
    screen = MeasuredScreen(points, skewed)
    np.testing.assert_allclose(screen.screen_mm(points), skewed, atol=1e-9)
    inside = np.random.default_rng(1).uniform(0.01, 0.99, (2, 50))
    np.testing.assert_allclose(
        screen.screen_mm(inside), np.array([[800.0, 30], [-10, 300]]) @ inside - 100, atol=1e-9
    )
    assert np.isnan(screen.screen_mm(np.array([[1.2], [0.5]]))).all()


def test_the_response_is_read_backwards_whatever_a_pixels_gain():
    levels = np.linspace(0, 255, 27)
    response = DisplayResponse(2 + 230 * (levels / 255) ** 2, levels)
    shown = levels[[3, 10, 20]]
    frames = np.interp(shown, levels, response.camera_adu)[:, None]
    out = response.shown_levels(frames, response.camera_adu[:1], response.camera_adu[-1:])
    np.testing.assert_allclose(out[:, 0], shown)


def test_a_dark_pixel_has_no_level():
    response = DisplayResponse(np.array([0.0, 200.0]), np.array([0.0, 255.0]))
    assert np.isnan(
        response.shown_levels(np.full((4, 1), 10.0), np.array([10.0]), np.array([10.0]))
    ).all()


def test_a_curve_that_turns_back_is_refused():
    with pytest.raises(ValueError, match="must rise"):
        DisplayResponse(np.array([0.0, 5.0, 4.0]), np.array([0.0, 1.0, 2.0]))
