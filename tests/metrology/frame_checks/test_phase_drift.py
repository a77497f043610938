"""The drift of an axis' phases, which shows a camera or screen that moves during the set."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.frame_checks.phase_drift import PhaseShifts

FRAMES = np.array([8.0, 9.0, 10.0, 11.0])
NO_REST = np.zeros((4, 3))  # of three patches
RAD_PER_FRAME = 7e-5


def test_a_steady_drift_is_found_and_waves_that_alternate_are_none() -> None:
    alternating_rad = 5e-5 * np.array([1.0, -1.0, 1.0, -1.0])
    shift_rad = 0.3 + RAD_PER_FRAME * FRAMES + alternating_rad
    shifts = PhaseShifts(FRAMES, shift_rad, 0.0, NO_REST)
    assert shifts.drift_rad == pytest.approx(RAD_PER_FRAME)
    assert shifts.drift_by_film_rad == 0


def test_the_frames_numbers_count_where_one_is_left_out() -> None:
    frames = np.array([0.0, 1.0, 3.0])
    shifts = PhaseShifts(frames, RAD_PER_FRAME * frames, 0.0, NO_REST[:3])
    assert shifts.drift_rad == pytest.approx(RAD_PER_FRAME)


def test_a_film_in_motion_explains_a_drift() -> None:
    """3 % of its phases, divided by the two frames between the steps that are compared."""
    shifts = PhaseShifts(FRAMES, RAD_PER_FRAME * FRAMES, 4e-3, NO_REST)
    assert shifts.drift_by_film_rad == pytest.approx(0.03 * 4e-3 / 2)


def test_what_a_patch_adds_to_all_frames_is_no_drift_and_what_grows_in_it_is() -> None:
    """The patches are independent: their drifts add in squares."""
    same_rad = np.full(4, 5e-5)
    growing_rad = 2e-5 * np.arange(4)
    patches_rad = np.stack([same_rad, growing_rad, -growing_rad], axis=1)
    shifts = PhaseShifts(FRAMES, np.zeros(4), 0.0, patches_rad)
    assert shifts.drift_sigma_rad == pytest.approx(2e-5 * np.sqrt(2))
