"""Fewer rows for the viewer in quiet times, every row when something happens."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.model.telemetry import COLUMN, FIELDS, Rows
from membrane_ctrl.recorder.quiet_filter import QuietFilter


def second(number: int, state: float = 4.0, error_um: float = 0.1) -> Rows:
    rows = np.zeros((50, len(FIELDS)))
    ticks = number * 50 + np.arange(50)
    rows[:, COLUMN["tick"]] = ticks
    rows[:, COLUMN["mono_s"]] = ticks / 50
    rows[:, COLUMN["state"]] = state
    rows[:, COLUMN["error_um"]] = error_um
    return rows


def counts(filter_: QuietFilter, seconds: range) -> list[int]:
    return [len(filter_.select_rows(second(number))) for number in seconds]


def test_every_tick_for_a_minute_then_ten_a_second() -> None:
    found = counts(QuietFilter(50.0, 10.0, 2.0), range(200))
    assert found[:60] == [50] * 60
    assert found[61:] == [10] * 139


def test_a_change_brings_the_ten_seconds_before_it_back() -> None:
    quiet = QuietFilter(50.0, 10.0, 2.0)
    counts(quiet, range(200))
    sent = quiet.select_rows(second(200, state=8.0))
    time_s = sent[:, COLUMN["mono_s"]]
    assert len(sent) == 50 + 10 * 40
    assert np.all(np.diff(time_s) > 0)
    assert 189.9 < time_s[0] < 190.1
    assert len(quiet.select_rows(second(201, state=8.0))) == 50


def test_an_error_outside_the_band_is_no_quiet() -> None:
    quiet = QuietFilter(50.0, 10.0, 2.0)
    counts(quiet, range(200))
    assert len(quiet.select_rows(second(200, error_um=-2.1))) >= 50


def test_no_row_is_sent_twice_or_lost_where_something_happens() -> None:
    quiet = QuietFilter(50.0, 10.0, 2.0)
    sent = np.concatenate(
        [quiet.select_rows(second(n, state=8.0 if n == 150 else 4.0)) for n in range(220)]
    )
    ticks = np.sort(sent[:, COLUMN["tick"]])
    assert np.all(np.diff(ticks) > 0)
    around = ticks[(ticks >= 142 * 50) & (ticks < 205 * 50)]
    assert np.array_equal(around, np.arange(142 * 50, 205 * 50))


def test_a_rate_below_the_quiet_one_is_not_thinned() -> None:
    assert counts(QuietFilter(10.0, 50.0, 2.0), range(100)) == [50] * 100
