"""Vibrations are named beyond half the frame rate, with their shape; noise, drift and steps are none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.metrology.track import live
from membrane_ctrl.metrology.track.live import Stethoscope
from membrane_ctrl.metrology.track.modes import VibrationMode, find_modes
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver, sentence
from membrane_ctrl.model.run_events import Vibrations, from_dict
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


def test_lines_with_one_alias_at_one_rate_make_no_others() -> None:
    """A drum's, which move the vertex: at 17.1 frames a second, 27 and 61 Hz are at 7.2 and 7.4 Hz."""
    time_s, coeffs_um, planted = watched(1, rates_hz=(20, 20 / 1.09, 20 / 1.17), amplitude_nm=20.0, drums=True)
    found = find_modes(time_s, coeffs_um)
    assert found is not None
    assert len(found) == len(planted)
    for mode in planted:
        (seen,) = mode.seen_by(found)
        assert seen.amplitude_nm == pytest.approx(20.0, rel=0.1)
        assert abs(seen.shape @ mode.shape) > 0.99


@pytest.mark.parametrize("seed", [1, 2])
def test_terms_of_less_noise_than_a_nanometre_make_no_others(seed: int) -> None:
    """A hold gives whole nanometres: a term that hardly leaves one has next to no noise of its own."""
    time_s, coeffs_um, planted = watched(
        seed, rates_hz=(20, 20 / 1.09, 20 / 1.17), amplitude_nm=20.0, noise_nm=1.0, drift_nm=0.0, drums=True
    )
    found = find_modes(time_s, np.round(coeffs_um, 3))
    assert found is not None
    assert sorted(line.frequency_hz for line in found) == pytest.approx([27, 48, 57, 61], abs=0.01)
    assert len(found) == len(planted)


@pytest.mark.parametrize("seed", [307, 312])
def test_a_line_that_one_rate_alone_shows_may_be_any_of_its_aliases(seed: int) -> None:
    """48 Hz is six times a rate of 8: where two rates of three are blind, another frequency may look alike."""
    time_s, coeffs_um, planted = watched(seed, rates_hz=(8.0, 8 / 1.09, 8 / 1.17), noise_nm=6.0)
    found = find_modes(time_s, coeffs_um)
    assert found
    for line in found:
        possible = np.array([line.frequency_hz, *line.aliases_hz])
        assert min(np.abs(possible - mode.frequency_hz).min() for mode in planted) < 0.15


@pytest.mark.parametrize("seed", [302, 309])
def test_a_line_that_one_rate_cannot_see_makes_no_other(seed: int) -> None:
    """At one of the rates it may have the alias of drift; what it leaves there is not nothing."""
    time_s, coeffs_um, planted = watched(seed, rates_hz=(15, 15 / 1.09, 15 / 1.17), noise_nm=6.0)
    sure = [line for line in find_modes(time_s, coeffs_um) if not line.aliases_hz]
    assert len(sure) >= 3
    assert all(any(abs(line.frequency_hz - mode.frequency_hz) < 0.1 for mode in planted) for line in sure)


def test_a_hold_does_not_tell_of_a_line_that_may_be_another() -> None:
    assert Stethoscope().search(*watched(4, lines_hz=(48.0,), rates_hz=(20.0,))[:2]) == []


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
    assert find_modes(time_s[early], coeffs_um[early]) is None


@pytest.mark.campaign
def test_a_night_of_steps_and_outliers_tells_no_line() -> None:
    listener = Stethoscope()
    for seed in range(1000, 1480):
        time_s, coeffs_um, _ = watched(seed, lines_hz=())
        rng = np.random.default_rng(seed)
        coeffs_um += 0.02 * rng.normal(size=(9, 36))[np.floor((time_s - time_s[0]) / 10).astype(int)]
        coeffs_um[rng.integers(0, time_s.size, 5)] += rng.normal(size=(5, 36))
        assert listener.search(time_s, coeffs_um) == []


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
        strongest = find_modes(time_s, coeffs_um)[:1]
        errors += [(line.frequency_hz - planted[0].frequency_hz) / line.sigma_hz for line in strongest]
    near = [error for error in errors if abs(error) < 5]
    assert len(near) >= 36
    assert 0.7 < np.sqrt(np.mean(np.square(near))) < 1.6


FRAMES = np.arange(0.0, 60.0, 0.05), np.zeros((1200, 36))
SHAPES = np.eye(36)


def heard(
    monkeypatch: pytest.MonkeyPatch, minutes: list[dict[int, float]], stroke_hz: float = 0.0
) -> list[list[Event]]:
    """What a hold tells in minutes in which modes, by the number of their shape, are at these frequencies."""
    listener = Stethoscope(stroke_hz)
    told: list[list[Event]] = []
    for lines in minutes:
        found = tuple(VibrationMode(hz, 0.01, 5.0, SHAPES[k], 100.0) for k, hz in lines.items())
        monkeypatch.setattr(live, "find_modes", lambda *_, found=found: found)
        told.append(listener.search(*FRAMES))
    return told


def test_a_mode_keeps_its_place_and_a_minute_without_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    told = heard(monkeypatch, [{}, {3: 48.0}, {}, {7: 27.0, 3: 48.1}, {3: 47.0}])
    lines = [[event.frequency_hz for event in minute if isinstance(event, Vibrations)] for minute in told]
    assert lines == [[], [[48.0]], [[None]], [[48.1, 27.0]], [[47.0, None]]]
    assert told[2][0].to_dict()["message"] == "none"


def test_a_mode_that_moves_by_a_per_cent_is_told_once_and_its_return_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def told(minutes: list[dict[int, float]]) -> list[Event]:
        found = (event for minute in heard(monkeypatch, minutes) for event in minute)
        return [event for event in found if not isinstance(event, Vibrations)]

    usual, lower, near = {3: 48.0, 7: 61.0}, {3: 47.3, 7: 61.0}, {3: 48.2, 7: 61.0}
    assert told(10 * [usual] + 10 * [near]) == []
    moved, *again = told(6 * [usual] + 2 * [lower] + 6 * [usual] + 6 * [lower] + 6 * [usual])
    assert isinstance(moved, Maintenance)
    assert moved.name == "film_tension"
    assert "48.00 Hz moved by -1.5%: the film's tension by -2.9%" in moved.message
    assert [type(event) for event in again] == [MaintenanceOver]


def test_strokes_of_the_pump_at_a_mode_are_told_once_and_their_end_too(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, away = {3: 48.0, 7: 61.0}, {3: 48.0}

    def told(stroke_hz: float) -> list[Event]:
        found = (e for minute in heard(monkeypatch, [usual, usual, away, away, usual], stroke_hz) for e in minute)
        return [event for event in found if not isinstance(event, Vibrations)]

    assert told(0.0) == told(59.9) == told(52.0) == []
    driven, over, again = told(61.5)
    assert isinstance(driven, Maintenance)
    assert driven.name == over.name == "pump_resonance"
    assert "strokes, 61.5 Hz, drive the mirror's vibration at 61.00 Hz, 5 nm" in driven.message
    assert isinstance(over, MaintenanceOver)
    assert again == driven


@pytest.mark.campaign
def test_a_listener_hears_what_is_planted() -> None:
    time_s, coeffs_um, planted = watched(1, lines_hz=(48.0,))
    (told,) = Stethoscope().search(time_s, coeffs_um)
    assert isinstance(told, Vibrations)
    assert told.frequency_hz == pytest.approx([planted[0].frequency_hz], abs=0.05)


def test_what_was_heard_survives_the_line_to_the_hold_and_has_a_sentence() -> None:
    event = Vibrations([48.0, None], [5.0, None], "48.00 Hz 5.0 nm")
    assert from_dict(event.to_dict()) == event
    assert sentence(event.to_dict()) == "Vibrations of the mirror: 48.00 Hz 5.0 nm"
