"""The chart's data: of the last seconds from the feed, of a month from the runs' tables, with gaps
as gaps.
"""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.review.sparkline import render_sparkline
from membrane_ctrl.service.feed import HoldFeed, Seconds, Series, history, marks, thinned
from membrane_ctrl.web.history_chart import ChartLine, make_history_chart

NOW_S = 1_800_000_000.0


def feed_of(seconds: int, end_s: float = NOW_S) -> HoldFeed:
    """A feed that has seen 10 Hz of an error that counts its seconds, and was never connected."""
    feed = HoldFeed(Where())
    for tick in range(seconds * 10 + 1):
        at_s = end_s - seconds + tick / 10
        feed.seconds.add(at_s, {"error_um": math.floor(at_s - end_s) + (tick % 10) / 100})
    return feed


def test_seconds_have_least_mean_and_largest_value() -> None:
    seconds = Seconds()
    for at_s, value in (
        (0.0, 1.0),
        (0.4, 3.0),
        (0.8, math.nan),
        (1.1, 5.0),
        (2.5, 0.0),
        (3.0, 0.0),
    ):
        seconds.add(at_s, {"error_um": value})
    found = seconds.since(0.0)
    assert [(each.utc_s, each.values["error_um"]) for each in found] == [
        (0.0, (1.0, 2.0, 3.0)),
        (1.0, (5.0, 5.0, 5.0)),
        (2.0, (0.0, 0.0, 0.0)),
    ]


def test_a_short_span_is_the_feeds() -> None:
    series = history(feed_of(300), None, "error_um", 60.0, NOW_S)
    assert series.utc_s.tolist() == [NOW_S - 60 + k for k in range(60)]
    assert series.mean == pytest.approx(np.arange(-60, 0) + 0.045)
    assert (series.low <= series.mean).all()
    assert (series.mean <= series.high).all()


def test_an_unknown_signal_is_refused() -> None:
    with pytest.raises(ValueError, match=r"__class__: none of .*error_um"):
        history(feed_of(1), None, "__class__", 60.0)


def test_a_gap_interrupts_the_line() -> None:
    at_s = np.concatenate([np.arange(100.0), np.arange(200.0, 300.0)])
    series = thinned(Series(at_s, at_s, at_s, at_s), 300.0)
    assert np.isnan(series.mean).sum() == 1
    assert math.isnan(series.mean[100])
    assert np.diff(series.utc_s).min() > 0


def test_a_month_is_thinned_and_keeps_its_extremes() -> None:
    at_s = np.arange(0.0, 2_678_400.0, 60.0)
    mean = np.sin(at_s / 9000)
    high = mean.copy()
    high[12_345] = 50.0
    series = thinned(Series(at_s, mean - 1, mean, high), 2_678_400.0)
    assert series.utc_s.size <= 1201
    assert series.high.max() == 50.0
    assert np.nanmin(series.low) == pytest.approx((mean - 1).min())


def test_marks_are_the_feeds_and_those_of_the_runs_before(tmp_path: Path) -> None:
    origin = datetime.fromtimestamp(NOW_S - 600.0, UTC)
    events = [(0.0, {"kind": "started"})]
    for at_s, text in (
        (-700.0 + 600.0, "too early"),
        (100.0, "door"),
        (550.0, "seen by the feed, too"),
    ):
        events.append(
            (at_s, {"kind": "command", "command": "mark", "who": "anna", "why": "", "text": text})
        )
    run = tmp_path / f"{origin:%Y%m%dT%H%M%SZ}-night"
    run.mkdir()
    stamped = [
        {"time_utc": (origin + timedelta(seconds=at_s)).isoformat(), "mono_s": at_s} | line
        for at_s, line in events
    ]
    (run / "events.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in stamped))
    (tmp_path / "20260101T000000Z-torn").mkdir()
    (tmp_path / "20260101T000000Z-torn" / "events.jsonl").write_text('{"kind":')
    feed = HoldFeed(Where())
    assert marks(feed, None, 600.0, NOW_S) == [], "no page has seen one, and the runs are elsewhere"
    assert [text for _, text in marks(feed, tmp_path, 600.0, NOW_S)] == [
        "door",
        "seen by the feed, too",
    ]
    feed.met_s = NOW_S - 60.0
    feed.marks.append((NOW_S - 49.5, "seen by the feed, too"))
    assert marks(feed, tmp_path, 600.0, NOW_S) == [
        (NOW_S - 500.0, "door"),
        (NOW_S - 49.5, "seen by the feed, too"),
    ]
    assert marks(feed, tmp_path, 55.0, NOW_S) == [(NOW_S - 49.5, "seen by the feed, too")]


def test_values_that_are_missing_stay_missing() -> None:
    nan = np.full(10, math.nan)
    series = thinned(Series(np.arange(10.0), nan, nan, nan), 10.0)
    assert np.isnan(series.mean).all()
    assert thinned(Series(*(np.empty(0) for _ in range(4))), 60.0).utc_s.size == 0


def test_sparklines_and_charts_are_drawn_of_anything() -> None:
    assert render_sparkline([1.0]) == ""
    assert render_sparkline([math.nan, 1.0, 2.0, math.nan, 3.0]).count("M") == 2
    assert 'd="M' in render_sparkline([5.0, 5.0])
    series = Series(
        np.array([1.0, 2.0]),
        np.array([0.0, math.nan]),
        np.array([1.0, math.nan]),
        np.array([2.0, 1.0]),
    )
    options = make_history_chart([("error_um", series)], True)
    assert options["series"][2]["markLine"]["data"] == [], "earlier marks do not stay"
    many = [ChartLine(float(number), "x" * 30) for number in range(30)]
    marked = make_history_chart([("error_um", series)], True, many)
    lines = marked["series"][2]["markLine"]["data"]
    assert [line["xAxis"] for line in lines] == [1e3 * number for number in range(10, 30)]
    assert {line["name"] for line in lines} == {"x" * 24}
    assert options["series"][2]["data"] == [[1000.0, 1.0, 0.0, 2.0], [2000.0, None, None, 1.0]]
    assert options["series"][1]["data"][0] == [1000.0, 2.0], "the band's width above its lower edge"
