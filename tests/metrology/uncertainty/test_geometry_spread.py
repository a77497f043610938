"""Covariances of geometries: what they refuse, what they draw, and what a change does to a pose."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.optics import (
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.uncertainty.geometry_spread import (
    GENERAL_NAMES,
    PAPER_SPREAD,
    SHORT_NAMES,
    GeometrySpread,
    change_geometry,
    stated_spread,
)

SHORT = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9)


def _general() -> GeometryConfig:
    """The short form's poses, written out."""
    poses = Geometry.from_config(OpticsConfig(geometry=SHORT))
    rows = [tuple(row) for row in poses.rotation.tolist()]
    return GeometryConfig(
        camera=CameraPoseConfig(
            position_mm=tuple(poses.pinhole_mm.tolist()), rotation=(rows[0], rows[1], rows[2])
        ),
        screen=ScreenPoseConfig(
            origin_mm=tuple(poses.screen_origin_mm.tolist()),
            s_x=tuple(poses.screen_s_x.tolist()),
            s_y=tuple(poses.screen_s_y.tolist()),
        ),
    )


def test_draws_have_the_covariance() -> None:
    covariance = np.array([[4.0, 1.8, 0.0], [1.8, 1.0, 0.01], [0.0, 0.01, 0.09]])
    spread = GeometrySpread(SHORT_NAMES, covariance)
    rng = np.random.default_rng(1)
    draws = np.array([spread.draw_change(rng) for _ in range(20_000)])
    assert np.cov(draws, rowvar=False) == pytest.approx(covariance, abs=0.02 * 4)
    assert np.abs(draws.mean(axis=0) / spread.sigmas).max() < 0.03


def test_stated_sigmas() -> None:
    stated = stated_spread(SHORT.model_copy(update={"a_sigma_mm": 2.0, "alpha_sigma_deg": 0.3}))
    assert stated is not None
    assert stated.names == SHORT_NAMES
    assert stated.sigmas.tolist() == [2.0, 0.0, 0.3]
    assert stated_spread(SHORT) is None
    assert stated_spread(_general()) is None


def test_short_form_changes_in_its_numbers() -> None:
    moved = change_geometry(SHORT, ("alpha_deg", "a_mm"), [0.3, -2.0])
    assert (moved.a_mm, moved.b_mm, moved.alpha_deg) == (2670.0, 2871.0, pytest.approx(81.2))


def test_general_form_is_shifted_and_turned_about_its_own_origin() -> None:
    general = _general()
    names = ("camera_shift_z_mm", "camera_turn_y_rad", "screen_turn_z_rad")
    before = Geometry.from_config(OpticsConfig(geometry=general))
    after = Geometry.from_config(
        OpticsConfig(geometry=change_geometry(general, names, [3.0, 1e-3, 2e-3]))
    )
    assert after.pinhole_mm - before.pinhole_mm == pytest.approx([0, 0, 3.0])
    assert after.screen_origin_mm == pytest.approx(before.screen_origin_mm)
    # d v = w x v to first order
    axis = before.rotation[2]
    assert after.rotation[2] - axis == pytest.approx(np.cross([0, 1e-3, 0], axis), abs=1e-6)
    assert after.screen_s_y - before.screen_s_y == pytest.approx(
        np.cross([0, 0, 2e-3], before.screen_s_y), abs=3e-6
    )


def test_a_change_of_no_parameter_leaves_the_geometry_unchanged() -> None:
    assert change_geometry(_general(), (), []) == _general()


@pytest.mark.parametrize(
    ("names", "covariance", "text"),
    [
        (("a_mm", "a_mm"), np.eye(2), "twice"),
        (("a_mm", "camera_shift_x_mm"), np.eye(2), "all from"),
        (("focal_mm",), np.eye(1), "all from"),
        (("a_mm",), np.eye(2), "as many rows"),
        (("a_mm", "b_mm"), np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (("a_mm", "b_mm"), np.array([[1.0, 2.0], [2.0, 1.0]]), "eigenvalue"),
        (("a_mm", "b_mm"), np.array([[-1.0, 0.0], [0.0, 1.0]]), "variance"),
        (("a_mm",), np.array([[np.nan]]), "finite"),
    ],
)
def test_refuses(names: tuple[str, ...], covariance: np.ndarray, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        GeometrySpread(names, covariance)


def test_names_of_the_other_form() -> None:
    with pytest.raises(
        ValueError, match="camera_shift_x_mm: the geometry is given by a, b and alpha"
    ):
        change_geometry(SHORT, GENERAL_NAMES[:1], [1.0])
    with pytest.raises(ValueError, match="a_mm: the geometry is given by two poses"):
        change_geometry(_general(), PAPER_SPREAD.names[:1], [1.0])
