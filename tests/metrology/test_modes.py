"""Vibrations are named beyond half the frame rate, with their shape; noise, drift and steps are none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.metrology.track.modes import find_modes
from tests.support.vibrating_mirror import watched


@pytest.mark.parametrize("seed", [1, 2])
def test_lines_beyond_half_the_frame_rate_are_named(seed: int) -> None:
    time_s, coeffs_um, planted = watched(seed)
    found = find_modes(time_s, coeffs_um)
    assert len(found) == len(planted)
    for mode in planted:
        (seen,) = mode.seen_by(found)
        assert abs(seen.frequency_hz - mode.frequency_hz) < 5 * seen.sigma_hz < 0.1
        assert abs(seen.shape @ mode.shape) > 0.9
        assert seen.amplitude_nm == pytest.approx(5.0, rel=0.25)
        assert seen.aliases_hz == ()


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_drift_are_no_line(seed: int) -> None:
    assert find_modes(*watched(seed, lines_hz=())[:2]) == ()


def test_steps_outliers_and_rejected_frames_are_no_line_and_hide_none() -> None:
    time_s, coeffs_um, planted = watched(3, lines_hz=(48.0,))
    rng = np.random.default_rng(3)
    coeffs_um += 0.02 * rng.normal(size=(9, 36))[np.floor((time_s - time_s[0]) / 10).astype(int)]
    coeffs_um[rng.integers(0, time_s.size, 20)] += rng.normal(size=(20, 36))
    coeffs_um[rng.integers(0, time_s.size, 60)] = math.nan
    found = find_modes(time_s, coeffs_um)
    assert len(found) == 1
    assert planted[0].seen_by(found)


def test_one_frame_rate_leaves_the_aliases_and_says_so() -> None:
    time_s, coeffs_um, planted = watched(4, lines_hz=(48.0,), rates_hz=(20.0,))
    (seen,) = find_modes(time_s, coeffs_um)
    possible = [seen.frequency_hz, *seen.aliases_hz]
    assert seen.frequency_hz < 10
    assert min(abs(f - planted[0].frequency_hz) for f in possible) < 0.05
    assert len(possible) == 10  # below 100 Hz, of a rate of 20 Hz


@pytest.mark.parametrize("seconds", [0.0, 1.0, 15.0])
def test_too_short(seconds: float) -> None:
    time_s, coeffs_um, _ = watched(1, seconds=60.0)
    early = time_s < time_s[0] + seconds
    with pytest.raises(ValueError, match="less than 20 s of frames at a steady rate"):
        find_modes(time_s[early], coeffs_um[early])


@pytest.mark.campaign
def test_a_hundred_minutes_of_noise_have_no_line_and_sixty_seconds_show_all() -> None:
    assert sum(len(find_modes(*watched(seed, lines_hz=())[:2])) for seed in range(100, 200)) == 0
    seen, errors = 0, []
    for seed in range(200, 225):
        time_s, coeffs_um, planted = watched(seed)
        found = find_modes(time_s, coeffs_um)
        for mode in planted:
            for line in mode.seen_by(found):
                seen += 1
                errors.append((line.frequency_hz - mode.frequency_hz) / line.sigma_hz)
    assert seen >= 97  # of 100: two may have the same aliases
    assert 0.7 < np.std(errors) < 1.4


@pytest.mark.campaign
def test_a_damped_mode_has_the_error_of_its_width() -> None:
    """Pushed at random, it may ring in the pieces of one rate alone: one search in twenty takes an alias for it."""
    errors = []
    for seed in range(40):
        time_s, coeffs_um, planted = watched(seed, lines_hz=(48.0,), quality=200.0)
        strongest = find_modes(time_s, coeffs_um)[0]
        errors.append((strongest.frequency_hz - planted[0].frequency_hz) / strongest.sigma_hz)
    near = [error for error in errors if abs(error) < 5]
    assert len(near) >= 36
    assert 0.7 < np.sqrt(np.mean(np.square(near))) < 1.6
