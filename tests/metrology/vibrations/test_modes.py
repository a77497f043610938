"""Vibrations are named beyond half the frame rate, with their shape; noise, drift and steps are
none.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from membrane_ctrl.metrology.vibrations import mode_follower
from membrane_ctrl.metrology.vibrations.mode_follower import FollowedModes, VibrationFollower
from membrane_ctrl.metrology.vibrations.mode_search import VibrationMode, find_modes
from membrane_ctrl.model.acquisition_events import Vibrations
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from tests.worlds.vibrating_mirror import watched


@pytest.mark.parametrize("seed", [1, 2])
def test_lines_beyond_half_the_frame_rate_are_found(seed: int) -> None:
    time_s, coeffs_um, planted = watched(seed)
    found = find_modes(time_s, coeffs_um)
    assert len(found) == len(planted)
    for mode in planted:
        (seen,) = mode.seen_by(found)
        assert abs(seen.frequency_hz - mode.frequency_hz) < 5 * seen.sigma_hz < 0.1
        assert abs(seen.shape @ mode.shape) > 0.9
        assert seen.amplitude_nm == pytest.approx(5.0, rel=0.25)
        assert seen.aliases_hz == ()


@pytest.mark.parametrize("seed", [1, 2])
def test_lines_are_found_with_the_jitter_of_a_busy_machine(seed: int) -> None:
    """Intervals that scatter by some per cent were no steady rate: nothing was searched."""
    time_s, coeffs_um, planted = watched(seed, jitter_s=2e-3)
    found = find_modes(time_s, coeffs_um)
    assert found is not None
    assert len(found) == len(planted)
    assert all(mode.seen_by(found) for mode in planted)


def test_lines_with_one_alias_at_one_rate_give_no_false_lines() -> None:
    """A drum's, which move the vertex: at 17.1 frames a second,
    27 and 61 Hz are at 7.2 and 7.4 Hz.
    """
    time_s, coeffs_um, planted = watched(
        1, rates_hz=(20, 20 / 1.09, 20 / 1.17), amplitude_nm=20.0, drums=True
    )
    found = find_modes(time_s, coeffs_um)
    assert found is not None
    assert len(found) == len(planted)
    for mode in planted:
        (seen,) = mode.seen_by(found)
        assert seen.amplitude_nm == pytest.approx(20.0, rel=0.1)
        assert abs(seen.shape @ mode.shape) > 0.99


@pytest.mark.parametrize("seed", [1, 2])
def test_terms_with_less_noise_than_a_nanometre_give_no_false_lines(seed: int) -> None:
    """A hold gives whole nanometres: a term that hardly leaves one
    has next to no noise of its own.
    """
    time_s, coeffs_um, planted = watched(
        seed,
        rates_hz=(20, 20 / 1.09, 20 / 1.17),
        amplitude_nm=20.0,
        noise_nm=1.0,
        drift_nm=0.0,
        drums=True,
    )
    found = find_modes(time_s, np.round(coeffs_um, 3))
    assert found is not None
    assert sorted(line.frequency_hz for line in found) == pytest.approx([27, 48, 57, 61], abs=0.01)
    assert len(found) == len(planted)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_the_slow_motion_of_a_held_film_gives_no_false_lines(seed: int) -> None:
    """It is nearly all in one term, 28 nm/rtHz at 1 Hz, and at one of the rates among a mode's
    aliases.
    """
    time_s, coeffs_um, planted = watched(
        seed,
        rates_hz=(20, 20 / 1.09, 20 / 1.17),
        amplitude_nm=20.0,
        noise_nm=3.0,
        drift_nm=0.0,
        drums=True,
    )
    each_hz = np.linspace(0.05, 8.0, 400)
    turns = np.outer(time_s - time_s[0], 2 * math.pi * each_hz) + np.random.default_rng(
        seed
    ).uniform(0, 2 * math.pi, 400)
    bowl_nm = np.cos(turns) @ (28.0 * math.sqrt(2 * (each_hz[1] - each_hz[0])) / each_hz)
    coeffs_um[:, [0, 3]] += 1e-3 * bowl_nm[:, None] * [math.sqrt(3), 1.0]  # the vertex stays at 0
    found = find_modes(time_s, np.round(coeffs_um, 3))
    assert found is not None
    unaliased = [line for line in found if not line.aliases_hz]
    assert sorted(line.frequency_hz for line in unaliased) == pytest.approx(
        [27, 48, 57, 61], abs=0.02
    )
    for mode in planted:
        (seen,) = mode.seen_by(tuple(unaliased))
        assert seen.amplitude_nm == pytest.approx(20.0, rel=0.1)


@pytest.mark.parametrize("seed", [307, 312])
def test_a_line_that_one_rate_alone_shows_may_be_any_of_its_aliases(seed: int) -> None:
    """48 Hz is six times a rate of 8: where two rates of three are blind, another frequency may
    look the same.
    """
    time_s, coeffs_um, planted = watched(seed, rates_hz=(8.0, 8 / 1.09, 8 / 1.17), noise_nm=6.0)
    found = find_modes(time_s, coeffs_um)
    assert found
    for line in found:
        possible = np.array([line.frequency_hz, *line.aliases_hz])
        assert min(np.abs(possible - mode.frequency_hz).min() for mode in planted) < 0.15


@pytest.mark.parametrize("seed", [302, 309])
def test_a_line_hidden_at_one_rate_makes_no_other(seed: int) -> None:
    """At one of the rates it may have the alias of drift; what it leaves there is not nothing."""
    time_s, coeffs_um, planted = watched(seed, rates_hz=(15, 15 / 1.09, 15 / 1.17), noise_nm=6.0)
    unaliased = [line for line in find_modes(time_s, coeffs_um) if not line.aliases_hz]
    assert len(unaliased) >= 3
    assert all(
        any(abs(line.frequency_hz - mode.frequency_hz) < 0.1 for mode in planted)
        for line in unaliased
    )


def test_a_hold_does_not_report_a_line_that_may_be_another() -> None:
    assert (
        VibrationFollower().search_minute(*watched(4, lines_hz=(48.0,), rates_hz=(20.0,))[:2]) == []
    )


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_drift_are_no_line(seed: int) -> None:
    assert find_modes(*watched(seed, lines_hz=())[:2]) == ()


def test_steps_outliers_and_rejected_frames_are_no_line_and_hide_none() -> None:
    time_s, coeffs_um, planted = watched(3, lines_hz=(48.0,))
    rng = np.random.default_rng(3)
    coeffs_um += (
        0.02 * rng.normal(size=(9, ZERNIKE_TERMS))[np.floor((time_s - time_s[0]) / 10).astype(int)]
    )
    coeffs_um[rng.integers(0, time_s.size, 20)] += rng.normal(size=(20, ZERNIKE_TERMS))
    coeffs_um[rng.integers(0, time_s.size, 60)] = math.nan
    found = find_modes(time_s, coeffs_um)
    assert len(found) == 1
    assert planted[0].seen_by(found)


def test_one_frame_rate_leaves_aliases_which_are_reported() -> None:
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
def test_a_night_of_steps_and_outliers_shows_no_vibration() -> None:
    listener = VibrationFollower()
    for seed in range(1000, 1480):
        time_s, coeffs_um, _ = watched(seed, lines_hz=())
        rng = np.random.default_rng(seed)
        coeffs_um += (
            0.02
            * rng.normal(size=(9, ZERNIKE_TERMS))[np.floor((time_s - time_s[0]) / 10).astype(int)]
        )
        coeffs_um[rng.integers(0, time_s.size, 5)] += rng.normal(size=(5, ZERNIKE_TERMS))
        assert listener.search_minute(time_s, coeffs_um) == []


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
    """Pushed at random, it may ring in the pieces of one rate alone: one search in twenty takes an
    alias for it.
    """
    errors = []
    for seed in range(40):
        time_s, coeffs_um, planted = watched(seed, lines_hz=(48.0,), quality=200.0)
        strongest = find_modes(time_s, coeffs_um)[:1]
        errors += [
            (line.frequency_hz - planted[0].frequency_hz) / line.sigma_hz for line in strongest
        ]
    near = [error for error in errors if abs(error) < 5]
    assert len(near) >= 36
    assert 0.7 < np.sqrt(np.mean(np.square(near))) < 1.6


DAY_S = 86400.0
SHAPES = np.eye(ZERNIKE_TERMS)
USUAL = {3: 48.0, 7: 61.0}
Searches = list[dict[int, float]]


def heard(
    monkeypatch: pytest.MonkeyPatch, listener: VibrationFollower, lines: Searches, day: float = 0.0
) -> list[list[Event]]:
    """What a hold reports in minutes, from a day on, in which modes, by the number of their shape,
    have these lines.
    """
    event_lists: list[list[Event]] = []
    for minute, found in enumerate(lines):
        modes = tuple(VibrationMode(hz, 0.01, 5.0, SHAPES[k], 100.0) for k, hz in found.items())
        monkeypatch.setattr(mode_follower, "find_modes", lambda *_, modes=modes: modes)
        event_lists.append(
            listener.search_minute(
                day * DAY_S + 60.0 * minute + np.arange(0.0, 60.0, 0.05),
                np.zeros((1200, ZERNIKE_TERMS)),
            )
        )
    return event_lists


def notices(event_lists: list[list[Event]]) -> list[Event]:
    return [
        event for minute in event_lists for event in minute if not isinstance(event, Vibrations)
    ]


def places(event_lists: list[list[Event]]) -> list[list[float | None]]:
    return [
        event.frequency_hz
        for minute in event_lists
        for event in minute
        if isinstance(event, Vibrations)
    ]


def scaled(by: float) -> dict[int, float]:
    return {k: by * hz for k, hz in USUAL.items()}


def test_a_mode_keeps_its_place_and_a_minute_without_it_has_none_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    event_lists = heard(
        monkeypatch, VibrationFollower(), [{}, {3: 48.0}, {}, {7: 27.0, 3: 48.1}, {3: 47.0}]
    )
    assert places(event_lists) == [[48.0], [None], [48.1, 27.0], [47.0, None]]
    assert event_lists[2][0].to_dict()["message"] == "none"


def test_a_line_that_passes_by_leaves_its_place_and_a_mode_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A hold of a week would be full of them."""
    passing: Searches = [{3: 48.0, k: 30.0 + 5 * k} for k in range(8, 20)]
    event_lists = heard(monkeypatch, VibrationFollower(), [{3: 48.0}] * 5 + [{}] * 9 + passing)
    lines = places(event_lists)
    assert max(len(each) for each in lines) == 6
    assert all(each[0] == 48.0 for each in lines[-12:])
    assert [sum(hz is not None for hz in each) for each in lines[-12:]] == [2] * 12


def test_of_two_modes_of_nearly_one_frequency_each_keeps_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    event_lists = heard(
        monkeypatch, VibrationFollower(), [{3: 48.0, 4: 48.15}, {4: 48.15, 3: 48.0}]
    )
    assert places(event_lists) == [[48.0, 48.15], [48.0, 48.15]]


def test_a_mode_that_moves_by_a_per_cent_gives_one_notice_and_its_return_ends_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listener, lower = VibrationFollower(), {3: 47.3, 7: 61.0}
    assert notices(heard(monkeypatch, listener, 10 * [USUAL] + 10 * [{3: 48.2, 7: 61.0}])) == []
    moved, *again = notices(
        heard(
            monkeypatch, listener, 2 * [lower] + 6 * [USUAL] + 6 * [lower] + 6 * [USUAL], 20 / 1440
        )
    )
    assert isinstance(moved, Maintenance)
    assert moved.name == "film_tension"
    assert "48.00 Hz moved by -1.5% within 1 h: the film's tension by -2.9%" in moved.message
    assert [type(event) for event in again] == [MaintenanceOver]


@pytest.mark.parametrize(
    ("change", "event_lists"), [(0.01, 1), (-0.01, 1), (0.003, 0), (-0.003, 0), (0.0, 0)]
)
def test_a_slow_shift_within_a_week_gives_a_notice(
    monkeypatch: pytest.MonkeyPatch, change: float, event_lists: int
) -> None:
    """Five minutes a day; the last on day 7."""
    listener, kinds = VibrationFollower(), []
    for day in range(8):
        kinds += notices(heard(monkeypatch, listener, 5 * [scaled(1 + change * day / 7)], day))
    assert [type(event) for event in kinds] == [Maintenance] * event_lists
    assert all(
        f"moved by {change:+.1%} within 168 h: the film's tension by {2 * change:+.1%}" in str(e)
        for e in kinds
    )


def test_what_stays_where_it_moved_to_is_the_usual_after_a_week(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listener = VibrationFollower()
    kinds = [
        [
            event.kind
            for event in notices(
                heard(monkeypatch, listener, 6 * [scaled(1.0 if day < 2 else 0.985)], day)
            )
        ]
        for day in range(12)
    ]
    assert kinds == [[], [], ["maintenance"], *[[]] * 7, ["maintenance_over"], []]


def test_a_shift_slower_than_that_gives_no_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = VibrationFollower()
    for day in range(30):
        assert notices(heard(monkeypatch, listener, 5 * [scaled(1 + 0.007 * day / 7)], day)) == []


def test_a_mode_that_was_absent_for_a_week_has_no_earlier_frequencies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listener = VibrationFollower()
    heard(monkeypatch, listener, 6 * [USUAL])
    assert notices(heard(monkeypatch, listener, 12 * [scaled(1.015)], day=9)) == []


def test_the_next_follower_continues_with_the_modes_of_the_last_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = VibrationFollower(61.0, begin_utc_s=0.0)
    (driven,) = notices(heard(monkeypatch, first, 6 * [USUAL]))
    same_run = VibrationFollower(61.0, begin_utc_s=0.0, known=first.followed)
    assert driven.name == "pump_resonance"
    assert notices(heard(monkeypatch, same_run, [USUAL], 0.1)) == []
    next_run = VibrationFollower(
        0.0, begin_utc_s=2 * DAY_S, known=FollowedModes(first.followed.modes)
    )
    moved = notices(heard(monkeypatch, next_run, 5 * [scaled(0.99)]))
    assert [event.name for event in moved] == ["film_tension"]
    assert "48.00 Hz moved by -1.0% within 48 h" in moved[0].message


def test_pump_strokes_at_a_mode_give_one_notice_which_ends_with_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    away = {3: 48.0}

    def list_driven_notices(stroke_hz: float) -> list[Event]:
        minutes = [*5 * [USUAL], *4 * [away], USUAL, *6 * [away], *5 * [USUAL]]
        return notices(heard(monkeypatch, VibrationFollower(stroke_hz), minutes))

    assert list_driven_notices(0.0) == list_driven_notices(59.9) == list_driven_notices(52.0) == []
    driven, over, again = list_driven_notices(61.5)
    assert isinstance(driven, Maintenance)
    assert driven.name == over.name == "pump_resonance"
    assert "strokes, 61.5 Hz, drive the mirror's vibration at 61.00 Hz, 5 nm" in driven.message
    assert isinstance(over, MaintenanceOver)
    assert again == driven


def test_a_line_found_once_at_the_strokes_gives_no_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (
        notices(heard(monkeypatch, VibrationFollower(61.5), [{3: 48.0}, USUAL, *8 * [{3: 48.0}]]))
        == []
    )


@pytest.mark.campaign
def test_a_follower_finds_planted_vibrations() -> None:
    time_s, coeffs_um, planted = watched(1, lines_hz=(48.0,))
    (event_lists,) = VibrationFollower().search_minute(time_s, coeffs_um)
    assert isinstance(event_lists, Vibrations)
    assert event_lists.frequency_hz == pytest.approx([planted[0].frequency_hz], abs=0.05)


def test_the_vibrations_event_survives_encoding_and_has_a_sentence() -> None:
    event = Vibrations([48.0, None], [5.0, None], "48.00 Hz 5.0 nm")
    assert from_dict(event.to_dict()) == event
    assert event.sentence == "Vibrations of the mirror: 48.00 Hz 5.0 nm"
