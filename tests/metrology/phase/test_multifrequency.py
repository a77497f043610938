"""Temporal unwrapping on synthetic phases."""

import numpy as np
import pytest

from membrane_ctrl.metrology.phase.temporal_unwrap import predict_phase, unwrap_in_time

PERIODS = [0.9, 3.9, 15.9, 63.9]


def wrapped(position, periods=PERIODS, noise_rad=0.0, seed=1):
    phase = 2 * np.pi * np.multiply.outer(np.asarray(periods), position)
    phase = phase + np.random.default_rng(seed).normal(0, noise_rad, phase.shape)
    return np.angle(np.exp(1j * phase))


def test_exact_phases_give_the_position_to_rounding():
    position = np.linspace(0.001, 0.999, 997).reshape(-1, 1)
    out = unwrap_in_time(wrapped(position), PERIODS)
    np.testing.assert_allclose(out.screens, position, atol=1e-14)
    np.testing.assert_allclose(out.step_periods, 0, atol=1e-11)
    assert out.consistent.all()
    assert out.step_periods.shape == (3, 997, 1)


def test_noise_of_the_finest_phase_is_all_that_is_left():
    position = np.random.default_rng(2).uniform(0.05, 0.95, 20_000)
    out = unwrap_in_time(wrapped(position, noise_rad=0.05), PERIODS)
    assert np.std(out.screens - position) == pytest.approx(0.05 / (2 * np.pi * 63.9), rel=0.03)
    # e of a step is the coarser phase's noise through the finer fringe, with the finer one's own
    expected = 0.05 / (2 * np.pi) * np.hypot(3.9 / 0.9, 1)
    assert np.std(out.step_periods[0]) == pytest.approx(expected, rel=0.03)
    assert out.consistent.all()


def test_a_wrong_coarse_phase_is_flagged():
    position = np.full(3, 0.4)
    phases = wrapped(position)
    phases[0, 1] += (
        2 * np.pi * 0.9 * 0.4 / 3.9
    )  # shifts the coarse position by 0.4 of the next period
    out = unwrap_in_time(phases, PERIODS)
    assert out.consistent.tolist() == [True, False, True]
    assert abs(out.step_periods[0, 1]) == pytest.approx(0.4)


def test_a_position_off_the_screen_is_flagged():
    assert not unwrap_in_time(wrapped(np.array([1.05])), PERIODS).consistent.any()


def test_a_stuck_order_is_one_whole_fine_period():
    phases = wrapped(np.array([0.3]))
    phases[2] += np.pi  # half a period of frequency 2 is two periods of frequency 3
    out = unwrap_in_time(phases, PERIODS)
    assert (out.screens[0] - 0.3) * 63.9 == pytest.approx(
        round((out.screens[0] - 0.3) * 63.9), abs=1e-9
    )
    assert abs(out.screens[0] - 0.3) * 63.9 > 0.5
    assert not out.consistent[0]


@pytest.mark.parametrize("index", [1, 2, 3])
def test_prediction_does_not_look_at_the_frequency_it_predicts(index):
    position = np.linspace(0.1, 0.9, 50)
    phases = wrapped(position)
    phases[index] = 1.234
    predicted = predict_phase(phases, PERIODS, index)
    np.testing.assert_allclose(predicted, 2 * np.pi * PERIODS[index] * position, atol=1e-9)


def test_the_prediction_of_the_coarsest_uses_it_for_the_order_alone():
    position = np.linspace(0.1, 0.9, 50)
    phases = wrapped(position)
    phases[0] += 0.1
    np.testing.assert_allclose(
        predict_phase(phases, PERIODS, 0), 2 * np.pi * 0.9 * position, atol=1e-9
    )


@pytest.mark.parametrize(
    ("periods", "count"), [([1.5, 4], 2), ([0.9, 0.8], 2), ([0.9, 3.9], 3), ([0, 2], 2)]
)
def test_periods_that_cannot_be_unwrapped_are_refused(periods, count):
    with pytest.raises(ValueError, match="periods"):
        unwrap_in_time(np.zeros((count, 4)), periods)
