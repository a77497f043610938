"""A figure with every frame: the same as a cycle's when nothing moves, and beside the film when it does."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from metrology_truth import SMALL

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.live import LiveReconstructor
from membrane_ctrl.metrology.phase import fringe_sequence, full_sequence
from membrane_ctrl.metrology.sliding import SlidingWindow
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape

OPTICS = OpticsConfig(camera=SMALL)
ZERNIKE_UM = (0, 0, 0, 0, 800, -500, 300, 0, 400, *[0] * 27)
PATTERNS = fringe_sequence(OPTICS.pattern)
FRAME_S = 0.1


@cache
def _renderer() -> OpticsRenderer:
    return OpticsRenderer(OPTICS, FilmShape(37.1, 500.0, "hencky", ZERNIKE_UM), seed=3)


def _frame(step: int, displacement_um: float = 0.0) -> np.ndarray:
    return _renderer().render(PATTERNS[step], displacement_um).copy()


def _started() -> SlidingWindow:
    window = SlidingWindow(OPTICS, 1)
    frames = [_renderer().render(pattern, 0.0).copy() for pattern in full_sequence(OPTICS.pattern)]
    assert window.full(frames, FRAME_S * np.arange(18), np.zeros(18)).verdict == "ok"
    return window


def _error_um(window: SlidingWindow, coeffs_um: np.ndarray, hencky_um: float, displacement_um: float) -> float:
    x, y, h = window.height_map(coeffs_um, hencky_um, 64)
    truth = FilmShape(37.1 + displacement_um / 1e3, 500.0, "hencky", ZERNIKE_UM).height_mm(*np.meshgrid(x, y), 0.0)
    return float(np.sqrt(np.nanmean((1e3 * (h - truth)) ** 2)))


def test_a_window_of_new_frames_is_a_cycle() -> None:
    window, cycle = _started(), LiveReconstructor(OPTICS, 1)
    full = [_renderer().render(pattern, 0.0).copy() for pattern in full_sequence(OPTICS.pattern)]
    cycle.full(full, np.zeros(18), np.zeros(18))
    frames, times = [_frame(k) for k in range(8)], 2.0 + FRAME_S * np.arange(8)
    whole = cycle.fringes(frames, times, np.zeros(8))
    for k in (3, 0, 7, 1, 4, 2, 6, 5):  # in any order
        last = window.frame(frames[k], k, times[k], 0.0)
    assert last.verdict == "ok"
    assert last.time_s == pytest.approx(whole.time_s)
    # the same frames; what is left is where the two iterations stopped
    assert np.abs(last.coeffs_um - whole.coeffs_um).max() < 1e-3
    assert np.abs(last.covariance_um2 - whole.covariance_um2).max() < 0.01 * np.abs(whole.covariance_um2).max()


def test_every_frame_renews_the_figure_of_a_film_at_rest() -> None:
    window = _started()
    sags = []
    for k in range(16):
        estimate = window.frame(_frame(k % 8), k % 8, 2.0 + FRAME_S * k, 0.0)
        assert estimate.verdict == "ok", estimate.reason
        assert _error_um(window, estimate.coeffs_um, estimate.hencky_um, 0.0) < 0.05
        sags.append(estimate.sag_um)
    assert len(set(sags)) == 16


def _swing_um(time_s: float) -> float:
    """5 um at 0.3 Hz on a drift of 4 um/s."""
    return float(5 * np.sin(2 * np.pi * 0.3 * time_s) + 4 * time_s)


def _worst_error_um(laser: bool) -> float:
    """Over 32 frames of a moving film, against the film at the window's mean displacement."""
    window, errors = _started(), []
    for k in range(40):
        where_um = _swing_um(FRAME_S * k)
        estimate = window.frame(_frame(k % 8, where_um), k % 8, FRAME_S * k, where_um if laser else float("nan"))
        assert estimate.verdict == "ok", estimate.reason
        if k >= 8:
            middle_um = float(np.mean([_swing_um(FRAME_S * i) for i in range(k - 7, k + 1)]))
            assert estimate.time_s == pytest.approx(FRAME_S * (k - 3.5))  # half a window behind
            assert estimate.displacement_um == pytest.approx(middle_um if laser else np.nan, nan_ok=True)
            errors.append(_error_um(window, estimate.coeffs_um, estimate.hencky_um, middle_um))
    return max(errors)


def test_follows_a_moving_film_with_the_laser() -> None:
    corrected = _worst_error_um(laser=True)
    assert corrected <= 0.2
    assert _worst_error_um(laser=False) > 5 * corrected


def test_saturation_leaves_with_its_frame() -> None:
    window = _started()
    burnt = _frame(2)
    burnt[120:136, 140:160] = 255
    estimate = window.frame(burnt, 2, 2.0, 0.0)
    assert estimate.saturated_fraction > 0
    assert window.frame(_frame(3), 3, 2.1, 0.0).saturated_fraction == estimate.saturated_fraction
    assert window.frame(_frame(2), 2, 2.2, 0.0).saturated_fraction == 0


def test_saturation_of_a_cycle_stays_until_its_frames_are_replaced() -> None:
    window = _started()
    frames = [_frame(k) for k in range(8)]
    frames[5][120:136, 140:160] = 255
    whole = window.fringes(frames, np.zeros(8), np.zeros(8))
    assert whole.saturated_fraction > 0
    seen = [window.frame(_frame(k), k, 1.0, 0.0).saturated_fraction for k in range(8)]
    assert seen[:7] == [whole.saturated_fraction] * 7
    assert seen[7] == 0


def test_needs_a_full_cycle() -> None:
    estimate = SlidingWindow(OPTICS, 1).frame(_frame(0), 0, 0.0, 0.0)
    assert estimate.verdict == "rejected"
    assert estimate.tracking_lost


def test_a_jump_of_the_film_loses_the_tracking() -> None:
    window = _started()
    verdicts = [window.frame(_frame(k, 2500.0), k, 2.0 + FRAME_S * k, 2500.0).reason for k in range(8)]
    assert any(reason.startswith("tracking lost") for reason in verdicts)


@pytest.mark.parametrize("step", [-1, 8])
def test_unknown_step(step: int) -> None:
    with pytest.raises(ValueError, match="not one of the 8"):
        _started().frame(_frame(0), step, 0.0, 0.0)


def test_wrong_size() -> None:
    with pytest.raises(ValueError, match="frame is"):
        _started().frame(_frame(0)[:, :-1], 0, 0.0, 0.0)
